// The map of the report: Leaflet on a canvas, in local metres (CRS.Simple: latitude is north, longitude east).
// User-supplied names may contain markup: they only become text nodes.
(() => {
  "use strict";
  const data = JSON.parse(document.getElementById("map-data").textContent);
  const byId = (id) => document.getElementById(id);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const at = ([x, y]) => [y, x];
  const words = (kind) => kind.replaceAll("_", " ");
  const number = (value, digits) => value.toFixed(digits).replace("-", "\u2212");
  // What is not zero never reads so.
  const small = (value, digits) => (value > 0 && value < 0.5 * 10 ** -digits ? `< ${10 ** -digits}` : number(value, digits));
  const cm = (metres) => `${small(100 * metres, 1)} cm`;
  const SERIES = ["blue", "green", "vermillion", "purple", "orange", "sky", "wine", "teal", "olive", "indigo"];
  const DASHES = [[], [7, 4], [2, 4], [8, 3, 2, 3]];
  const MOST_IN_DETAIL = 1200; // most markings in view with ellipses and arrows
  const LEAST_PX = 3; // least semi-axis of a drawn ellipse
  const NEAR_PX = 6; // least pixels per metre for ellipses and arrows

  let pictures = null; // parsed on first use: they are most of the page
  const picturesOf = (key) => {
    pictures ??= JSON.parse(byId("pictures").textContent);
    return pictures[key] ?? [];
  };

  function element(tag, attributes = {}, ...children) {
    const svg = ["svg", "image", "polygon", "path", "line", "circle"].includes(tag);
    const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
  }

  const map = L.map("map", {
    crs: L.CRS.Simple, minZoom: -4, maxZoom: 10, zoomSnap: 0.25, zoomDelta: 1, wheelPxPerZoomLevel: 90,
    attributionControl: false, zoomControl: true,
  });
  L.control.scale({ imperial: false, maxWidth: 140 }).addTo(map);
  const canvas = new Features.Canvas({ padding: 0.4 });
  // What is selected lies above all, and is transparent to the pointer.
  const above = map.createPane("above");
  Object.assign(above.style, { zIndex: 450, pointerEvents: "none" });
  const still = { renderer: L.canvas({ pane: "above", padding: 0.4 }), interactive: false, noClip: true, smoothFactor: 0 };

  // ---- layers ----
  const layers = {};
  const { Shape } = Features;
  const group = (shapes, isInteractive = false) => new Features.Group(canvas, shapes, isInteractive);
  const line = (points, more = {}) => new Shape(points, { isOpen: true, ...more });
  for (const [zIndex, name] of ["background", "mosaic"].entries()) {
    if (!data[name]) continue;
    const { type, src, bounds: [west, south, east, north] } = data[name];
    layers[name] = L.imageOverlay(`data:${type};base64,${src}`, [[south, west], [north, east]], { pane: "tilePane", interactive: false, zIndex: zIndex + 1 });
  }
  if (data.truth) {
    layers.truth = group([
      ...data.truth.markings.map((corners) => new Shape(corners)),
      ...data.truth.lanes.map((points) => line(points)),
    ]);
  }
  layers.lanes = group(data.lanes.map((lane) => line(lane.p, { kind: lane.k })));
  if (data.route.recorded.length) layers.recorded = group([line(data.route.recorded)]);
  if (data.route.adjusted.length) layers.adjusted = group([line(data.route.adjusted)]);
  const things = [];
  const feature = (points, about, more = {}) => {
    const shape = new Shape(points, { about, ...more });
    things.push(shape);
    return shape;
  };
  layers.markings = group([
    ...data.markings.map((one) => feature(one.c, { ...one, key: `m${one.id}`, what: "marking" })),
    ...data.symbols.map((one) => feature(one.p, { ...one, key: `s${one.id}`, what: "symbol" })),
  ], true);
  layers.excluded = group(data.excluded.map((one, n) => feature([one.p], { ...one, key: `x${n}`, what: "excluded" }, { radius: 4 })), true);
  layers.checks = group(data.checks.map((one, n) => feature([one.p], { ...one, key: `c${n}`, what: "check" }, { radius: 6 })), true);
  const FATES = { moved: "blue", vanished: "vermillion", new: "green" };
  const changed = new Map(data.changes.map((one) => [one.id, one]));
  // Existing markings react themselves; vanished ones need a shape of their own.
  layers.changes = group(data.changes.flatMap(({ before, ...one }) => {
    const dashed = { fate: one.fate, dash: [5, 4] };
    if (one.fate === "vanished") return [feature(one.p, { ...one, key: `d${one.id}`, what: "change" }, dashed)];
    return [[before, dashed], [one.p, { fate: one.fate }]].filter(([corners]) => corners.length).map(([corners, more]) => new Shape(corners, more));
  }), true);
  const written = data.symbols.filter((one) => one.says);
  if (written.length) layers.texts = L.layerGroup();
  layers.ellipses = group([]);
  layers.arrows = group([]);
  canvas.groups = ["truth", "lanes", "recorded", "adjusted", "markings", "excluded", "checks", "changes", "ellipses", "arrows"].flatMap((name) => layers[name] ?? []);
  const selection = L.layerGroup().addTo(map);

  const worst = (one) => (one.w ? Math.max(...one.w) : NaN);
  const SHADES = {
    class: { name: "class" },
    absolute: { name: "95 % radius in the map’s frame", of: worst, unit: "cm" },
    relative: { name: "95 % radius from marking to marking", of: (one) => one.r ?? NaN, unit: "cm" },
    truth: { name: "error against ground truth", of: (one) => one.t ?? NaN, unit: "cm" },
    sightings: { name: "sightings", of: (one) => one.n, unit: "" },
  };
  // Cividis: uniform in lightness, and safe for colour-blind readers.
  const RAMP = ["#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8779", "#a69d75", "#c4b56c", "#e4cf5b", "#fee838"];
  const ramp = (share) => RAMP[Math.min(RAMP.length - 1, Math.max(0, Math.round(share * (RAMP.length - 1))))];
  let shade = "class";
  let range = [0, 1];

  let inks = {}; // colours by name, of the theme

  function fill(one) {
    if (shade === "class") return inks[SERIES[one.k % SERIES.length]];
    const value = SHADES[shade].of(one);
    return Number.isFinite(value) ? ramp((value - range[0]) / (range[1] - range[0] || 1)) : inks.muted;
  }

  function paint() {
    if (shade !== "class") {
      const values = data.markings.map(SHADES[shade].of).filter(Number.isFinite).sort((a, b) => a - b);
      range = values.length ? [values[0], values[Math.floor(0.98 * (values.length - 1))]] : [0, 1];
    }
    inks = Object.fromEntries(["ink", "muted", ...SERIES].map((name) => [name, colour(name)]));
    const { ink, muted, sky, vermillion, orange } = inks;
    layers.truth?.restyle(() => ({ color: muted, weight: 1, dash: [3, 3] }));
    layers.lanes.restyle(({ kind }) => ({ color: sky, weight: 2, dash: data.kinds[kind] === "lane_dash" ? [10, 8] : [] }));
    layers.recorded?.restyle(() => ({ color: vermillion, weight: 1.2, dash: [2, 5] }));
    layers.adjusted?.restyle(() => ({ color: ink, weight: 1.2 }));
    layers.markings.restyle(({ about }) => ({ color: fill(about), weight: 1.2, opacity: about.area ? 0.2 : 0.55, dash: about.what === "symbol" ? [4, 2] : [] }));
    layers.checks.restyle(() => ({ color: ink, weight: 2, fill: orange, opacity: 0.9 }));
    layers.changes.restyle(({ fate, dash }) => ({ color: inks[FATES[fate]], weight: 2.5, dash }));
    layers.excluded.restyle(() => ({ color: vermillion, weight: 1.3, dash: [2, 1.5] }));
    legend();
    detail();
  }

  // ---- details, for markings in view only ----
  function inView() {
    if (map.getZoomScale(map.getZoom(), 0) < NEAR_PX) return null;
    const bounds = map.getBounds().pad(0.1);
    const [west, south, east, north] = [bounds.getWest(), bounds.getSouth(), bounds.getEast(), bounds.getNorth()];
    const found = data.markings.filter(({ c: [[x, y]] }) => x > west && x < east && y > south && y < north);
    return found.length <= MOST_IN_DETAIL ? found : null;
  }

  function detail() {
    layers.ellipses.replace([]);
    layers.arrows.replace([]);
    label();
    const [ellipses, arrows] = [map.hasLayer(layers.ellipses), map.hasLayer(layers.arrows)];
    const shown = ellipses || arrows ? inView() : [];
    byId("map").dataset.detail = shown ? "drawn" : "too many";
    hints(shown === null);
    if (!shown) return;
    const times = Number(byId("enlarge").value);
    const px = map.getZoomScale(map.getZoom(), 0);
    const [look, looks] = [{ color: inks.ink, weight: 1 }, data.cameras.map(arrowLook)];
    const [rings, heads] = [[], []];
    for (const one of shown) {
      if (ellipses && one.e) one.c.forEach((corner, n) => {
        const [a, b, direction] = one.e[n];
        if (a * times * px >= LEAST_PX) rings.push(new Shape([corner], { ellipse: [...corner, a * times, b * times, direction], look }));
      });
      if (arrows) for (const [camera, dx, dy] of one.a ?? []) heads.push(arrow(one, looks[camera], dx, dy, times, px));
    }
    layers.ellipses.replace(rings);
    layers.arrows.replace(heads.flat());
  }

  function label() { // what words say, where there is room for it
    layers.texts?.clearLayers();
    if (!layers.texts || map.getZoomScale(map.getZoom(), 0) < NEAR_PX) return;
    const bounds = map.getBounds().pad(0.1);
    for (const one of written.filter(({ p }) => bounds.contains(at(p[0]))).slice(0, MOST_IN_DETAIL)) {
      const made = L.tooltip({ permanent: true, direction: "center", className: "corner", interactive: false });
      layers.texts.addLayer(made.setLatLng(L.latLngBounds(one.p.map(at)).getCenter()).setContent(element("span", {}, one.says[0])));
    }
  }

  const arrowLook = (_, camera) => ({ color: inks[SERIES[(camera + 3) % SERIES.length]], weight: 1.8, dash: DASHES[camera % DASHES.length] });
  function arrow(one, look, dx, dy, times, px) {
    const x = one.c.reduce((sum, corner) => sum + corner[0], 0) / 4;
    const y = one.c.reduce((sum, corner) => sum + corner[1], 0) / 4;
    const [ex, ey] = [x + times * dx, y + times * dy];
    const head = Math.min(6 / px, 0.4 * Math.hypot(ex - x, ey - y));
    const angle = Math.atan2(ey - y, ex - x);
    const wing = (turn) => [ex + head * Math.cos(angle + turn), ey + head * Math.sin(angle + turn)];
    return [[[x, y], [ex, ey]], [wing(2.6), [ex, ey], wing(-2.6)]].map((points) => line(points, { look }));
  }

  // ---- the panel ----
  const NAMES = {
    markings: "markings and symbols", texts: "what words say", lanes: "lane lines", truth: "ground truth", checks: "check points", ellipses: "95 % ellipses", adjusted: "route, adjusted",
    recorded: "route, recorded", excluded: "excluded candidates", changes: "changes", arrows: "residual arrows", mosaic: "ground mosaic", background: "background picture",
  };
  const ON = ["markings", "texts", "lanes", "adjusted", "excluded", "checks", "changes", "ellipses", "mosaic", "background"];
  const swatch = (stroke, dashes, shape = "line") => {
    const made = element("svg", { viewBox: "0 0 26 14", "aria-hidden": "true" });
    const look = { style: `stroke:${stroke};stroke-width:2;fill:none`, ...(dashes ? { "stroke-dasharray": dashes } : {}) };
    if (shape === "box") made.append(element("polygon", { points: "13,1 24,7 13,13 2,7", ...look, style: `${look.style.replace("fill:none", `fill:${stroke}`)};fill-opacity:.55` }));
    else if (shape === "ring") made.append(element("circle", { cx: 13, cy: 7, r: 5, ...look }));
    else if (shape === "arrow") made.append(element("path", { d: "M3 7H22M17 3l6 4-6 4", ...look }));
    else made.append(element("line", { x1: 1, y1: 7, x2: 25, y2: 7, ...look }));
    return made;
  };
  const SWATCHES = {
    markings: ["var(--blue)", null, "box"], texts: ["var(--ink)", null, "box"], lanes: ["var(--sky)"], truth: ["var(--muted)", "3 3"], checks: ["var(--orange)", null, "ring"], ellipses: ["var(--ink)", null, "ring"],
    adjusted: ["var(--ink)"], recorded: ["var(--vermillion)", "2 4"], excluded: ["var(--vermillion)", "2 2", "ring"],
    arrows: ["var(--purple)", null, "arrow"], changes: ["var(--vermillion)", "5 4"], mosaic: ["var(--muted)", null, "box"], background: ["var(--muted)", null, "box"],
  };
  const COUNTS = { texts: written.length, changes: data.changes.length, markings: data.markings.length + data.symbols.length, checks: data.checks.length, lanes: data.lane_lines, excluded: data.excluded.length, truth: data.truth?.markings.length };
  for (const name of Object.keys(NAMES)) {
    const empty = !layers[name] || (name === "arrows" && !data.markings.some((one) => one.a)) || COUNTS[name] === 0;
    if (empty) continue;
    const box = element("input", { type: "checkbox", id: `layer-${name}` });
    box.checked = ON.includes(name);
    box.addEventListener("change", () => { box.checked ? layers[name].addTo(map) : layers[name].remove(); detail(); });
    const label = element("label", {}, box, swatch(...SWATCHES[name]), NAMES[name]);
    if (COUNTS[name]) label.append(element("span", { class: "count" }, String(COUNTS[name])));
    byId("layers").append(label);
    if (box.checked) layers[name].addTo(map);
  }
  const hint = element("p", { class: "hint" }, "Zoom in for ellipses and arrows.");
  hint.hidden = true;
  byId("layers").append(hint);
  const hints = (tooMany) => { hint.hidden = !tooMany; };

  for (const [name, one] of Object.entries(SHADES)) {
    if (!one.of || data.markings.some((marking) => Number.isFinite(one.of(marking)))) byId("colour").append(element("option", { value: name }, one.name));
  }
  byId("colour").addEventListener("change", (event) => { shade = event.target.value; paint(); });
  byId("enlarge").addEventListener("change", detail);

  function legend() {
    const rows = [];
    if (shade === "class") {
      const used = new Set(things.filter((shape) => ["marking", "symbol"].includes(shape.about.what)).map((shape) => shape.about.k));
      for (const k of [...used].sort((a, b) => a - b)) rows.push(element("div", {}, swatch(`var(--${SERIES[k % SERIES.length]})`, null, "box"), words(data.kinds[k])));
    } else {
      const { unit } = SHADES[shade];
      const text = (value) => (unit === "cm" ? cm(value) : String(Math.round(value)));
      rows.push(element("div", { class: "ramp", style: `background:linear-gradient(90deg,${RAMP.join(",")})` }));
      rows.push(element("div", { class: "ends" }, element("span", {}, text(range[0])), element("span", {}, `${text(range[1])} and more`)));
    }
    if (layers.arrows && map.hasLayer(layers.arrows)) {
      data.cameras.forEach((name, n) => rows.push(element("div", {}, swatch(`var(--${SERIES[(n + 3) % SERIES.length]})`, DASHES[n % DASHES.length].join(" "), "arrow"), `${name}: mean of projected minus observed`)));
    }
    byId("legend").replaceChildren(...rows);
  }

  // ---- pointing and selecting ----
  const title = (about) => (about.what === "check" ? `Check point ${about.id}` : about.what === "excluded" ? `Excluded: ${words(about.k)}` : about.what === "change" ? `${words(about.k)} ${about.id}: ${about.fate}` : `${about.what === "symbol" ? "Symbol" : "Marking"} ${about.id}, ${words(data.kinds[about.k])}${about.says ? ` \u201c${about.says[0]}\u201d` : ""}`);
  function facts(about) {
    if (about.what === "check") return checked(about);
    const rows = [];
    if (about.what === "excluded") rows.push(["reason", about.why]);
    const change = about.what === "marking" ? changed.get(about.id) : about.fate && about;
    if (change?.shift_m) rows.push(["moved by", `${cm(Math.hypot(...change.shift_m))} \u00b1 ${cm(Math.hypot(...change.shift_sigma_m) / Math.SQRT2)}`]);
    if (change) rows.push([change.fate, `with probability ${number(change.probability, 3)}; seen in ${change.n} of ${change.views} images`]);
    if (about.what !== "change") rows.push(["sightings", `${about.n} ${about.n === 1 ? "image" : "images"}`]);
    if (about.says) {
      const [text, sure, other, sureOfOther] = about.says;
      rows.push(["says", `${text}, with probability ${number(sure, 2)}`]);
      if (other !== null) rows.push(["or", `${other}, with probability ${number(sureOfOther, 2)}`]);
    }
    if (about.kind) rows.push(["kind", words(about.kind)]);
    if (about.parts) rows.push(["made of", `markings ${about.parts.join(", ")}`]);
    if (about.g) rows.push(["accuracy", about.g]);
    if (Number.isFinite(about.r)) rows.push(["95 % radius from marking to marking", cm(about.r)]);
    if (Number.isFinite(worst(about))) rows.push(["95 % radius in the map’s frame", `${cm(worst(about))} (worst corner)`]);
    if (Number.isFinite(about.t)) rows.push(["error against truth", `${cm(about.t)} RMS`]);
    return rows;
  }
  function checked({ off: [dx, dy], inside }) {
    if (dx === null || dy === null) return [["map minus survey", "not compared"]];
    const rows = [["map minus survey", `${cm(dx)} east, ${cm(dy)} north`]];
    if (inside) rows.push(["inside its 95 % ellipse", inside]);
    return rows;
  }
  function tooltip(shape) {
    const { about } = shape;
    const box = element("div", { "data-key": about.key }, element("b", {}, title(about)));
    for (const [name, value] of facts(about)) box.append(`${name}: ${value}`, element("br"));
    if (about.c) about.c.forEach(([x, y], n) => box.append(`${n + 1}: ${number(x, 3)} E, ${number(y, 3)} N`, element("br")));
    return box;
  }
  const tip = L.tooltip({ direction: "auto", opacity: 1 });
  let pointed = null; // the shape under the pointer
  const point = (shape, place) => {
    if (shape) tip.setLatLng(place);
    if (shape === pointed) return;
    pointed = shape;
    map.getContainer().style.cursor = shape ? "pointer" : "";
    if (!shape) map.closeTooltip(tip);
    else map.openTooltip(tip.setContent(tooltip(shape)));
  };
  map.on("mousemove", ({ latlng }) => { if (!map.dragging.moving()) point(canvas.hit(latlng), latlng); });
  map.on("mouseout movestart", () => point(null));
  map.on("click", ({ latlng }) => {
    const shape = canvas.hit(latlng);
    if (shape) select(shape);
  });

  function shot(picture) {
    const [width, height] = picture.size;
    const points = (list) => list.map((point) => point.join(",")).join(" ");
    const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `image of ${picture.camera}, ${picture.t.toFixed(2)} s` });
    svg.append(element("image", { href: `data:image/jpeg;base64,${picture.src}`, width, height }));
    if (picture.map.length > 1) svg.append(element("polygon", { class: "halo", points: points(picture.map) }), element("polygon", { class: "mapped", points: points(picture.map) }));
    else picture.map.forEach(([u, v]) => svg.append(element("circle", { class: "halo", cx: u, cy: v, r: 9 }), element("circle", { class: "mapped", cx: u, cy: v, r: 9 })));
    for (const [u, v] of picture.seen) svg.append(element("path", { class: "seen", d: `M${u - 4} ${v}H${u + 4}M${u} ${v - 4}V${v + 4}` }));
    return element("figure", {}, svg, element("figcaption", {}, `${picture.camera}, ${picture.t.toFixed(2)} s, ${picture.image}`));
  }

  function select(shape) {
    selection.clearLayers();
    const { about } = shape;
    const rows = element("dl");
    for (const [name, value] of facts(about)) rows.append(element("dt", {}, name), element("dd", {}, value));
    const text = element("div", {}, element("h3", {}, title(about)), rows);
    if (about.c) {
      selection.addLayer(L.polygon(about.c.map(at), { ...still, color: colour("ink"), weight: 3, fill: false }));
      about.c.forEach((corner, n) => selection.addLayer(L.tooltip({ permanent: true, direction: "center", className: "corner", interactive: false }).setLatLng(at(corner)).setContent(String(n + 1))));
      text.append(corners(about));
    } else if (["symbol", "change"].includes(about.what)) selection.addLayer(L.polygon(about.p.map(at), { ...still, color: colour("ink"), weight: 3, fill: false }));
    else selection.addLayer(L.circleMarker(at(about.p), { ...still, radius: 9, color: colour("ink"), weight: 3, fill: false }));
    const shots = element("div", { class: "shots" }, ...picturesOf(about.key).map(shot));
    const side = element("div");
    if (shots.childElementCount) {
      const what = about.what === "marking" ? "Outline: the map’s marking, projected. Crosses: detected corners." : "Projected map position; it may be occluded.";
      side.append(element("p", { class: "hint" }, what), shots);
    } else side.append(element("p", { class: "hint" }, "No picture in this report."));
    byId("details").replaceChildren(element("div", { class: "card", "data-key": about.key }, text, side));
  }

  function corners(about) {
    const head = ["corner", "east (m)", "north (m)", "95 % radius (cm)"].map((name, n) => element("th", { scope: "col", ...(n ? { class: "n" } : {}) }, name));
    const rows = about.c.map(([x, y], n) => {
      const radius = about.w ? (100 * about.w[n]).toFixed(1) : "–";
      return element("tr", {}, element("th", { scope: "row" }, String(n + 1)), ...[number(x, 3), number(y, 3), radius].map((cell) => element("td", { class: "n" }, cell)));
    });
    return element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows));
  }

  // A text and its alternative, as they are searched for.
  const says = ({ says: said }) => (said ?? []).filter((part) => typeof part === "string").map((part) => part.toLowerCase());
  byId("find").addEventListener("submit", (event) => {
    event.preventDefault();
    const wanted = byId("find-id").value.trim();
    const mapped = things.filter((shape) => ["marking", "symbol"].includes(shape.about.what));
    const found = mapped.find(({ about }) => says(about).includes(wanted.toLowerCase())) ?? mapped.find(({ about }) => about.id === Number(wanted));
    byId("find-id").setCustomValidity(found ? "" : "No marking of this number, and no such text.");
    byId("find-id").reportValidity();
    if (!found) return;
    show(found);
  });
  function show(shape) {
    map.fitBounds(shape.getBounds().pad(3), { maxZoom: 7 });
    select(shape);
  }
  byId("find-id").addEventListener("input", () => byId("find-id").setCustomValidity(""));

  const place = L.control({ position: "bottomright" });
  place.onAdd = () => element("div", { id: "place" });
  place.addTo(map);
  const within = ({ scale, of }, x, y) => of.map((factors) => {
    let [sum, n] = [0, 0];
    for (let a = 0; a < 4; a++) for (let b = 0; b < 4 - a; b++) sum += factors[n++] * (x / scale) ** a * (y / scale) ** b;
    return sum;
  });
  map.on("mousemove", ({ latlng: { lat, lng } }) => {
    const lines = data.systems.map((system) => {
      const [first, second] = within(system, lng, lat).map((value) => number(value, system.digits));
      return system.name ? `${system.name} ${first} E, ${second} N` : `${first}\u00b0, ${second}\u00b0`;
    });
    byId("place").replaceChildren(...[`${number(lng, 2)} m E, ${number(lat, 2)} m N`, ...lines].map((line) => element("div", {}, line)));
  });
  map.on("mouseout", () => byId("place").replaceChildren());

  // ---- the table of markings ----
  const SHOWN = 200; // rows at once: thousands would be slow
  const listed = things.filter((shape) => ["marking", "symbol"].includes(shape.about.what));
  const COLUMNS = [
    { name: "marking", of: (one) => one.id, digits: 0 },
    { name: "class", of: (one) => words(data.kinds[one.k]) },
    ...(written.length ? [{ name: "text", of: (one) => one.says?.[0] ?? "\u2013" }] : []),
    { name: "sightings", of: (one) => one.n, digits: 0 },
    ...(listed.some(({ about }) => about.g) ? [{ name: "accuracy", of: (one) => one.g ?? "\u2013" }] : []),
    ...data.axes.map((name, n) => ({ name, of: (one) => (one.at ? Number(one.at[n]) : NaN), text: (one) => one.at?.[n], digits: data.digits })),
    { name: "from marking to marking (cm)", of: (one) => 100 * (one.r ?? NaN), digits: 1 },
    { name: "in the map’s frame (cm)", of: (one) => 100 * worst(one), digits: 1 },
    { name: "error against truth (cm)", of: (one) => 100 * (one.t ?? NaN), digits: 1 },
  ].filter((column) => !column.digits || things.some((shape) => Number.isFinite(column.of(shape.about))));
  let order = { column: 0, down: false };
  function matching() {
    const wanted = byId("search").value.trim().toLowerCase().split(/\s+/);
    const { of } = COLUMNS[order.column];
    const key = (shape) => { const value = of(shape.about); return typeof value === "string" || Number.isFinite(value) ? value : null; };
    return listed.filter(({ about }) => wanted.every((word) => String(about.id) === word || words(data.kinds[about.k]).includes(word) || says(about).some((text) => text.includes(word))))
      .map((shape) => [key(shape), shape])
      .sort(([a, one], [b, other]) => (a === null) - (b === null) || (order.down ? -1 : 1) * (a < b ? -1 : a > b ? 1 : 0) || one.about.id - other.about.id)
      .map(([, shape]) => shape);
  }
  const cell = (column, about) => {
    if (column.text?.(about)) return column.text(about);
    const value = column.of(about);
    return column.digits === undefined ? value : Number.isFinite(value) ? small(value, column.digits) : "\u2013";
  };
  function list() {
    const found = matching();
    const head = COLUMNS.map((column, n) => {
      const button = element("button", { type: "button" }, column.name);
      button.addEventListener("click", () => { order = { column: n, down: order.column === n && !order.down }; list(); });
      return element("th", { scope: "col", "aria-sort": n !== order.column ? "none" : order.down ? "descending" : "ascending", ...(column.digits === undefined ? {} : { class: "n" }) }, button);
    });
    const rows = found.slice(0, SHOWN).map((shape) => element("tr", {}, ...COLUMNS.map((column, n) => {
      if (n) return element("td", column.digits === undefined ? {} : { class: "n" }, cell(column, shape.about));
      const button = element("button", { type: "button", class: "link" }, cell(column, shape.about));
      button.addEventListener("click", () => { show(shape); byId("map-section").scrollIntoView(); });
      return element("th", { scope: "row", class: "n" }, button);
    })));
    byId("list").replaceChildren(element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows));
    byId("listed").textContent = `${found.length} of ${listed.length}${found.length > SHOWN ? `, the first ${SHOWN} shown` : ""}`;
  }
  byId("search").addEventListener("input", list);
  byId("save").addEventListener("click", () => {
    const quoted = (text) => `"${String(text).replaceAll('"', '""')}"`;
    const lines = [COLUMNS.map((column) => quoted(column.name)), ...matching().map(({ about }) => COLUMNS.map((column) => { const value = column.of(about); return typeof value === "string" ? quoted(value) : Number.isFinite(value) ? value.toFixed(column.digits) : ""; }))];
    const link = element("a", { href: URL.createObjectURL(new Blob([lines.map((line) => line.join(",")).join("\r\n")], { type: "text/csv" })), download: "markings.csv" });
    link.click();
    URL.revokeObjectURL(link.href);
  });
  byId("files").append(...data.files.map((name) => element("a", { href: encodeURIComponent(name), download: name }, name)));

  // ---- begin ----
  const everything = L.latLngBounds([]);
  for (const name of ["markings", "lanes", "adjusted"]) if (layers[name]?.shapes.length) everything.extend(layers[name].getBounds());
  map.fitBounds(everything.isValid() ? everything.pad(0.03) : [[-10, -10], [10, 10]]);
  map.setMinZoom(Math.min(map.getZoom() - 1, 0));
  map.setMaxBounds(everything.isValid() ? everything.pad(1) : null);
  canvas.addTo(map);
  map.on("moveend", detail);
  for (const name of ["ellipses", "arrows"]) layers[name].on("add remove", legend);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
  paint();
  list();
  addEventListener("DOMContentLoaded", () => { // pictures come after this script
    for (const cell of document.querySelectorAll("[data-shots]")) {
      const shots = picturesOf(cell.dataset.shots).slice(0, 1).map(shot);
      if (shots.length) cell.replaceChildren(...shots);
    }
  });
  byId("map").dataset.ready = String(Math.round(performance.now()));
  window.v2hdmMap = { map, things, element, kinds: data.kinds }; // for tests and further scripts
})();

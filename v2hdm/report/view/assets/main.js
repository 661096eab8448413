// The editor: what keys, mouse and buttons do.

import { Drawing, HANDLE_PX, View, colour, handlesOf } from "./drawing.js";
import { Edits } from "./edits.js";
import { crossesItself, drawn, joined, parts, taken } from "./lines.js";
import { Lanes, amid, answered, choicesOf, ofQuestion } from "./lanes.js";
import { Model, isGone, isLine, isMade, isMovable, kindOf, middleOf, nameOf, saidOf } from "./model.js";
import { Tiles } from "./tiles.js";
import { Images, Panel, byId, element, placeTip } from "./panel.js";

const NEAR_PX = 8; // how near to an outline the pointer selects it
const STEP_M = 0.01; // an arrow key moves the selection by this; with Shift by ten times as much
const TURN_DEG = 1; // R turns the selection by this; with Alt by a tenth
const PAN_SHARE = 0.15; // an arrow key pans by this share of the window
const CLOSE_SCALE = 60; // pixels per metre at which a marking is shown, at most

const scene = await (await fetch("scene.json")).json();
const model = new Model(scene);
const view = new View();
const canvas = byId("map");
const drawing = new Drawing(canvas, model, view);
const edits = new Edits(model, changed, saved);
const lanes = new Lanes(model, () => asked());
let selected = null;
let hovered = null;
let corner = null; // the one that the arrow keys move, from 0
let tool = "select";
let measured = [];
let course = []; // of the line that is being drawn
let pointer = null; // in pixels of the canvas; null while the keyboard leads
let drag = null;
let lastPlaced = null; // the outline that the next added marking gets

// ---- what is told ----
const tell = (text) => { byId("told").textContent = text; };
function saved(text, isProblem = false) {
  const count = model.corrected.length;
  byId("saved").textContent = text || `${count} ${count === 1 ? "correction" : "corrections"} in ${edits.file}, all saved`;
  byId("saved").classList.toggle("problem", isProblem);
  if (!text && lanes.stale) lanes.refresh().catch(({ message }) => tell(message));
}
function changed(features) {
  lanes.stale ||= features.some((feature) => isLine(feature) || feature.what === "question");
  drawing.change();
  if (features.includes(selected) || !selected) panel.select(selected);
  if (features.includes(selected)) look();
  panel.lists(looks, selected, questions);
  buttons();
}
// Lanes and questions are others now.
function asked() {
  const open = model.questions.filter((question) => question.open || question.entry);
  questions = [...open.map((feature) => ({ feature, why: feature.text || saidOf(feature) })), ...leftOut];
  if (selected?.what === "lane") select(lanes.again(selected));
  if (lanes.refused.length) tell(`Not followed: ${lanes.refused[0]}`);
  panel.select(selected);
  panel.lists(looks, selected, questions);
  drawing.change();
}

// ---- the selection ----
const images = new Images();
let waiting = null;
function look() { // once the outline rests
  clearTimeout(waiting);
  const shown = selected && (isLine(selected) || selected.what === "lane") ? null : selected; // no image shows a whole line
  waiting = setTimeout(() => images.show(shown), 250);
}
function select(feature, at = null) {
  selected = feature;
  corner = null;
  drawing.lifted = null;
  panel.select(feature);
  look();
  panel.lists(looks, selected, questions);
  drawing.change();
  tell(feature ? [nameOf(feature), saidOf(feature), at].filter(Boolean).join("; ") : "Nothing selected");
  history.replaceState(null, "", feature && !isMade(feature) && feature.what !== "lane" ? `#${feature.key}` : location.pathname);
  dispatchEvent(new CustomEvent("v2hdm-selected", { detail: feature }));
  buttons();
}
function show(feature) {
  const [x, y] = middleOf(feature.places);
  [view.east, view.north] = [x, y];
  const size = Math.max(...feature.places.map(([east, north]) => Math.hypot(east - x, north - y)), 0.5);
  view.scale = Math.min(CLOSE_SCALE, 0.2 * Math.min(view.width, view.height) / size);
  select(feature);
}

// ---- lists to go through ----
const suspects = new Map(scene.suspicious.map(({ id, p, by }) => [`m${id}`, `${by}, p\u00a0${p < 0.001 ? "<\u00a00.001" : p.toFixed(3)}`]));
const looks = [...suspects].flatMap(([key, why]) => (model.byKey.has(key) ? [{ feature: model.byKey.get(key), why }] : []));
for (const feature of model.features.filter(({ g, key }) => g === "C" && !suspects.has(key)).sort((a, b) => (b.w ?? 0) - (a.w ?? 0))) looks.push({ feature, why: `95 % radius ${(feature.w / 10).toFixed(1)} cm` });
const leftOut = model.features.filter(({ what }) => what === "candidate").sort((a, b) => b.n - a.n).map((feature) => ({ feature, why: feature.why }));
let questions = leftOut; // those on lanes first
function step(list, by, name) {
  if (!list.length) return tell(`No ${name}`);
  const now = list.findIndex(({ feature }) => feature === selected);
  const next = now < 0 ? (by > 0 ? 0 : list.length - 1) : (now + by + list.length) % list.length;
  show(list[next].feature);
  return tell(`${nameOf(list[next].feature)}: ${list[next].why} (${next + 1} of ${list.length})`);
}

// ---- corrections ----
const make = (feature, change, label, tag) => edits.make([[feature, edits.entry(feature, change)]], label, tag);
function needs(isFit, text) {
  if (selected && isFit(selected)) return true;
  tell(selected ? text : "Select a marking first");
  return false;
}
function accept() {
  if (!needs((feature) => !isMade(feature) && !isLine(feature) && !isAsked(feature), "A lane, or what is yours, needs no acceptance")) return;
  const { moved, new_class: kind } = selected.entry ?? {};
  make(selected, { says: "accepted", moved, new_class: kind, reason: undefined }, `accept ${nameOf(selected)}`);
}
const isAsked = ({ what }) => what === "question" || what === "lane";
// An answer to the selected question, or on the selected lane's direction; empty ones are none.
function answer(text) {
  if (!selected || !text) return;
  if (selected.what === "lane") {
    const stated = { says: "answered", subject: "direction", answer: text, places_map: amid(selected) };
    const question = lanes.asked(selected, stated);
    edits.make([[question, answered(question, ofQuestion(text, selected, question))]], `state a direction`);
  } else edits.make([[selected, answered(selected, text)]], `answer ${nameOf(selected)}`);
  isFocus();
  tell(`${nameOf(selected)}: ${text}`);
}
function remove(reason = "") {
  if (selected && isAsked(selected)) return selected.entry ? make(selected, null, `take back ${nameOf(selected)}`) : tell("There is no answer to take back");
  if (!needs((feature) => !isGone(feature) || reason, "It is deleted already")) return;
  const name = nameOf(selected);
  if (isMade(selected)) make(selected, null, `delete ${name}`);
  else if (isLine(selected)) make(selected, reason ? { says: "rejected", reason } : { says: "rejected" }, `delete ${name}`);
  else make(selected, { says: "rejected", reason, moved: undefined, new_class: undefined }, `delete ${name}`);
  tell(`Deleted: ${name}`);
}
function classify(kind) {
  if (!selected) return;
  const says = ["accepted", "added"].includes(selected.entry?.says) ? selected.entry.says : selected.what === "candidate" ? "accepted" : "corrected";
  const change = isMade(selected) ? { class: kind } : { says, new_class: kind, reason: undefined };
  make(selected, change, `reclassify ${nameOf(selected)}`);
}
const restore = () => selected && make(selected, null, `take back ${nameOf(selected)}`);
// Corners at new places; those at their old ones are no correction.
function place(places, label, tag) {
  const rounded = places.map((at) => at.map((value) => Math.round(value * 1e4) / 1e4));
  if (crosses(rounded)) return tell("Its outline would cross itself");
  if (selected.what === "added") {
    lastPlaced = rounded;
    return make(selected, { outline_map: rounded }, label, tag);
  }
  const moved = {};
  rounded.forEach((at, n) => { if (Math.hypot(at[0] - selected.base[n][0], at[1] - selected.base[n][1]) > 5e-5) moved[n + 1] = at; });
  const says = selected.entry?.says === "accepted" ? "accepted" : "corrected";
  return make(selected, { says, moved, reason: undefined }, label, tag);
}
const side = ([ax, ay], [bx, by], [cx, cy]) => (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
function crosses(places) {
  const turns = places.map((at, n) => side(at, places[(n + 1) % 4], places[(n + 2) % 4]));
  const isSplit = (a, b, c, d) => side(a, b, c) * side(a, b, d) < 0 && side(c, d, a) * side(c, d, b) < 0;
  const [a, b, c, d] = places;
  return isSplit(a, b, c, d) || isSplit(b, c, d, a) || turns.reduce((sum, turn) => sum + turn, 0) <= 0;
}
const shifted = (places, dx, dy, only = null) => places.map(([x, y], n) => (only === null || only === n ? [x + dx, y + dy] : [x, y]));
function turned(places, angle) {
  const [mx, my] = middleOf(places);
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return places.map(([x, y]) => [mx + c * (x - mx) - s * (y - my), my + s * (x - mx) + c * (y - my)]);
}
function nudge(dx, dy) {
  if (!needs(isMovable, "Only a marking of four corners can be moved") || isGone(selected)) return;
  place(shifted(selected.places, dx, dy, corner), `move ${nameOf(selected)}`, "move");
  tell(`${corner === null ? nameOf(selected) : `Corner ${corner + 1}`} moved`);
}
function turn(degrees) {
  if (!needs(isMovable, "Only a marking of four corners can be turned") || isGone(selected)) return;
  place(turned(selected.places, degrees * Math.PI / 180), `turn ${nameOf(selected)}`, "turn");
  tell(`${nameOf(selected)} turned by ${degrees}\u00b0`);
}
// A new marking at a place, of the size and direction of the selected one, or of the nearest of its class.
function add([x, y]) {
  const like = (selected && isMovable(selected) ? selected : nearest([x, y], isMovable)) ?? null;
  const outline = lastPlaced && selected?.what === "added" ? selected.places : like?.places ?? [[-0.5, -0.25], [0.5, -0.25], [0.5, 0.25], [-0.5, 0.25]];
  const kind = like ? kindOf(like) : scene.cornered[0];
  const [mx, my] = middleOf(outline);
  const places = outline.map(([east, north]) => [x + east - mx, y + north - my].map((value) => Math.round(value * 1e4) / 1e4));
  const entry = { says: "added", class: scene.cornered.includes(kind) ? kind : scene.cornered[0], outline_map: places };
  const feature = model.addedBy(entry, `new ${Date.now()} ${model.features.length}`);
  edits.make([[feature, entry]], `add ${nameOf(feature)}`);
  setTool("select");
  select(feature);
  tell(`Added: ${nameOf(feature)}`);
}
function nearest([x, y], isFit = () => true) {
  let [best, away] = [null, Infinity];
  for (const reach of [5, 40, 1e9]) {
    for (const feature of model.within([x - reach, y - reach, x + reach, y + reach])) {
      if (!isFit(feature) || isGone(feature)) continue;
      const [mx, my] = middleOf(feature.places);
      const off = Math.hypot(mx - x, my - y);
      if (off < away) [best, away] = [feature, off];
    }
    if (best) break;
  }
  return best;
}
function undo() {
  const label = edits.undo();
  tell(label ? `Undone: ${label}` : "Nothing to undo");
  if (selected && isMade(selected) && !selected.entry) select(null);
}
function finish() { // the line that is being drawn
  const line = course;
  setTool("select");
  if (line.length < 2) return tell("A line needs two places");
  if (crossesItself(line)) { course = line; tool = "draw"; buttons(); return tell("The line crosses itself; Backspace takes the last place back"); }
  const change = drawn(model, selected && isLine(selected) ? kindOf(selected) : "lane_line", line);
  edits.make([change], "draw a lane line");
  return select(change[0]);
}
function split() {
  if (!needs((feature) => isLine(feature) && !isGone(feature), "Select a lane line first")) return;
  const cut = parts(selected.places, cursor());
  if (!cut) { tell("Point at the place of the line where it is cut"); return; }
  const made = cut.map((line) => drawn(model, kindOf(selected), line));
  edits.make([taken(selected), ...made], `split ${nameOf(selected)}`);
  select(made[0][0]);
  tell("Split in two");
}
const MOST_GAP_M = 30; // between lines that are joined
function join() {
  if (!needs((feature) => isLine(feature) && !isGone(feature), "Select a lane line first")) return;
  const best = joined(selected.places, model.lines.filter((other) => other !== selected && !isGone(other)));
  if (!best || best.gap > MOST_GAP_M) { tell(`No other line ends within ${MOST_GAP_M} m of its ends`); return; }
  if (crossesItself(best.line)) { tell("Joined, the line would cross itself"); return; }
  const made = drawn(model, kindOf(selected), best.line);
  edits.make([taken(selected), taken(best.other), made], `join ${nameOf(selected)}`);
  select(made[0]);
  tell(`Joined over ${best.gap.toFixed(1)} m`);
}
function redo() {
  const label = edits.redo();
  tell(label ? `Done again: ${label}` : "Nothing to do again");
}

// ---- under the pointer ----
const offLine = ([px, py], [ax, ay], [bx, by]) => {
  const [dx, dy] = [bx - ax, by - ay];
  const share = Math.max(0, Math.min(1, ((px - ax) * dx + (py - ay) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(px - ax - share * dx, py - ay - share * dy);
};
function isInside([px, py], shape) {
  let inside = false;
  for (let n = 0, m = shape.length - 1; n < shape.length; m = n++) {
    const [[ax, ay], [bx, by]] = [shape[n], shape[m]];
    if (ay > py !== by > py && px < (bx - ax) * (py - ay) / (by - ay) + ax) inside = !inside;
  }
  return inside;
}
function hitLine(at) {
  const [west, south, east, north] = view.box(0.2);
  const isNear = ([x, y]) => x > west && x < east && y > south && y < north;
  let [best, least] = [null, NEAR_PX];
  for (const feature of model.lines) {
    if (feature.what === "drawn" && isGone(feature)) continue;
    const { places } = feature;
    for (let n = 0; n + 1 < places.length; n++) {
      if (!isNear(places[n]) && !isNear(places[n + 1]) && Math.hypot(places[n + 1][0] - places[n][0], places[n + 1][1] - places[n][1]) < east - west) continue;
      const off = offLine(at, view.toScreen(places[n]), view.toScreen(places[n + 1]));
      if (off < least) [best, least] = [feature, off];
    }
  }
  return best;
}
function hit(at) {
  const [x, y] = view.toMap(at);
  const reach = 30;
  let [best, size] = [null, Infinity];
  for (const feature of model.within([x - reach, y - reach, x + reach, y + reach])) {
    if (feature.what === "added" && isGone(feature)) continue;
    if (feature.what === "candidate" && !drawing.show.candidates && !feature.entry) continue;
    const shape = feature.places.map((one) => view.toScreen(one));
    const off = shape.length < 2 ? Math.hypot(shape[0][0] - at[0], shape[0][1] - at[1]) - 3 : Math.min(...shape.map((one, n) => offLine(at, one, shape[(n + 1) % shape.length])));
    const isHit = off < NEAR_PX || (shape.length > 2 && isInside(at, shape));
    const extent = shape.length < 2 ? 0 : Math.hypot(shape[0][0] - shape[2 % shape.length][0], shape[0][1] - shape[2 % shape.length][1]);
    if (isHit && extent < size) [best, size] = [feature, extent];
  }
  return lanes.question(at, view) ?? best ?? hitLine(at) ?? (drawing.show.lanes ? lanes.lane(at, view, offLine, NEAR_PX) : null);
}
const handleAt = (at) => (selected ? handlesOf(selected, view).find((handle) => Math.hypot(handle.at[0] - at[0], handle.at[1] - at[1]) <= HANDLE_PX + 3) : null);
const at = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
const cursor = () => view.toMap(pointer ?? [view.width / 2, view.height / 2]);

canvas.addEventListener("pointerdown", (event) => {
  if (event.button) return;
  pointer = at(event);
  canvas.setPointerCapture(event.pointerId);
  const handle = handleAt(pointer);
  const isOnSelected = selected && isMovable(selected) && !isGone(selected) && isInside(pointer, selected.places.map((one) => view.toScreen(one)));
  const start = view.toMap(pointer);
  const how = tool !== "select" ? "pan" : handle ? (handle.turn ? "turn" : "corner") : isOnSelected ? "move" : "pan";
  drag = { how, start, from: pointer, places: selected?.places, handle, now: null };
});
canvas.addEventListener("pointermove", (event) => {
  pointer = at(event);
  where();
  if (!drag) return hover();
  const [dx, dy] = [pointer[0] - drag.from[0], pointer[1] - drag.from[1]];
  if (!drag.moving && Math.hypot(dx, dy) < 4) return;
  if (!drag.moving && drag.how !== "pan") { drawing.lifted = selected; drawing.change(); }
  drag.moving = true;
  byId("tip").hidden = true;
  const [x, y] = view.toMap(pointer);
  if (drag.how === "pan") {
    view.east -= x - drag.start[0];
    view.north -= y - drag.start[1];
  } else if (drag.how === "turn") {
    const [mx, my] = middleOf(drag.places);
    drag.now = turned(drag.places, Math.atan2(y - my, x - mx) - Math.atan2(drag.start[1] - my, drag.start[0] - mx));
  } else drag.now = shifted(drag.places, x - drag.start[0], y - drag.start[1], drag.how === "corner" ? drag.handle.corner : null);
  drawing.later();
});
canvas.addEventListener("pointerup", (event) => {
  if (!drag) return;
  const { how, now, moving } = drag;
  const there = at(event);
  drag = null;
  drawing.lifted = null;
  drawing.change();
  if (!moving) return click(there);
  if (now) place(now, `${how === "turn" ? "turn" : "move"} ${nameOf(selected)}`);
});
canvas.addEventListener("pointercancel", () => { drag = null; drawing.lifted = null; drawing.change(); });
canvas.addEventListener("pointerleave", () => { hovered = null; byId("tip").hidden = true; byId("place").textContent = ""; drawing.later(); });
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  view.zoomTo(view.scale * Math.exp(-0.0016 * event.deltaY), at(event));
  drawing.later();
}, { passive: false });
function click(there) {
  if (tool === "add") return add(view.toMap(there));
  if (tool === "draw") { course.push(view.toMap(there)); tell(`${course.length} places; Enter twice at one place, or L, ends the line`); return drawing.later(); }
  if (tool === "measure") { measured.push(view.toMap(there)); return drawing.later(); }
  const handle = handleAt(there);
  if (handle && !handle.turn) { corner = handle.corner; return drawing.later(); }
  return select(hit(there));
}
function hover() {
  const found = tool === "select" ? hit(pointer) : null;
  canvas.style.cursor = handleAt(pointer) ? "grab" : found ? "pointer" : "crosshair";
  if (found !== hovered) {
    hovered = found;
    if (found && found !== selected) placeTip(byId("tip"), found, view); else byId("tip").hidden = true;
  }
  drawing.later();
}
const within = ({ scale, of }, x, y) => of.map((factors) => {
  let [sum, n] = [0, 0];
  for (let a = 0; a < 4; a++) for (let b = 0; b < 4 - a; b++) sum += factors[n++] * (x / scale) ** a * (y / scale) ** b;
  return sum;
});
function where() {
  const [x, y] = cursor();
  const lines = scene.systems.map((system) => {
    const [first, second] = within(system, x, y).map((value) => value.toFixed(system.digits));
    return system.name ? `${system.name} ${first} E, ${second} N` : `${first}\u00b0, ${second}\u00b0`;
  });
  byId("place").textContent = [`${x.toFixed(2)} m E, ${y.toFixed(2)} m N`, ...lines].join("\n");
}

// ---- above the map ----
drawing.backdrops.push((context, wide) => drawing.show.lanes && lanes.draw(context, wide));
drawing.extras.push((context) => drawing.show.questions && lanes.marks(context, view));
drawing.extras.push((context) => {
  if (hovered && hovered !== selected) drawing.outline(context, hovered, colour("ink"), 2);
  if (!selected) return;
  const shown = drag?.now ? { ...selected, places: drag.now } : selected;
  drawing.outline(context, shown, colour("accent"), 1.8);
  if (tool === "select") drawing.handles(context, shown, corner);
});
drawing.extras.push((context) => {
  if (tool === "draw" && course.length) drawing.line(context, view, [...course, cursor()], { stroke: colour("accent"), width: 2.5 });
  const places = tool === "measure" && measured.length ? [...measured, cursor()] : measured;
  if (places.length) drawing.line(context, view, places, { stroke: colour("wine"), width: 2.5 });
  const metres = places.slice(1).reduce((sum, [x, y], n) => sum + Math.hypot(x - places[n][0], y - places[n][1]), 0);
  if (places.length > 1) tell(`Measured: ${metres.toFixed(2)} m`);
  if (pointer === null && document.activeElement === canvas && (!selected || tool !== "select")) {
    const [x, y] = [view.width / 2, view.height / 2];
    context.strokeStyle = colour("ink");
    context.lineWidth = 1.5;
    context.setLineDash([]);
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { context.moveTo(x + 5 * dx, y + 5 * dy); context.lineTo(x + 14 * dx, y + 14 * dy); }
    context.stroke();
  }
  const round = 10 ** Math.floor(Math.log10(140 / view.scale));
  const length = [5, 2, 1].find((times) => times * round * view.scale <= 140) * round;
  byId("scale").textContent = length < 1 ? `${Math.round(100 * length)} cm` : `${length} m`;
  byId("scale").style.width = `${length * view.scale}px`;
});

// ---- tools and keys ----
function setTool(name) {
  tool = tool === name ? "select" : name;
  measured = [];
  course = [];
  hovered = null;
  byId("tip").hidden = true;
  tell({ draw: "Click the places of the line, or press Enter at the crosshair; L ends it, Escape gives it up", add: "Click where the new marking is, or press Enter for the crosshair", measure: "Click places, or press Enter at the crosshair; Escape ends" }[tool] ?? "");
  buttons();
  drawing.later();
}
function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen(); else document.querySelector("main").requestFullscreen();
}
async function link() {
  if (!selected || isMade(selected)) return tell("Select a marking of the map first");
  try {
    await navigator.clipboard.writeText(location.href);
    return tell(`Copied the link to ${nameOf(selected)}`);
  } catch {
    return tell(`The link to ${nameOf(selected)} is in the address bar`);
  }
}
const home = () => { view.fit([...model.features.flatMap(({ base }) => base), ...model.route]); drawing.change(); };
const before = () => { drawing.show.before = !drawing.show.before; panel.layers(LAYERS, drawing.show, () => drawing.change()); drawing.change(); };
const zoom = (by) => { view.zoomTo(view.scale * by, pointer ?? undefined); drawing.later(); };
// The focus on the button at its end scrolls a long list there.
const help = () => { byId("keys").showModal(); byId("keys").scrollTop = 0; };
const isFocus = () => { canvas.focus(); };
// Key, its name where it is told, what it does, the name of its button if it has one, and in words.
const KEYS = [
  ["n", "N", () => step(looks, 1, "suspicious marking"), "Next suspicious", "the next suspicious marking; Shift+N the one before"],
  ["N", "", () => step(looks, -1, "suspicious marking")],
  ["q", "Q", () => step(questions, 1, "question"), "Next question", "the next question: on lanes, then candidates that were left out; Shift+Q the one before"],
  ["Q", "", () => step(questions, -1, "question")],
  ["i", "I", () => setTool("add"), "Add", "add a marking: click, or Enter at the crosshair"],
  ["l", "L", () => (tool === "draw" ? finish() : setTool("draw")), "Draw lane line", "draw a lane line: click its places, or Enter at the crosshair; L again ends it"],
  ["s", "S", () => split(), "", "split the selected lane line at the pointer or crosshair"],
  ["j", "J", () => join(), "", "join the selected lane line with the one that ends nearest to it"],
  ["a", "A", () => accept(), "", "accept the selected one"],
  ["Delete", "Del", () => remove(), "Delete", "delete the selected one; Backspace too"],
  ["Backspace", "", () => (tool === "draw" ? (course.pop(), drawing.later()) : remove())],
  ["c", "C", () => (byId("edit-class") ?? byId("answer"))?.focus(), "", "change its class: choose with the arrow keys, Escape goes back to the map"],
  ["r", "R", (event) => turn(event.altKey ? -TURN_DEG / 10 : -TURN_DEG), "", "turn it clockwise by 1\u00b0; Shift+R the other way; with Alt by 0.1\u00b0"],
  ["R", "", (event) => turn(event.altKey ? TURN_DEG / 10 : TURN_DEG)],
  ["z", "Z", () => undo(), "Undo", "undo; Ctrl+Z too"],
  ["y", "Y", () => redo(), "Redo", "do it again; Ctrl+Y too"],
  ["m", "M", () => setTool("measure"), "Measure", "measure a distance: click places, or Enter at the crosshair"],
  ["b", "B", () => before(), "Before / after", "show the outlines from before the corrections as well"],
  ["p", "P", () => link(), "", "copy a link to the selected marking"],
  ["f", "F", () => fullScreen(), "Full screen", "full screen"],
  ["h", "H", () => home(), "Whole map", "the whole map"],
  ["+", "+", () => zoom(1.5), "", "nearer; \u2212 farther"],
  ["=", "", () => zoom(1.5)],
  ["-", "", () => zoom(1 / 1.5)],
  ["?", "?", () => help(), "Keys", "this list"],
];
const ALSO = [
  ["Arrows", "move the selection by 1 cm, with Shift by 10 cm, with Alt by 1 mm; without a selection, the map"],
  ["1 2 3", "the first, second or third answer to a question, or direction of a lane"],
  ["1 2 3 4", "choose the corner that the arrows move; 0 the whole marking"],
  ["Enter", "select what is at the crosshair, or the nearest"],
  ["Escape", "end a tool; then leave the selection"],
];
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
function arrow([dx, dy], event) {
  if (selected && isMovable(selected) && tool === "select" && !isGone(selected)) {
    const by = STEP_M * (event.shiftKey ? 10 : event.altKey ? 0.1 : 1);
    return nudge(dx * by, dy * by);
  }
  pointer = null;
  const share = event.shiftKey ? 3 * PAN_SHARE : event.altKey ? 0.01 : PAN_SHARE;
  view.east += dx * share * view.width / view.scale;
  view.north += dy * share * view.width / view.scale;
  where();
  return drawing.later();
}
function enter() {
  const last = course.at(-1);
  if (tool === "draw" && last && Math.hypot(cursor()[0] - last[0], cursor()[1] - last[1]) * view.scale < 2) return finish();
  if (tool !== "select") return click(pointer ?? [view.width / 2, view.height / 2]);
  const middle = pointer ?? [view.width / 2, view.height / 2];
  return select(hit(middle) ?? nearest(view.toMap(middle)));
}
function escape() {
  if (tool !== "select") return setTool("select");
  if (corner !== null) { corner = null; return drawing.later(); }
  pointer = null;
  return select(null);
}
addEventListener("keydown", (event) => {
  const inField = event.target.closest?.("input, select, textarea, dialog");
  if (event.key === "Escape" && inField && !event.target.closest("dialog")) return isFocus();
  if (inField) return undefined;
  if (event.ctrlKey || event.metaKey) {
    if (event.key.toLowerCase() === "z") { event.preventDefault(); return event.shiftKey ? redo() : undo(); }
    if (event.key.toLowerCase() === "y") { event.preventDefault(); return redo(); }
    return undefined;
  }
  const onMap = event.target === canvas || event.target === document.body;
  if (ARROWS[event.key] && onMap) { event.preventDefault(); return arrow(ARROWS[event.key], event); }
  if (event.key === "Enter" && onMap) { event.preventDefault(); return enter(); }
  if (event.key === "Escape") return escape();
  const choice = choicesOf(selected)[Number(event.key) - 1];
  if (choice) return answer(choice);
  if (/^[0-4]$/.test(event.key) && selected && isMovable(selected)) {
    corner = event.key === "0" ? null : Number(event.key) - 1;
    tell(corner === null ? "The whole marking" : `Corner ${corner + 1}`);
    return drawing.later();
  }
  const known = KEYS.find(([key]) => key === event.key) ?? KEYS.find(([key]) => key.length === 1 && event.altKey && key === event.key);
  if (!known) return undefined;
  event.preventDefault();
  return known[2](event);
});

// ---- the panel ----
const panel = new Panel(model, { accept, remove, classify, restore, answer, link, split, join, choose: (feature) => show(feature) });
const LAYERS = { before: "before the corrections", candidates: "left-out candidates", route: "route", lanes: "lanes and their directions", questions: "questions on lanes", ...(scene.mosaic ? { mosaic: "ground mosaic" } : {}), ...(scene.background ? { background: `background: ${scene.background}` } : {}) };
const pressed = { i: () => tool === "add", l: () => tool === "draw", m: () => tool === "measure", b: () => drawing.show.before };
const usable = { z: () => edits.done.length, y: () => edits.undone.length, Delete: () => selected && !isGone(selected) };
function buttons() {
  for (const made of byId("tools").children) {
    const { key } = made.dataset;
    if (pressed[key]) made.setAttribute("aria-pressed", String(pressed[key]()));
    if (usable[key]) made.disabled = !usable[key]();
  }
}
for (const [key, name, act, label] of KEYS.filter(([, , , text]) => text)) {
  const made = element("button", { type: "button", "data-key": key, "aria-keyshortcuts": key }, label, element("kbd", { "aria-hidden": "true" }, name));
  made.addEventListener("click", act);
  byId("tools").append(made);
}
for (const [name, says] of [...KEYS.filter(([, told]) => told).map(([, told, , , says]) => [told, says]), ...ALSO]) byId("keys").querySelector("tbody").append(element("tr", {}, element("td", {}, element("kbd", {}, name)), element("td", {}, says)));
byId("find").addEventListener("submit", (event) => {
  event.preventDefault();
  const wanted = byId("find-id").value.trim().toLowerCase();
  const found = model.features.find(({ says }) => says?.toLowerCase() === wanted) ?? model.features.find(({ id, what }) => id === Number(wanted) && ["marking", "symbol"].includes(what));
  byId("find-id").setCustomValidity(found ? "" : "No marking of this number, and no such text.");
  byId("find-id").reportValidity();
  if (found) { show(found); isFocus(); }
});
byId("find-id").addEventListener("input", () => byId("find-id").setCustomValidity(""));

// ---- begin ----
byId("name").textContent = scene.name;
document.title = `${scene.name}: view`;
byId("verdict").replaceChildren(element("b", { class: scene.status }, scene.status), ` ${scene.headline}`);
panel.layers(LAYERS, drawing.show, () => drawing.change());
panel.legend(drawing);
panel.select(null);
drawing.resize();
home();
if (scene.background) {
  const system = scene.systems.find(({ name }) => name === "");
  const failed = () => tell(`${scene.background} has no tile here, or does not answer`);
  const tiles = new Tiles((x, y) => within(system, x, y), () => drawing.change(), failed);
  drawing.backdrops.unshift((context, wide) => drawing.show.background && tiles.draw(context, wide));
}
if (scene.mosaic && drawing.show.mosaic) {
  const picture = new Image();
  picture.onload = () => drawing.change();
  picture.src = "mosaic";
  const [west, south, east, north] = scene.mosaic;
  drawing.backdrops.splice(scene.background ? 1 : 0, 0, (context, wide) => {
    if (!drawing.show.mosaic || !picture.complete || !picture.naturalWidth) return;
    const [[left, top], [right, bottom]] = [wide.toScreen([west, north]), wide.toScreen([east, south])];
    context.drawImage(picture, left, top, right - left, bottom - top);
  });
}
await edits.look(true);
const linked = () => { const feature = model.byKey.get(decodeURIComponent(location.hash.slice(1))); if (feature) show(feature); };
addEventListener("hashchange", linked);
linked();
buttons();
document.documentElement.dataset.ready = String(Math.round(performance.now()));
panel.lists(looks, selected, questions);
lanes.refresh().catch(({ message }) => tell(message)); // for which the map does not wait
window.v2hdmView = { lanes, model, view, drawing, edits, select, show, selected: () => selected }; // for tests and further scripts

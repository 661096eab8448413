// Drawing on two canvases: a picture of the whole map that is kept and shifted while it is panned, and above it
// what changes by the frame: the selection, handles, measured lines and the crosshair.

import { isGone, isLine, isMovable, kindOf, middleOf } from "./model.js";

const SERIES = ["blue", "green", "vermillion", "purple", "orange", "sky", "wine", "teal", "olive", "indigo"];
const MARGIN = 0.3; // of the kept picture around the window, relative to its size
const DOT_PX = 5; // a marking that is smaller is drawn as a dot
const MOST_WITH_EDGES = 1000; // outlines in view that have a dark edge as well
const MOST_IN_PATH = 16; // outlines that are stroked at once
const HANDLE_AWAY_PX = 22; // from a corner to its handle, outwards: handles of a narrow stripe lie apart
const TURN_AWAY_PX = 62; // from the end of a marking to the handle that turns it
export const HANDLE_PX = 9; // radius of a handle

const colours = new Map();
export const colour = (name) => {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
};
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => colours.clear());

export class View {
  constructor() {
    Object.assign(this, { east: 0, north: 0, scale: 10, width: 1, height: 1 });
  }

  toScreen([x, y]) {
    return [this.width / 2 + (x - this.east) * this.scale, this.height / 2 - (y - this.north) * this.scale];
  }

  toMap([left, top]) {
    return [this.east + (left - this.width / 2) / this.scale, this.north - (top - this.height / 2) / this.scale];
  }

  box(margin = 0) {
    const [half, high] = [this.width * (0.5 + margin) / this.scale, this.height * (0.5 + margin) / this.scale];
    return [this.east - half, this.north - high, this.east + half, this.north + high];
  }

  zoomTo(scale, around = [this.width / 2, this.height / 2]) {
    const [x, y] = this.toMap(around);
    this.scale = Math.min(4000, Math.max(0.02, scale));
    this.east = x - (around[0] - this.width / 2) / this.scale;
    this.north = y + (around[1] - this.height / 2) / this.scale;
  }

  fit(places, most = 200) {
    if (!places.length) return;
    const [xs, ys] = [places.map(([x]) => x), places.map(([, y]) => y)];
    const [west, south, east, north] = [xs, ys].map((all) => all.reduce((a, b) => Math.min(a, b))).concat([xs, ys].map((all) => all.reduce((a, b) => Math.max(a, b))));
    [this.east, this.north] = [(west + east) / 2, (south + north) / 2];
    this.scale = Math.min(most, 0.9 * Math.min(this.width / Math.max(east - west, 0.1), this.height / Math.max(north - south, 0.1)));
  }
}

// Corners' handles outwards along the bisector, and one to turn by beyond the longer axis.
export function handlesOf(feature, view) {
  if (!isMovable(feature) || isGone(feature)) return [];
  const corners = feature.places.map((place) => view.toScreen(place));
  const unit = ([x, y]) => { const size = Math.hypot(x, y) || 1; return [x / size, y / size]; };
  const handles = corners.map((corner, n) => {
    const [before, after] = [corners[(n + 3) % 4], corners[(n + 1) % 4]];
    const [a, b] = [before, after].map((other) => unit([corner[0] - other[0], corner[1] - other[1]]));
    const [dx, dy] = unit([a[0] + b[0], a[1] + b[1]]);
    return { corner: n, tip: corner, at: [corner[0] + HANDLE_AWAY_PX * dx, corner[1] + HANDLE_AWAY_PX * dy] };
  });
  const middle = middleOf(corners);
  const sides = [0, 1].map((n) => middleOf([corners[n], corners[n + 1]]));
  const [far] = sides.sort((p, q) => Math.hypot(q[0] - middle[0], q[1] - middle[1]) - Math.hypot(p[0] - middle[0], p[1] - middle[1]));
  const [dx, dy] = unit([far[0] - middle[0], far[1] - middle[1]]);
  handles.push({ turn: true, tip: far, at: [far[0] + TURN_AWAY_PX * dx, far[1] + TURN_AWAY_PX * dy] });
  return handles;
}

export class Drawing {
  constructor(canvas, model, view) {
    Object.assign(this, { canvas, model, view, dirty: true, show: { before: false, mosaic: true, background: true, candidates: true, route: true, lanes: true, questions: true }, backdrops: [] });
    this.context = canvas.getContext("2d");
    this.kept = document.createElement("canvas");
    this.keptContext = this.kept.getContext("2d");
    this.extras = []; // functions that draw above the map, in pixels of the window
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  resize() {
    const { canvas, view } = this;
    const ratio = devicePixelRatio || 1;
    [view.width, view.height] = [Math.max(canvas.clientWidth, 1), Math.max(canvas.clientHeight, 1)];
    [canvas.width, canvas.height] = [Math.round(view.width * ratio), Math.round(view.height * ratio)];
    this.ratio = ratio;
    this.change();
  }

  // Something of the map looks different now.
  change() {
    this.dirty = true;
    this.later();
  }

  later() {
    this.frame ??= requestAnimationFrame(() => { this.frame = null; this.draw(); });
  }

  draw() {
    const { view, context, ratio, kept } = this;
    if (this.dirty || this.outOfKept()) this.keep();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = colour("ground");
    context.fillRect(0, 0, view.width, view.height);
    const by = view.scale / this.keptView.scale;
    const [left, top] = view.toScreen(this.keptView.toMap([0, 0]));
    context.drawImage(kept, left, top, this.keptView.width * by, this.keptView.height * by);
    for (const extra of this.extras) extra(context, view);
    if (by !== 1) { // sharp again when the wheel rests
      clearTimeout(this.sharpen);
      this.sharpen = setTimeout(() => this.change(), 90);
    }
    if (this.model.features.length) this.canvas.dataset.first ??= String(Math.round(performance.now())); // for tests
    this.canvas.dataset.drawn = String(Number(this.canvas.dataset.drawn ?? 0) + 1);
  }

  outOfKept() {
    const { view, keptView } = this;
    if (!keptView) return true;
    const by = view.scale / keptView.scale;
    if (by > 2.5 || by < 0.4) return true;
    const [west, south, east, north] = view.box();
    const [left, low, right, high] = keptView.box();
    const isBeyond = west < left || south < low || east > right || north > high;
    return isBeyond && by === 1;
  }

  keep() {
    const { view, kept, ratio } = this;
    const wide = Object.assign(new View(), view, { width: Math.round(view.width * (1 + 2 * MARGIN)), height: Math.round(view.height * (1 + 2 * MARGIN)) });
    const size = [Math.round(wide.width * ratio), Math.round(wide.height * ratio)];
    if (kept.width !== size[0] || kept.height !== size[1]) [kept.width, kept.height] = size;
    const context = this.keptContext;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, wide.width, wide.height);
    this.keptView = wide;
    this.dirty = false;
    for (const backdrop of this.backdrops) backdrop(context, wide);
    if (this.show.route) this.line(context, wide, this.model.route, { stroke: colour("muted"), width: 1, dash: [2, 5] });
    for (const feature of this.model.lines) this.lane(context, wide, feature);
    this.features(context, wide);
  }

  lane(context, view, feature) {
    if (isGone(feature) && feature.what === "drawn") return;
    const dash = isGone(feature) ? [2, 6] : kindOf(feature) === "lane_dash" ? [10, 8] : [];
    this.line(context, view, feature.places, { stroke: colour(isGone(feature) ? "vermillion" : "sky"), width: feature.entry ? 3 : 2, dash });
  }

  features(context, view) {
    const groups = new Map();
    const dots = new Map();
    let count = 0;
    const put = (map, key, feature) => { if (!map.has(key)) map.set(key, []); map.get(key).push(feature); };
    for (const feature of this.model.within(view.box(0.02))) {
      if (feature === this.lifted) continue;
      if (feature.what === "candidate") {
        if (this.show.candidates || feature.entry) put(dots, feature.entry?.says === "accepted" ? "accepted" : "candidate", feature);
        continue;
      }
      if (feature.what === "added" && isGone(feature)) continue;
      const [[ax, ay], , [bx, by] = [ax, ay]] = feature.places;
      const isSmall = Math.max(Math.abs(ax - bx), Math.abs(ay - by)) * view.scale < DOT_PX;
      put(isSmall ? dots : groups, isGone(feature) ? "gone" : feature.entry ? `corrected ${this.colourOf(feature)}` : this.colourOf(feature), feature);
      count += 1;
    }
    for (const [key, features] of groups) {
      const isGroupGone = key === "gone";
      const name = key.replace("corrected ", "");
      const paths = pathsOf(features, view);
      if (count < MOST_WITH_EDGES) for (const path of paths) stroke(context, path, "rgb(0 0 0 / .5)", 3.6, []);
      for (const path of paths) stroke(context, path, colour(isGroupGone ? "vermillion" : name), key === name && !isGroupGone ? 1.6 : 2.6, isGroupGone ? [3, 4] : []);
    }
    for (const [key, features] of dots) this.dots(context, view, key, features);
    if (this.show.before) {
      const path = new Path2D();
      for (const feature of this.model.corrected) if (feature.entry.moved) trace(path, feature.base, view);
      stroke(context, path, colour("ink"), 1.2, [2, 3]);
    }
  }

  dots(context, view, key, features) {
    if (key === "candidate" || key === "accepted") {
      const path = new Path2D();
      for (const { places: [place] } of features) {
        const [x, y] = view.toScreen(place);
        path.moveTo(x + 4, y);
        path.arc(x, y, 4, 0, 7);
      }
      stroke(context, path, colour(key === "candidate" ? "vermillion" : "green"), key === "candidate" ? 1.2 : 2.5, key === "candidate" ? [2, 1.5] : []);
      return;
    }
    context.fillStyle = colour(key === "gone" ? "vermillion" : key.replace("corrected ", ""));
    for (const { places: [place] } of features) {
      const [x, y] = view.toScreen(place);
      context.fillRect(x - 1, y - 1, 2.5, 2.5);
    }
  }

  colourOf(feature) {
    const number = this.model.scene.kinds.indexOf(kindOf(feature));
    return SERIES[(number < 0 ? SERIES.length - 1 : number) % SERIES.length];
  }

  line(context, view, line, { stroke: ink, width, dash = [] }) {
    const path = new Path2D();
    line.forEach((place, n) => (n ? path.lineTo(...view.toScreen(place)) : path.moveTo(...view.toScreen(place))));
    stroke(context, path, ink, width, dash);
  }

  outline(context, feature, ink, width) {
    const path = new Path2D();
    if (feature.places.length < 2) {
      const [x, y] = this.view.toScreen(feature.places[0]);
      path.arc(x, y, 9, 0, 7);
    } else trace(path, feature.places, this.view, !isLine(feature) && !["lane", "question"].includes(feature.what));
    stroke(context, path, "rgb(255 255 255 / .85)", width + 1.6, []);
    stroke(context, path, ink, width, isGone(feature) ? [4, 4] : []);
  }

  handles(context, feature, chosen) {
    for (const handle of handlesOf(feature, this.view)) {
      context.beginPath();
      context.moveTo(...handle.tip);
      context.lineTo(...handle.at);
      context.strokeStyle = colour("accent");
      context.lineWidth = 1;
      context.setLineDash([]);
      context.stroke();
      context.beginPath();
      context.arc(...handle.at, HANDLE_PX, 0, 7);
      context.fillStyle = chosen === handle.corner && !handle.turn ? colour("accent") : colour("paper");
      context.fill();
      context.lineWidth = 2;
      context.stroke();
      context.fillStyle = chosen === handle.corner && !handle.turn ? colour("paper") : colour("ink");
      context.font = "11px system-ui, sans-serif";
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillText(handle.turn ? "\u21bb" : String(handle.corner + 1), handle.at[0], handle.at[1] + 0.5);
    }
  }
}

// Outlines in paths of a few each: the browser takes far longer for one path of thousands.
function pathsOf(features, view) {
  const paths = [];
  for (let n = 0; n < features.length; n += MOST_IN_PATH) {
    const path = new Path2D();
    for (const { places } of features.slice(n, n + MOST_IN_PATH)) trace(path, places, view);
    paths.push(path);
  }
  return paths;
}

function trace(path, places, view, isClosed = true) {
  const { width, height, east, north, scale } = view;
  const [left, top] = [width / 2 - east * scale, height / 2 + north * scale];
  path.moveTo(left + places[0][0] * scale, top - places[0][1] * scale);
  for (let n = 1; n < places.length; n++) path.lineTo(left + places[n][0] * scale, top - places[n][1] * scale);
  if (isClosed) path.closePath();
}

function stroke(context, path, ink, width, dash) {
  context.strokeStyle = ink;
  context.lineWidth = width;
  context.setLineDash(dash);
  context.lineJoin = "round";
  context.stroke(path);
}

// The map as it is shown: features of the result, each with a person's correction of it, if any.
// Places are [east, north] in metres of the map frame.

const CELL_M = 10; // side of the cells in which features are looked up by their middle

const points = (flat) => {
  const places = [];
  for (let n = 0; n < flat.length; n += 2) places.push([flat[n] / 1000, flat[n + 1] / 1000]);
  return places;
};

export const middleOf = (places) => {
  const sum = places.reduce(([x, y], [east, north]) => [x + east, y + north], [0, 0]);
  return [sum[0] / places.length, sum[1] / places.length];
};

export const words = (kind) => kind.replaceAll("_", " ");

export class Model {
  constructor(scene) {
    this.scene = scene;
    this.features = [];
    this.byKey = new Map();
    this.cells = new Map();
    const { kinds } = scene;
    // Areas lie below the markings in them.
    for (const symbol of scene.symbols.filter(({ area }) => area)) this.take(symbol, "symbol", `s${symbol.id}`);
    for (const marking of scene.markings) this.take(marking, "marking", `m${marking.id}`);
    for (const symbol of scene.symbols.filter(({ area }) => !area)) this.take(symbol, "symbol", `s${symbol.id}`);
    scene.excluded.forEach((candidate, n) => this.take(candidate, "candidate", `x${n}`));
    this.lanes = scene.lanes.map((lane) => ({ kind: kinds[lane.k], line: points(lane.p), id: lane.id }));
    this.route = points(scene.route);
  }

  take({ p, k, ...about }, what, key) {
    this.add({ ...about, what, key, kind: this.scene.kinds[k], base: points(p), entry: null });
  }

  add(feature) {
    feature.places = feature.base;
    this.features.push(feature);
    this.byKey.set(feature.key, feature);
    this.index(feature);
  }

  index(feature) {
    const [x, y] = middleOf(feature.places);
    const cell = `${Math.floor(x / CELL_M)},${Math.floor(y / CELL_M)}`;
    if (feature.cell === cell) return;
    this.cells.get(feature.cell)?.delete(feature);
    feature.cell = cell;
    if (!this.cells.has(cell)) this.cells.set(cell, new Set());
    this.cells.get(cell).add(feature);
  }

  // Features whose middle lies within a box, from below to above.
  *within([west, south, east, north]) {
    const [left, low, right, high] = [west, south, east, north].map((edge) => Math.floor(edge / CELL_M));
    if ((right - left + 1) * (high - low + 1) > this.cells.size) {
      yield* this.features;
      return;
    }
    for (let x = left; x <= right; x++) for (let y = low; y <= high; y++) yield* this.cells.get(`${x},${y}`) ?? [];
  }

  // A new marking of a person; its correction says where it is.
  addedBy(entry, key) {
    const what = entry.says === "added" ? "added" : "elsewhere"; // a correction of what is not in this map
    const feature = { what, key, kind: entry.class, base: entry.outline_map, entry: null };
    this.add(feature);
    return feature;
  }

  // The correction of a feature, or null; the outline follows.
  state(feature, entry) {
    feature.entry = entry;
    if (feature.what === "added") feature.places = entry?.outline_map ?? feature.places;
    else feature.places = entry?.moved ? feature.base.map((place, n) => entry.moved[n + 1] ?? place) : feature.base;
    this.index(feature);
  }

  rename(feature, key) {
    if (this.byKey.get(feature.key) === feature) this.byKey.delete(feature.key);
    feature.key = key;
    this.byKey.set(key, feature);
  }

  get corrected() {
    return this.features.filter(({ entry }) => entry);
  }
}

export const kindOf = (feature) => feature.entry?.new_class ?? feature.entry?.class ?? feature.kind;
export const isGone = (feature) => (feature.what === "added" ? !feature.entry : feature.entry?.says === "rejected");
// Candidates are places without an outline; only four corners can be moved.
export const isMovable = (feature) => feature.places.length === 4 && ["marking", "added"].includes(feature.what);
export const nameOf = (feature) => {
  const name = { marking: "Marking", symbol: "Symbol", candidate: "Left out", added: "Added", elsewhere: "Not in this map" }[feature.what];
  return `${name}${feature.id === undefined ? "" : ` ${feature.id}`}, ${words(kindOf(feature))}`;
};

// What a correction says, in words.
export function saidOf({ what, entry }) {
  if (!entry) return "";
  const parts = [];
  if (entry.says === "rejected") parts.push(entry.reason ? `deleted: ${entry.reason}` : "deleted");
  else if (entry.says === "added") parts.push("added");
  else if (entry.says === "accepted") parts.push("accepted");
  if (entry.new_class && what !== "added") parts.push(`class ${words(entry.new_class)}`);
  const count = Object.keys(entry.moved ?? {}).length;
  if (count) parts.push(count === 4 ? "moved" : `${count} ${count === 1 ? "corner" : "corners"} moved`);
  return parts.join(", ") || entry.says;
}

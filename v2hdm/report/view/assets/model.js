// The map as it is shown: features of the result, each with a person's correction of it, if any.
// Places are [east, north] in metres of the map frame.

const CELL_M = 10; // side of the cells in which features are looked up by their middle

export const points = (flat) => {
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
    this.features = []; // of paint
    this.questions = []; // on lanes
    this.lines = []; // lane lines, which are too long to be looked up by their middle
    this.byKey = new Map();
    this.cells = new Map();
    // Areas lie below the markings in them.
    for (const symbol of scene.symbols.filter(({ area }) => area)) this.take(symbol, "symbol", `s${symbol.id}`);
    for (const marking of scene.markings) this.take(marking, "marking", `m${marking.id}`);
    for (const symbol of scene.symbols.filter(({ area }) => !area)) this.take(symbol, "symbol", `s${symbol.id}`);
    scene.excluded.forEach((candidate, n) => this.take(candidate, "candidate", `x${n}`));
    scene.lanes.forEach((lane, n) => this.take(lane, "line", `l${n}`));
    this.route = points(scene.route);
  }

  take({ p, k, ...about }, what, key) {
    this.add({ ...about, what, key, kind: this.scene.kinds[k], base: points(p), entry: null });
  }

  add(feature) {
    feature.places = feature.base;
    (feature.what === "question" ? this.questions : isLine(feature) ? this.lines : this.features).push(feature);
    this.byKey.set(feature.key, feature);
    this.index(feature);
  }

  index(feature) {
    if (isLine(feature) || feature.what === "question") return;
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
    if (entry.says === "answered") return this.askedBy({ key, subject: entry.subject, text: "" }, entry.places_map);
    const isAdded = entry.says === "added"; // else a correction of what is not in this map
    const what = entry.line_map ? (isAdded ? "drawn" : "line") : isAdded ? "added" : "elsewhere";
    const feature = { what, key, kind: entry.class, base: entry.line_map ?? entry.outline_map, entry: null };
    this.add(feature);
    return feature;
  }

  askedBy(about, base) {
    const feature = { ...about, what: "question", kind: about.subject, base, entry: null, open: false };
    this.add(feature);
    return feature;
  }

  // The questions that are open now.
  ask(questions) {
    for (const question of this.questions) question.open = false;
    for (const { p, ...about } of questions) {
      const known = this.byKey.get(about.key) ?? this.askedBy(about, points(p));
      Object.assign(known, { open: true, text: about.text });
    }
  }

  // The correction of a feature, or null; the outline follows.
  state(feature, entry) {
    feature.entry = entry;
    if (feature.what === "drawn") feature.places = entry?.line_map ?? feature.places;
    else if (feature.what === "added") feature.places = entry?.outline_map ?? feature.places;
    else feature.places = entry?.moved ? feature.base.map((place, n) => entry.moved[n + 1] ?? place) : feature.base;
    this.index(feature);
  }

  rename(feature, key) {
    if (this.byKey.get(feature.key) === feature) this.byKey.delete(feature.key);
    feature.key = key;
    this.byKey.set(key, feature);
  }

  get corrected() {
    return [...this.features, ...this.lines, ...this.questions].filter(({ entry }) => entry);
  }
}

// What answers a question, in the order of its keys; nothing where a person writes the answer.
export const answersOf = (subject) => ({ direction: ["along", "against", "both"], connection: ["yes", "no"], "right of way": ["yes", "no"], "two ways": ["yes"], line: ["noted"] })[subject] ?? [];

export const kindOf = (feature) => feature.entry?.new_class ?? feature.entry?.class ?? feature.kind;
export const isLine = ({ what }) => what === "line" || what === "drawn";
// What is there only because a person put it there.
export const isMade = ({ what }) => what === "added" || what === "drawn";
export const isGone = (feature) => (isMade(feature) ? !feature.entry : feature.entry?.says === "rejected");
// Candidates are places without an outline; only four corners can be moved.
export const isMovable = (feature) => feature.places.length === 4 && ["marking", "added"].includes(feature.what);
export const nameOf = (feature) => {
  const name = { marking: "Marking", symbol: "Symbol", candidate: "Left out", added: "Added", line: "Lane line", drawn: "Drawn lane line", elsewhere: "Not in this map", question: "Question", lane: "Lane" }[feature.what];
  return `${name}${feature.id === undefined ? "" : ` ${feature.id}`}, ${words(kindOf(feature))}`;
};

// What a correction says, in words.
export function saidOf({ what, entry }) {
  if (!entry) return "";
  if (entry.says === "answered") return `answered: ${entry.answer}`;
  const parts = [];
  if (entry.says === "rejected") parts.push(entry.reason ? `deleted: ${entry.reason}` : "deleted");
  else if (entry.says === "added") parts.push(what === "drawn" ? "drawn" : "added");
  else if (entry.says === "accepted") parts.push("accepted");
  if (entry.new_class && what !== "added") parts.push(`class ${words(entry.new_class)}`);
  const count = Object.keys(entry.moved ?? {}).length;
  if (count) parts.push(count === 4 ? "moved" : `${count} ${count === 1 ? "corner" : "corners"} moved`);
  return parts.join(", ") || entry.says;
}

// Lane lines that a person draws, splits and joins: each change as the lines it leaves out and puts there.

const round = (places) => places.map((at) => at.map((value) => Math.round(value * 1e4) / 1e4));
const side = ([ax, ay], [bx, by], [cx, cy]) => (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
const away = ([ax, ay], [bx, by]) => Math.hypot(ax - bx, ay - by);

export function crossesItself(line) {
  for (let n = 0; n + 1 < line.length; n++) {
    for (let m = n + 2; m + 1 < line.length; m++) {
      const [a, b, c, d] = [line[n], line[n + 1], line[m], line[m + 1]];
      if (side(a, b, c) * side(a, b, d) < 0 && side(c, d, a) * side(c, d, b) < 0) return true;
    }
  }
  return false;
}

// The change that puts a line there.
export function drawn(model, kind, line) {
  const entry = { says: "added", class: kind, line_map: round(line) };
  return [model.addedBy(entry, `new ${Date.now()} ${model.lines.length}`), entry];
}

// The change that takes a line away: out of the map, or what a person drew.
export const taken = (feature) => [feature, feature.what === "drawn" ? null : { says: "rejected", class: feature.kind, line_map: feature.base }];

// Both parts of a line, cut at the place on it that is nearest to a point; null at its ends.
export function parts(line, [px, py]) {
  let best = { off: Infinity };
  for (let n = 0; n + 1 < line.length; n++) {
    const [[ax, ay], [bx, by]] = [line[n], line[n + 1]];
    const [dx, dy] = [bx - ax, by - ay];
    const share = Math.max(0, Math.min(1, ((px - ax) * dx + (py - ay) * dy) / (dx * dx + dy * dy || 1)));
    const at = [ax + share * dx, ay + share * dy];
    if (away(at, [px, py]) < best.off) best = { off: away(at, [px, py]), n, at };
  }
  const cut = [[...line.slice(0, best.n + 1), best.at], [best.at, ...line.slice(best.n + 1)]];
  return away(best.at, line[0]) < 0.1 || away(best.at, line.at(-1)) < 0.1 ? null : cut;
}

// The other line whose end is nearest to an end of this one, and both as one line.
export function joined(line, others) {
  let best = null;
  for (const other of others) {
    for (const [first, second] of [[line, other.places], [line, other.places.toReversed()], [other.places, line], [other.places.toReversed(), line]]) {
      const gap = away(first.at(-1), second[0]);
      if (!best || gap < best.gap) best = { gap, other, line: [...first, ...second] };
    }
  }
  return best;
}

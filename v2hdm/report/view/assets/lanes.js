// Lanes and the questions that lines and paths leave open: how they look, and what answers them.

import { colour } from "./drawing.js";
import { answersOf, points } from "./model.js";

const ARROW_PX = 70; // from arrow to arrow along a lane
const BADGE_PX = 10; // radius of the mark of a question
const SAME_M = 1.5; // from the place of an answer to the lane that it is about
const KNOWN = { driven: "driven", stated: "direction stated", drawn: "as its lines", asked: "direction open" };
const INKS = { driven: "teal", stated: "accent", drawn: "olive", asked: "vermillion" };

const away = ([ax, ay], [bx, by]) => Math.hypot(ax - bx, ay - by);

export class Lanes {
  constructor(model, changed) {
    Object.assign(this, { model, changed, lanes: [], refused: [], stale: false });
  }

  // What lines, paths and answers say now.
  async refresh() {
    this.stale = false;
    const answer = await fetch("lanes.json");
    if (!answer.ok) throw new Error(await answer.text());
    const { lanes, questions, refused } = await answer.json();
    this.lanes = lanes.map(({ p, ...about }, n) => ({ ...about, what: "lane", key: `lane ${n}`, kind: KNOWN[about.by], places: points(p), base: points(p), entry: null }));
    this.refused = refused;
    this.model.ask(questions);
    this.changed();
  }

  // The lane after a change that is the one before it.
  again(lane) {
    const near = ({ places }) => away(places[0], lane.places[0]) + away(places.at(-1), lane.places.at(-1));
    const turned = ({ places }) => away(places[0], lane.places.at(-1)) + away(places.at(-1), lane.places[0]);
    return this.lanes.find((other) => Math.min(near(other), turned(other)) < SAME_M) ?? null;
  }

  draw(context, view) {
    for (const lane of this.lanes) {
      const ink = colour(INKS[lane.by]);
      const places = lane.places.map((place) => view.toScreen(place));
      context.strokeStyle = context.fillStyle = ink;
      context.lineWidth = 1.2;
      context.setLineDash(lane.by === "asked" ? [2, 5] : [9, 5]);
      context.beginPath();
      places.forEach((place, n) => (n ? context.lineTo(...place) : context.moveTo(...place)));
      context.stroke();
      context.setLineDash([]);
      arrows(context, places, lane.by === "asked");
    }
  }

  marks(context, view) {
    for (const question of this.model.questions) {
      if (!question.open && !question.entry) continue;
      const [at, to] = question.places.map((place) => view.toScreen(place));
      const ink = colour(question.entry ? "green" : "vermillion");
      context.strokeStyle = context.fillStyle = ink;
      context.lineWidth = 2;
      if (to) {
        context.setLineDash([4, 4]);
        context.beginPath();
        context.moveTo(...at);
        context.lineTo(...to);
        context.stroke();
        context.setLineDash([]);
        arrow(context, at, to, 1);
      }
      context.beginPath();
      context.arc(...at, BADGE_PX, 0, 7);
      context.fill();
      context.fillStyle = colour("paper");
      context.font = "bold 13px system-ui, sans-serif";
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillText(question.entry ? "\u2713" : "?", at[0], at[1] + 0.5);
    }
  }

  question(at, view) {
    return this.model.questions.find(({ open, entry, places }) => (open || entry) && away(view.toScreen(places[0]), at) <= BADGE_PX + 2) ?? null;
  }

  lane(at, view, off, near) {
    let [best, least] = [null, near];
    for (const lane of this.lanes) {
      const places = lane.places.map((place) => view.toScreen(place));
      for (let n = 0; n + 1 < places.length; n++) {
        const far = off(at, places[n], places[n + 1]);
        if (far < least) [best, least] = [lane, far];
      }
    }
    return best;
  }

  // The question that an answer on a lane's direction belongs to: one that is there, or a new one.
  asked(lane, entry) {
    const isOf = ({ subject, places }) => subject === "direction" && lane.places.some((place, n) => n && toPiece(places[0], lane.places[n - 1], place) < SAME_M);
    return this.model.questions.find((question) => (question.open || question.entry) && isOf(question)) ?? this.model.addedBy(entry, `new ${Date.now()}`);
  }
}

// Two places amid a lane, along it: those of an answer on its direction.
export function amid({ places }) {
  const lengths = places.slice(1).map((place, n) => away(place, places[n]));
  const length = lengths.reduce((sum, part) => sum + part, 0);
  const at = (wanted) => {
    let left = wanted;
    for (let n = 0; n < lengths.length; n++) {
      if (left <= lengths[n] || n === lengths.length - 1) {
        const share = lengths[n] ? left / lengths[n] : 0;
        return [0, 1].map((axis) => Math.round(1e3 * (places[n][axis] + share * (places[n + 1][axis] - places[n][axis]))) / 1e3);
      }
      left -= lengths[n];
    }
    return places[0];
  };
  return [at(length / 2), at(Math.min(length, length / 2 + 5))];
}

// The entry that answers a question; null takes the answer back.
export const answered = ({ subject, base }, answer) => (answer === null ? null : { says: "answered", subject, answer, places_map: base });

// An answer in words of the lane, said of the line of the question, which may run the other way.
export function ofQuestion(answer, lane, question) {
  const [[ax, ay], [bx, by]] = amid(lane);
  const [[cx, cy], [dx, dy]] = question.base;
  const isSame = (bx - ax) * (dx - cx) + (by - ay) * (dy - cy) >= 0;
  return isSame || answer === "both" ? answer : { along: "against", against: "along" }[answer];
}

export const choicesOf = (feature) => (feature?.what === "lane" ? answersOf("direction") : feature?.what === "question" ? answersOf(feature.subject) : []);

const offOf = ([px, py], [ax, ay], [bx, by]) => {
  const [dx, dy] = [bx - ax, by - ay];
  const share = Math.max(0, Math.min(1, ((px - ax) * dx + (py - ay) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(px - ax - share * dx, py - ay - share * dy);
};
const toPiece = offOf;

function arrow(context, [ax, ay], [bx, by], share) {
  const angle = Math.atan2(by - ay, bx - ax);
  const [x, y] = [ax + share * (bx - ax), ay + share * (by - ay)];
  context.beginPath();
  context.moveTo(x, y);
  for (const side of [-1, 1]) context.lineTo(x - 9 * Math.cos(angle + 0.45 * side), y - 9 * Math.sin(angle + 0.45 * side));
  context.fill();
}

function arrows(context, places, isBoth) {
  let left = ARROW_PX / 2;
  for (let n = 0; n + 1 < places.length; n++) {
    const length = away(places[n], places[n + 1]);
    while (left < length) {
      arrow(context, places[n], places[n + 1], left / length);
      if (isBoth) arrow(context, places[n + 1], places[n], 1 - left / length);
      left += ARROW_PX;
    }
    left -= length;
  }
}

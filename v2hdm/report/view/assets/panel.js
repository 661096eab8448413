// What stands beside the map: the selection, lists to go through, layers. Names only become text nodes.

import { choicesOf } from "./lanes.js";
import { isGone, isLine, isMade, isMovable, kindOf, middleOf, nameOf, saidOf, words } from "./model.js";

const LANE_SAYS = { driven: "A drive went along it in the direction of its arrows.", stated: "A person stated its direction.", drawn: "It runs as its lines do: no path of a drive is known.", asked: "No drive went along it; its direction is open." };
const LISTED = 200; // entries of a list at once

export const byId = (id) => document.getElementById(id);

export function element(tag, attributes = {}, ...children) {
  const svg = ["svg", "image", "polygon", "path", "line"].includes(tag);
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

const button = (label, act, attributes = {}) => {
  const made = element("button", { type: "button", ...attributes }, ...[label].flat());
  made.addEventListener("click", act);
  return made;
};

// Facts of a feature as pairs of name and value.
export function factsOf(feature) {
  const facts = [];
  if (feature.n !== undefined) facts.push(["seen in", `${feature.n} images`]);
  if (feature.says) facts.push(["says", feature.says]);
  if (feature.g) facts.push(["accuracy", feature.g]);
  if (feature.w !== undefined) facts.push(["95 % radius", `${(feature.w / 10).toFixed(1)} cm (worst corner)`]);
  if (feature.why) facts.push(["left out", feature.why]);
  if (isMovable(feature)) {
    const sides = [0, 1].map((n) => Math.hypot(feature.places[n + 1][0] - feature.places[n][0], feature.places[n + 1][1] - feature.places[n][1]));
    facts.push(["size", `${Math.max(...sides).toFixed(2)} m by ${Math.min(...sides).toFixed(2)} m`]);
  }
  if (isLine(feature)) facts.push(["length", `${feature.places.slice(1).reduce((sum, [x, y], n) => sum + Math.hypot(x - feature.places[n][0], y - feature.places[n][1]), 0).toFixed(1)} m`]);
  const [x, y] = middleOf(feature.places);
  facts.push(["middle", `${x.toFixed(2)} m E, ${y.toFixed(2)} m N`]);
  return facts;
}

export class Panel {
  // `act` has what the buttons do: accept, remove, classify, restore, choose, link.
  constructor(model, act) {
    this.model = model;
    this.act = act;
  }

  select(feature) {
    const section = byId("selected");
    const focused = document.activeElement?.id;
    if (!feature) {
      this.feature = null;
      section.replaceChildren(element("h2", {}, "Nothing selected"), element("p", { class: "hint", id: "keys-hint" }, "Select a marking with the mouse, or press N for the next suspicious one. Press ? for all keys."));
      return;
    }
    if (["question", "lane"].includes(feature.what)) {
      // Lanes that arrive meanwhile draw the panel again: an answer that is being typed stays.
      const typed = focused === "answer" && this.feature?.subject === feature.subject ? byId("answer").value : null;
      this.feature = feature;
      section.replaceChildren(...this.asked(feature));
      if (typed !== null && byId("answer")) {
        byId("answer").value = typed;
        byId("answer").focus();
      }
      return;
    }
    const { act } = this;
    const isSame = feature === this.feature;
    this.feature = feature;
    const facts = factsOf(feature).flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]);
    const kind = element("select", { id: "edit-class" });
    const choices = isLine(feature) ? this.model.scene.line_kinds : feature.what === "added" ? this.model.scene.cornered : this.model.scene.choices;
    for (const name of new Set([...choices, kindOf(feature)])) kind.append(element("option", { value: name }, words(name)));
    kind.value = kindOf(feature);
    kind.addEventListener("change", () => act.classify(kind.value));
    const reason = element("input", { id: "edit-reason", placeholder: "manhole, shadow", maxlength: "200" });
    reason.value = feature.entry?.reason ?? "";
    reason.addEventListener("keydown", (event) => { if (event.key === "Enter") act.remove(reason.value); });
    const rows = [
      element("div", { class: "row" }, ...(isMade(feature) || isLine(feature) ? [] : [button("Accept", act.accept, { "aria-keyshortcuts": "a" })]), button("Delete", () => act.remove(reason.value), { "aria-keyshortcuts": "Delete" }),
        ...(feature.entry && !isMade(feature) ? [button("Take back", act.restore)] : []), button("Copy link", act.link, { "aria-keyshortcuts": "p" })),
      ...(isLine(feature) ? [element("div", { class: "row" }, button("Split", act.split, { "aria-keyshortcuts": "s" }), button("Join", act.join, { "aria-keyshortcuts": "j" }))] : []),
      ...(feature.what === "line" ? [] : [element("div", { class: "row" }, element("label", { for: "edit-class" }, "Class"), kind)]),
    ];
    if (!isMade(feature)) rows.push(element("div", { class: "row" }, element("label", { for: "edit-reason" }, "Reason"), reason));
    const head = [element("h2", {}, nameOf(feature)), element("p", { class: "said" }, saidOf(feature)), element("dl", {}, ...facts)];
    if (isSame && ["edit-class", "edit-reason"].includes(focused)) { // a field that is being used stays
      head.forEach((part, n) => section.children[n].replaceWith(part));
      return;
    }
    section.replaceChildren(...head, ...rows);
    if (focused && section.querySelector(`#${focused}`)) byId(focused).focus();
  }

  // A question on lanes, or a lane whose direction a person may state.
  asked(feature) {
    const { act } = this;
    const hint = feature.what === "lane" ? LANE_SAYS[feature.by] : feature.text;
    const rows = choicesOf(feature).map((answer, n) => button([answer, " ", element("kbd", { "aria-hidden": "true" }, String(n + 1))], () => act.answer(answer), { "aria-keyshortcuts": String(n + 1), "aria-pressed": String(feature.entry?.answer === answer) }));
    const head = [element("h2", {}, nameOf(feature)), element("p", { class: "said" }, saidOf(feature)), element("p", { class: "row" }, hint ?? "")];
    if (feature.what === "question" && !rows.length) {
      const field = element("input", { id: "answer", "aria-label": "Answer", maxlength: "200", ...(feature.subject === "speed" ? { placeholder: "km/h, such as 30", inputmode: "decimal" } : { placeholder: "answer" }) });
      field.value = feature.entry?.answer ?? "";
      field.addEventListener("keydown", (event) => {
        if (event.key !== "Enter") return;
        field.blur();  // further keys are the map's
        act.answer(field.value.trim());
      });
      rows.push(field, button("Answer", () => act.answer(field.value.trim())));
    }
    if (feature.entry) rows.push(button("Take back", act.restore));
    return [...head, element("div", { class: "row" }, ...rows)];
  }

  lists(looks, chosen, questions) {
    const asked = questions.slice(0, LISTED).map(({ feature, why }) => element("li", {}, button(`${feature.what === "question" ? words(feature.subject) : nameOf(feature)}: ${why}${feature.entry ? " \u2713" : ""}`, () => this.act.choose(feature), feature === chosen ? { "aria-current": "true" } : {})));
    byId("questions").replaceChildren(...asked);
    byId("questions-title").textContent = `Questions (${questions.filter(({ feature }) => !feature.entry).length} open)`;
    const rows = looks.slice(0, LISTED).map(({ feature, why }) => element("li", {}, button(`${nameOf(feature)}: ${why}${feature.entry ? " \u2713" : ""}`, () => this.act.choose(feature), feature === chosen ? { "aria-current": "true" } : {})));
    byId("look").replaceChildren(...rows);
    const made = this.model.corrected.slice(-LISTED).reverse();
    byId("made").replaceChildren(...made.map((feature) => element("li", {}, button(`${nameOf(feature)}: ${saidOf(feature)}`, () => this.act.choose(feature), feature === chosen ? { "aria-current": "true" } : {}))));
    byId("made-title").textContent = `Corrections (${this.model.corrected.length})`;
  }

  layers(names, show, changed) {
    byId("layers").replaceChildren(...Object.entries(names).map(([name, label]) => {
      const box = element("input", { type: "checkbox", id: `layer-${name}` });
      box.checked = show[name];
      box.addEventListener("change", () => { show[name] = box.checked; changed(); });
      return element("label", {}, box, label);
    }));
  }

  legend(drawing) {
    const kinds = new Set(this.model.features.map(kindOf));
    byId("legend").replaceChildren(...[...kinds].sort().map((kind) => {
      const swatch = element("svg", { viewBox: "0 0 24 12", "aria-hidden": "true" }, element("polygon", { points: "12,1 22,6 12,11 2,6", fill: "none", stroke: `var(--${drawing.colourOf({ kind })})`, "stroke-width": "2" }));
      return element("div", {}, swatch, words(kind));
    }));
  }
}

// The images that show a feature, with its outline as it is now; `start` is the first of them.
export class Images {
  async show(feature, start = 0) {
    this.feature = feature;
    byId("images").hidden = !feature;
    if (!feature) return;
    const outline = feature.places;
    if (!start) byId("shots").replaceChildren(element("p", { class: "hint" }, "Looking for them\u2026"));
    const query = new URLSearchParams({ outline: JSON.stringify(outline), start, ...(feature.what === "marking" ? { marking: feature.id } : {}) });
    const answer = await fetch(`shots.json?${query}`);
    if (feature !== this.feature || outline !== feature.places) return; // something else by now
    if (!answer.ok) {
      byId("shots").replaceChildren(element("p", { class: "hint" }, await answer.text()));
      return;
    }
    const { count, shots, says } = await answer.json();
    const figures = shots.map((shot) => this.figure(shot));
    if (start > 0) figures.unshift(...byId("shots").querySelectorAll("figure"));
    const shown = start + shots.length;
    const more = element("button", { type: "button" }, `More (${shown} of ${count})`);
    more.addEventListener("click", () => this.show(feature, shown));
    const hint = says || (count ? `${count} images, the nearest first. Blue: the outline as it is now. Crosses: detected corners.` : "No image shows it whole.");
    byId("shots").replaceChildren(element("p", { class: "hint" }, hint), ...figures, ...(shown < count ? [more] : []));
  }

  figure({ src, size: [width, height], camera, image, map, seen }) {
    const drawn = element("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${camera}, ${image}` }, element("image", { href: `data:image/jpeg;base64,${src}`, width, height }));
    const outline = map.map((point) => point.join(",")).join(" ");
    if (map.length > 1) for (const look of ["halo", "mapped"]) drawn.append(element("polygon", { class: look, points: outline }));
    for (const [x, y] of map.length > 1 ? seen : map) drawn.append(element("path", { class: "seen", d: `M${x - 4} ${y}h8M${x} ${y - 4}v8` }));
    return element("figure", {}, drawn, element("figcaption", {}, image));
  }
}

// A card beside the outline of a feature, never over it.
export function placeTip(tip, feature, view) {
  const shown = feature.places.map((place) => view.toScreen(place));
  const [left, right] = [Math.min(...shown.map(([x]) => x)), Math.max(...shown.map(([x]) => x))];
  const top = Math.min(...shown.map(([, y]) => y));
  tip.textContent = [nameOf(feature), saidOf(feature), ...factsOf(feature).map(([name, value]) => `${name}: ${value}`)].filter(Boolean).join("\n");
  tip.hidden = false;
  const [width, height] = [tip.offsetWidth, tip.offsetHeight];
  const isLeft = right + 18 + width > view.width && left - 18 - width >= 0;
  tip.style.left = `${isLeft ? left - 18 - width : Math.min(right + 18, view.width - width)}px`;
  tip.style.top = `${Math.max(4, Math.min(top, view.height - height - 4))}px`;
  if (isGone(feature)) tip.append("");
}

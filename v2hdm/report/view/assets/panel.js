// What stands beside the map: the selection, lists to go through, layers. Names only become text nodes.

import { isGone, isMovable, kindOf, middleOf, nameOf, saidOf, words } from "./model.js";

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
  const made = element("button", { type: "button", ...attributes }, label);
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
    const { act } = this;
    const isSame = feature === this.feature;
    this.feature = feature;
    const facts = factsOf(feature).flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]);
    const kind = element("select", { id: "edit-class" });
    const choices = feature.what === "added" ? this.model.scene.cornered : this.model.scene.choices;
    for (const name of new Set([...choices, kindOf(feature)])) kind.append(element("option", { value: name }, words(name)));
    kind.value = kindOf(feature);
    kind.addEventListener("change", () => act.classify(kind.value));
    const reason = element("input", { id: "edit-reason", placeholder: "manhole, shadow", maxlength: "200" });
    reason.value = feature.entry?.reason ?? "";
    reason.addEventListener("keydown", (event) => { if (event.key === "Enter") act.remove(reason.value); });
    const rows = [
      element("div", { class: "row" }, ...(feature.what === "added" ? [] : [button("Accept", act.accept, { "aria-keyshortcuts": "a" })]), button("Delete", () => act.remove(reason.value), { "aria-keyshortcuts": "Delete" }),
        ...(feature.entry && feature.what !== "added" ? [button("Take back", act.restore)] : []), button("Copy link", act.link, { "aria-keyshortcuts": "p" })),
      element("div", { class: "row" }, element("label", { for: "edit-class" }, "Class"), kind),
    ];
    if (feature.what !== "added") rows.push(element("div", { class: "row" }, element("label", { for: "edit-reason" }, "Reason"), reason));
    const head = [element("h2", {}, nameOf(feature)), element("p", { class: "said" }, saidOf(feature)), element("dl", {}, ...facts)];
    if (isSame && ["edit-class", "edit-reason"].includes(focused)) { // a field that is being used stays
      head.forEach((part, n) => section.children[n].replaceWith(part));
      return;
    }
    section.replaceChildren(...head, ...rows);
    if (focused && section.querySelector(`#${focused}`)) byId(focused).focus();
  }

  lists(looks, chosen) {
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

// Corrections on their way to the file: shown at once, sent in order, and taken back where they were refused.

import { isLine } from "./model.js";

const WAIT_MS = 350; // steps of the keyboard within this time are undone as one
const LOOK_MS = 2500; // how often the page looks for what others have corrected
const same = (a, b) => JSON.stringify(a ?? null) === JSON.stringify(b ?? null);

export class Edits {
  constructor(model, changed, tell) {
    this.model = model;
    this.changed = changed; // called with the features that look different now
    this.tell = tell; // says how far saving is
    this.undone = [];
    this.done = [];
    this.queue = [];
    this.sending = false;
    this.file = "";
    setInterval(() => document.visibilityState === "visible" && this.look(), LOOK_MS);
  }

  // A correction of a feature as the file states it, with a change; null takes it back.
  entry(feature, change) {
    if (change === null) return null;
    const { what, id, base, kind, entry } = feature;
    if (what === "question") return change;
    if (isLine(feature)) return { says: "rejected", class: kind, line_map: base, ...entry, ...change };
    const stated = { says: "corrected", class: kind, outline_map: base, ...(id === undefined ? {} : { marking: id }), ...entry, ...change };
    if (stated.moved && !Object.keys(stated.moved).length) delete stated.moved;
    if (!stated.reason) delete stated.reason;
    if (stated.new_class === stated.class) delete stated.new_class;
    const isEmpty = stated.says === "corrected" && !stated.moved && !stated.new_class;
    return isEmpty && what !== "added" ? null : stated;
  }

  // `changes` are [feature, entry or null]; `tag` names steps that go on with the last one.
  make(changes, label, tag = null) {
    const last = this.done.at(-1);
    const goesOn = tag && last?.tag === tag && Date.now() - last.at < WAIT_MS && last.changes.length === changes.length && last.changes.every(({ feature }, n) => feature === changes[n][0]);
    const step = goesOn ? last : { label, tag, changes: changes.map(([feature]) => ({ feature, before: feature.entry })) };
    step.changes.forEach((change, n) => { change.after = changes[n][1]; });
    step.at = Date.now();
    if (!goesOn) this.done.push(step);
    this.undone = [];
    this.show(step.changes.map(({ feature, after }) => [feature, after]));
    // While an earlier part of the step is on its way, the rest waits as one correction.
    if (!this.queue.some((waiting) => waiting.step === step)) this.queue.push({ step, changes: step.changes });
    this.send();
  }

  undo() {
    const step = this.done.pop();
    if (!step) return null;
    this.undone.push(step);
    this.turnBack(step, step.changes.map(({ feature, before, after }) => ({ feature, before: after, after: before })));
    return step.label;
  }

  redo() {
    const step = this.undone.pop();
    if (!step) return null;
    this.done.push(step);
    this.turnBack(step, step.changes);
    return step.label;
  }

  turnBack(step, changes) {
    step.tag = null;
    this.show(changes.map(({ feature, after }) => [feature, after]));
    this.queue.push({ step: {}, changes: changes.map((change) => ({ ...change })) });
    this.send();
  }

  show(changes) {
    for (const [feature, entry] of changes) this.model.state(feature, entry);
    this.changed(changes.map(([feature]) => feature));
  }

  send() {
    this.tell("saving\u2026");
    this.drain();
  }

  // One request after another, so that each is compared with what the file has.
  async drain() {
    if (this.sending) return;
    this.sending = true;
    try {
      while (this.queue.length) {
        const { changes } = this.queue.shift();
        await this.deliver(changes);
      }
      this.tell("");
    } catch (error) {
      this.queue = [];
      this.done = [];
      this.undone = [];
      await this.look(true);
      this.tell(`Not saved: ${error.message || "v2hdm view does not answer; is it still running?"}`, true);
    } finally {
      this.sending = false;
    }
  }

  async deliver(changes) {
    const parts = [];
    const named = []; // the feature whose key each part gives
    const sent = changes.map(({ feature, after }) => ({ feature, after })); // as it is now: it may go on
    for (const { feature, after } of sent) {
      const before = feature.saved ?? null;
      if (same(before, after)) continue;
      const place = ({ outline_map: outline, line_map: line, places_map: places }) => places ?? line ?? outline;
      const moves = before && after && !same(place(before), place(after));
      if (moves) {
        parts.push({ key: feature.key, correction: null, before });
        named.push(null);
      }
      parts.push({ key: feature.key, correction: after, before: moves ? null : before });
      named.push(after ? feature : null);
    }
    if (!parts.length) return;
    const answer = await fetch("correct", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ changes: parts }) });
    if (!answer.ok) throw new Error((await answer.text()).replace("; reload the page", ""));
    const { keys } = await answer.json();
    named.forEach((feature, n) => { if (feature) this.model.rename(feature, keys[n]); });
    for (const { feature, after } of sent) feature.saved = after;
  }

  // What is in the file, with what others have corrected meanwhile.
  async look(anyway = false) {
    if (!anyway && (this.sending || this.queue.length)) return;
    let state;
    try {
      const answer = await fetch("state.json");
      if (!answer.ok) throw new Error();
      state = await answer.json();
    } catch {
      this.tell("v2hdm view does not answer; is it still running?", true);
      return;
    }
    if (!anyway && (this.sending || this.queue.length)) return;
    this.file = state.file;
    const changed = [];
    for (const [key, entry] of Object.entries(state.corrections)) {
      const feature = this.model.byKey.get(key) ?? this.model.addedBy(entry, key);
      if (!same(feature.saved, entry) || !same(feature.entry, entry)) changed.push([feature, entry]);
    }
    for (const feature of this.model.corrected) if (!(feature.key in state.corrections)) changed.push([feature, null]);
    for (const [feature, entry] of changed) feature.saved = entry;
    if (changed.length) this.show(changed);
    this.tell(state.problem, state.problem !== "");
  }
}

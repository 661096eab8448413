// A person's corrections, in the page of v2hdm view: each is sent at once, and written before it is shown as saved.
(() => {
  "use strict";
  const { map, things, element, kinds } = window.v2hdmMap;
  const editing = JSON.parse(document.getElementById("editing").textContent);
  const said = editing.corrections; // by key of the marking
  const handles = L.layerGroup().addTo(map);
  const status = element("p", { class: "editing", role: "status" });
  document.querySelector(".atlas").before(status);

  const outline = (about) => about.c ?? (about.what === "symbol" ? about.p : [about.p]);
  const movedIn = ({ moved }) => {
    const count = Object.keys(moved ?? {}).length;
    return moved ? `, ${count} ${count === 1 ? "corner" : "corners"} moved` : "";
  };
  const kindOf = (about) => (about.what === "excluded" ? about.k : kinds[about.k]);
  function tell(problem = "") {
    const count = Object.keys(said).length;
    status.textContent = problem || `${count} ${count === 1 ? "correction" : "corrections"} in ${editing.file}. Select a marking to accept, reject or change it; drag its corners.`;
    status.classList.toggle("problem", problem !== "");
    for (const shape of things) {
      const own = said[shape.about.key];
      if (own) shape.setStyle({ weight: 3, dashArray: own.says === "rejected" ? "3 4" : null, fillOpacity: own.says === "rejected" ? 0.08 : 0.7 });
    }
  }

  function place(shape) { // where it is drawn, as far as that is saved
    const { about } = shape;
    const moved = said[about.key]?.moved ?? {};
    if (about.c) shape.setLatLngs(about.c.map(([x, y], n) => { const [east, north] = moved[n + 1] ?? [x, y]; return [north, east]; }));
  }

  async function send(shape, change) {
    const { about } = shape;
    const entry = change && { says: "corrected", class: kindOf(about), outline_map: outline(about), ...(about.id === undefined ? {} : { marking: about.id }), ...said[about.key], ...change };
    try {
      const answer = await fetch("correct", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ key: about.key, correction: entry, before: said[about.key] ?? null }) });
      if (!answer.ok) throw new Error(await answer.text());
      if (entry) said[about.key] = entry; else delete said[about.key];
      if (!entry) location.reload();
      tell();
      offer(shape, shape.form);
    } catch (error) {
      place(shape);
      offer(shape, shape.form);
      tell(`Not saved: ${error.message || "v2hdm view does not answer; is it still running?"}`);
    }
  }

  function offer(shape, text) {
    const { about } = shape;
    handles.clearLayers();
    if (about.what === "check") return;
    const own = said[about.key] ?? {};
    shape.form = text;
    const button = (label, change) => {
      const made = element("button", { type: "button" }, label);
      made.addEventListener("click", () => send(shape, change()));
      return made;
    };
    const reason = element("input", { id: "edit-reason", placeholder: "reason (manhole, shadow)", maxlength: 200 });
    reason.value = own.reason ?? "";
    const kind = element("select", { id: "edit-class" }, ...editing.kinds.map((name) => element("option", { value: name }, name.replaceAll("_", " "))));
    kind.value = own.new_class ?? kindOf(about);
    kind.addEventListener("change", () => send(shape, { says: own.says === "accepted" || about.what === "excluded" ? "accepted" : "corrected", new_class: kind.value }));
    const form = element("form", { class: "edit" },
      button("Accept", () => ({ says: "accepted" })),
      button("Reject", () => ({ says: "rejected", reason: reason.value })), element("label", { for: "edit-reason" }, "because"), reason,
      element("label", { for: "edit-class" }, "class"), kind);
    form.addEventListener("submit", (event) => event.preventDefault());
    if (said[about.key]) form.append(element("span", { class: "said" }, `${own.says}${movedIn(own)}`), button("Undo", () => null));
    text.querySelector("form.edit")?.remove();
    text.prepend(form);
    if (!about.c || own.says === "rejected") return;
    about.c.forEach(([x, y], n) => {
      const [east, north] = own.moved?.[n + 1] ?? [x, y];
      const handle = L.marker([north, east], { draggable: true, autoPan: true, title: `corner ${n + 1}: drag to move`, icon: L.divIcon({ className: "handle", iconSize: [26, 26] }) });
      handle.on("drag", () => {
        const corners = about.c.map((corner) => [corner[1], corner[0]]);
        handles.eachLayer((one) => { corners[one.corner] = one.getLatLng(); });
        shape.setLatLngs(corners);
      });
      handle.on("dragend", () => {
        const { lat, lng } = handle.getLatLng();
        send(shape, { says: own.says ?? "corrected", moved: { ...own.moved, [n + 1]: [lng, lat] } });
      });
      handle.corner = n;
      handles.addLayer(handle);
    });
  }

  addEventListener("v2hdm-selected", ({ detail }) => offer(detail.shape, detail.text));
  for (const shape of things) if (said[shape.about.key]?.moved) place(shape);
  tell();
})();

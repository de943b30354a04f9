/* Leave out or keep: two buttons below each motion of a viewer, and one that saves all decisions as a file. */
function motionloomChoices(viewer, bar, data) {
  "use strict";
  const made = (tag, className, textContent) => Object.assign(document.createElement(tag), { className, textContent });
  const button = (className, words, act) => {
    const node = Object.assign(made("button", className, words), { type: "button" });
    node.addEventListener("click", act);
    return node;
  };
  const decided = new Map(), rows = [];
  const said = document.createElement("output");
  const show = () => {
    for (const { name, out, keep } of rows) {
      out.setAttribute("aria-pressed", String(decided.get(name) === "out"));
      keep.setAttribute("aria-pressed", String(decided.get(name) === "keep"));
    }
    const left = [...decided.values()].filter((verdict) => verdict === "out").length;
    said.textContent = `${decided.size} of ${rows.length} decided: ${left} left out, ${decided.size - left} kept`;
  };
  const decide = (name, verdict) => {
    if (decided.get(name) === verdict) decided.delete(name); else decided.set(name, verdict);
    show();
  };
  const rest = (verdict) => {
    for (const { name } of rows) if (!decided.has(name)) decided.set(name, verdict);
    show();
  };
  [...viewer.querySelectorAll(".mlv-cell")].forEach((cell, k) => {
    if (!data.choices[k]) return;
    const [name, why] = data.choices[k], row = made("div", "choice", "");
    const out = button("out", "Leave out", () => decide(name, "out")), keep = button("keep", "Keep", () => decide(name, "keep"));
    row.append(made("p", "", why), out, keep);
    cell.append(row);
    rows.push({ name, why, out, keep });
  });
  const save = () => {
    const chosen = (verdict) => rows.filter(({ name }) => decided.get(name) === verdict);
    const record = { left_out: Object.fromEntries(chosen("out").map(({ name, why }) => [name, why])), kept: chosen("keep").map(({ name }) => name) };
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([JSON.stringify(record, null, 1)], { type: "application/json" }));
    link.download = data.file;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };
  bar.append(said, button("", "Leave out the rest", () => rest("out")), button("", "Keep the rest", () => rest("keep")), button("save", "Save decisions", save));
  show();
}

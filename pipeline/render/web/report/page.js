/* Theme switch, tables that are larger than their box, and the values under the pointer on line charts. */
(function () {
  "use strict";
  const tip = document.getElementById("tip");
  document.getElementById("theme").addEventListener("click", () => {
    const root = document.documentElement;
    const system = window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
    root.dataset.theme = (root.dataset.theme || system) === "dark" ? "light" : "dark";
  });
  const boxes = [...document.querySelectorAll(".scroll")];
  const hint = (box) => {
    const wide = box.scrollWidth > box.clientWidth + 2, tall = box.scrollHeight > box.clientHeight + 2;
    const end = box.scrollLeft + box.clientWidth >= box.scrollWidth - 2, foot = box.scrollTop + box.clientHeight >= box.scrollHeight - 2;
    box.classList.toggle("wide", wide);
    box.classList.toggle("end", wide && end);
    const words = [];
    if (wide) words.push(end ? "← scroll back" : "scroll sideways for more →");
    if (tall) words.push(foot ? "↑ more above" : "scroll down for more ↓");
    if (words.length) box.dataset.more = words.join(" · "); else delete box.dataset.more;
    if (words.length) box.tabIndex = 0; else box.removeAttribute("tabindex");
  };
  for (const box of boxes) box.addEventListener("scroll", () => hint(box), { passive: true });
  const hints = () => { boxes.forEach(hint); boxes.forEach(hint); }; // the words may themselves need the last of the room
  hints();
  window.addEventListener("resize", hints);
  for (const fold of document.querySelectorAll("details")) fold.addEventListener("toggle", hints);
  window.addEventListener("beforeprint", () => {
    for (const fold of document.querySelectorAll("details")) fold.open = true;
  });
  for (const chart of document.querySelectorAll("svg[data-hover]")) {
    const data = JSON.parse(chart.dataset.hover);
    const cursor = document.createElementNS("http://www.w3.org/2000/svg", "line");
    cursor.setAttribute("class", "cursor");
    cursor.setAttribute("visibility", "hidden");
    chart.append(cursor);
    chart.addEventListener("pointermove", (event) => {
      const box = chart.getBoundingClientRect();
      const x = ((event.clientX - box.left) / box.width) * chart.viewBox.baseVal.width;
      const words = [];
      let mark = null, where = null;
      for (const line of data.lines) {
        if (!line.at.length) continue;
        let best = 0;
        line.at.forEach((p, k) => { if (Math.abs(p[0] - x) < Math.abs(line.at[best][0] - x)) best = k; });
        words.push(`${line.name}: ${line.values[best][1]}`);
        if (mark === null || Math.abs(line.at[best][0] - x) < Math.abs(mark - x)) {
          mark = line.at[best][0];
          where = line.values[best][0];
        }
      }
      if (mark === null) return;
      for (const [name, value] of [["x1", mark], ["x2", mark], ["y1", 14], ["y2", 274], ["visibility", "visible"]]) {
        cursor.setAttribute(name, String(value));
      }
      tip.textContent = [`${data.x} ${where}`, ...words].join("\n");
      tip.hidden = false;
      tip.style.left = `${Math.min(event.clientX + 14, window.innerWidth - tip.offsetWidth - 8)}px`;
      tip.style.top = `${event.clientY + 14}px`;
    });
    chart.addEventListener("pointerleave", () => {
      tip.hidden = true;
      cursor.setAttribute("visibility", "hidden");
    });
  }
})();

/* Furniture of the viewer: the board of cells, the control bar, and pointer gestures. */

/* Rows of cells by group; where no group has two members, one flowing row without headings. */
function buildCells(clips) {
  const groups = new Map();
  for (const clip of clips) groups.set(clip.group, [...(groups.get(clip.group) || []), clip]);
  const flow = [...groups.values()].every((members) => members.length === 1);
  const rows = flow ? [["", clips]] : [...groups];
  const board = element("div", { className: "mlv-board" });
  const cells = [];
  for (const [name, members] of rows) {
    const shared = members.every((clip) => clip.caption === members[0].caption) && members[0].caption === name;
    const row = element("div", { className: "mlv-row" });
    row.style.setProperty("--mlv-columns", String(members.length % 3 === 0 ? 3 : Math.min(members.length, 4)));
    const section = element("section", { className: "mlv-group" });
    if (name && !shared) section.append(element("h2", { textContent: name }));
    section.append(row);
    board.append(section);
    const room = {
      height: Math.max(...members.map((c) => c.frame.height)),
      radius: Math.max(...members.map((c) => c.frame.radius)),
      travel: Math.max(...members.map((c) => c.frame.travel)),
    };
    for (const clip of members) {
      const canvas = element("canvas", { tabIndex: 0, role: "img" });
      canvas.setAttribute("aria-label", `Moving figure. ${clip.label} ${clip.caption}. Drag to orbit. ${KEYS}`);
      const count = element("span", { className: "mlv-count" });
      const stage = element("div", { className: "mlv-stage" }, canvas, count);
      if (clip.label) stage.append(element("span", { className: "mlv-label", textContent: clip.label }));
      const now = buildCaption();
      const hear = element("button", { type: "button", className: "mlv-hear", textContent: "♪", title: "Hear and follow this motion's music", hidden: true });
      hear.setAttribute("aria-label", hear.title);
      stage.append(now.node, hear);
      const figure = element("figure", { className: "mlv-cell" }, stage);
      if (clip.caption) figure.append(element("figcaption", { textContent: clip.caption, title: clip.caption }));
      if (clip.note) figure.append(element("p", { className: "mlv-note", textContent: clip.note }));
      row.append(figure);
      cells.push({ clip, canvas, count, now, hear, room, ctx: canvas.getContext("2d"), visible: true });
    }
  }
  return { board, cells };
}

/* The board's own scrolling box, so that the bar beside it never lies over a figure, and a line that says there is more. */
function buildScroller(count, ...children) {
  const box = element("div", { className: "mlv-scroll" }, ...children);
  const more = element("p", { className: "mlv-more", hidden: true });
  const update = () => {
    const room = box.clientHeight + (more.hidden ? 0 : more.offsetHeight); // what the box would have without the line
    const below = box.scrollHeight - box.clientHeight - box.scrollTop > 8;
    more.hidden = box.scrollHeight <= room + 2;
    more.textContent = (count > 1 ? `${count} motions: ` : "") + (below ? "scroll for more ↓" : "more above ↑");
  };
  box.addEventListener("scroll", update, { passive: true });
  const sizes = new ResizeObserver(update);
  for (const node of [box, ...children]) sizes.observe(node);
  return { box, more };
}

function buildBar(last, duration, strip, sounding) {
  const button = (textContent, title, pressed) => {
    const node = element("button", { type: "button", textContent, title });
    node.setAttribute("aria-label", title);
    if (pressed !== undefined) node.setAttribute("aria-pressed", String(pressed));
    return node;
  };
  const bar = {
    play: button("▶", "Play (space)"),
    back: button("‹", "One frame back (left arrow)"),
    forth: button("›", "One frame on (right arrow)"),
    scrub: element("input", { type: "range", min: 0, max: Math.max(last, 1), step: 1, value: 0, className: "mlv-scrub", disabled: duration <= 0 }),
    time: element("output", { className: "mlv-time" }),
    speed: element("select", { title: "Speed" }),
    follow: button("Follow", "Camera follows the root (F)", true),
    close: button("Close-up", "Close-up of the head (C)", false),
    theme: button("◐", "Dark or light (T)"),
    sound: button("♪ Sound", "Sound on (M)", false),
    volume: element("input", { type: "range", min: 0, max: 1, step: 0.05, value: 1, className: "mlv-volume", title: "Volume" }),
  };
  bar.play.classList.add("mlv-play");
  bar.scrub.setAttribute("aria-label", "Time");
  bar.speed.setAttribute("aria-label", "Speed");
  bar.volume.setAttribute("aria-label", "Volume");
  const sound = sounding ? [element("span", { className: "mlv-line mlv-sound" }, bar.sound, bar.volume)] : [];
  const track = strip ? [element("span", { className: "mlv-track" }, strip.strip, bar.scrub)] : [];
  for (const speed of SPEEDS) bar.speed.append(element("option", { value: speed, textContent: `${speed}×`, selected: speed === 1 }));
  const views = element("span", { className: "mlv-set", role: "group" });
  views.setAttribute("aria-label", "View");
  Object.keys(VIEWS).forEach((name, k) => {
    bar[`view ${name}`] = button(name, `View: ${name} (${k + 1})`);
    views.append(bar[`view ${name}`]);
  });
  const legend = element("span", { className: "mlv-legend" },
    element("i", { className: "mlv-left" }), "left ", element("i", { className: "mlv-right" }), "right");
  bar.node = element("div", { className: "mlv-bar", role: "toolbar" },
    ...track,
    element("span", { className: strip ? "mlv-line mlv-tight" : "mlv-line" },
      bar.play, bar.back, bar.forth, ...(strip ? [] : [bar.scrub]), bar.time),
    ...sound,
    element("span", { className: "mlv-line mlv-wrap" }, bar.speed, views, bar.close, bar.follow, bar.theme, legend));
  bar.help = element("p", { className: "mlv-help", textContent: `Drag to orbit · Shift-drag or right-drag to pan · wheel or pinch to zoom · double-click to reset · ${KEYS}${sounding ? " · M sound" : ""}` });
  return bar;
}

/* Drag = orbit, Shift / right / middle drag or two fingers = pan, wheel or pinch = zoom, double click = reset. */
function watchPointer(canvas, act) {
  const held = new Map();
  const centre = () => {
    const list = [...held.values()];
    const x = list.reduce((s, p) => s + p[0], 0) / list.length, y = list.reduce((s, p) => s + p[1], 0) / list.length;
    return { x, y, gap: list.length > 1 ? Math.hypot(list[0][0] - list[1][0], list[0][1] - list[1][1]) : 0 };
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.focus({ preventScroll: true });
    event.preventDefault();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held.has(event.pointerId)) return;
    const from = centre();
    held.set(event.pointerId, [event.clientX, event.clientY]);
    const to = centre(), dx = to.x - from.x, dy = to.y - from.y;
    const panning = held.size > 1 || event.shiftKey || (event.buttons & 6) !== 0;
    if (panning) act.pan(dx, dy, canvas.clientHeight); else act.turn(dx, dy);
    if (held.size > 1 && from.gap > 10) act.zoom(to.gap / from.gap);
  });
  const release = (event) => held.delete(event.pointerId);
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", act.reset);
  canvas.addEventListener("wheel", (event) => {
    if (!act.wheelAllowed() && !event.ctrlKey) return; // in a long page the wheel scrolls until the viewer is clicked
    act.zoom(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.04 : 0.0014)));
    event.preventDefault();
  }, { passive: false });
}

/* The time line: a row a part of the body, marked by dragging, tapping or the keyboard. */

import { element } from "./serve.js";
import { runsOf, together } from "./task.js";

const STAYS = "stays as it is", NEW = "made anew", PARTLY = "stays in part";
const TAP = 4; // pixels that a finger may slip in a tap

/* `act` takes `seek(frame)`, `mark(names, from, to, keep, done)` and `cancel()`. */
export function buildLanes(root, rows, fps, act) {
  const ruler = element("input", { type: "range", className: "edit-ruler", min: 0, step: 1 });
  ruler.setAttribute("aria-label", "Time");
  ruler.addEventListener("input", () => act.seek(Number(ruler.value)));
  const head = element("div", { className: "edit-head" }), pins = element("div", { className: "edit-pins" });
  const all = { name: "all", label: "Everything", names: rows.map(({ name }) => name) };
  const lanes = [all, ...rows.map((row) => ({ ...row, names: [row.name] }))].map(makeLane);
  const box = element("div", { className: "edit-lanes" }, ruler, pins, ...lanes.map(({ node }) => node), head);
  const names = element("div", { className: "edit-names" }, element("span", { textContent: "Time" }),
    ...lanes.map(({ label }) => element("span", { textContent: label })));
  root.replaceChildren(names, box);
  let state = null, frame = 0;

  const time = (k) => `${(k / fps).toFixed(2)} s`;
  const valuesOf = (lane) => (lane.name === "all" ? together(state) : [...state.kept[lane.name]]);
  const frameAt = (node, event) => {
    const room = node.getBoundingClientRect();
    return Math.min(Math.max(Math.floor(((event.clientX - room.left) / room.width) * state.frames), 0), state.frames - 1);
  };
  const place = (node, from, to) => {
    node.style.left = `${(100 * from) / state.frames}%`;
    node.style.width = `${(100 * (to - from)) / state.frames}%`;
  };
  /* A drag from one frame to another, both in it, or a tap. */
  function watch(node, begin) {
    node.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      const from = frameAt(node, event), at = event.clientX, gesture = begin(from);
      let moved = false;
      node.setPointerCapture(event.pointerId);
      const over = (now, done) => { const to = frameAt(node, now); gesture.drag(Math.min(from, to), Math.max(from, to) + 1, done); };
      const move = (now) => { moved = moved || Math.abs(now.clientX - at) > TAP; if (moved) over(now, false); };
      const end = (now) => {
        node.removeEventListener("pointermove", move);
        for (const name of ["pointerup", "pointercancel"]) node.removeEventListener(name, end);
        if (now.type === "pointercancel") act.cancel(); else if (moved) over(now, true); else gesture.tap(from);
      };
      node.addEventListener("pointermove", move);
      for (const name of ["pointerup", "pointercancel"]) node.addEventListener(name, end);
    });
  }

  function makeLane(row) {
    const node = element("div", { className: "edit-lane", tabIndex: 0 });
    node.setAttribute("role", "slider");
    node.setAttribute("aria-label", row.label);
    const lane = { ...row, node };
    const whole = (k) => {
      const [from, to, value] = runsOf(valuesOf(lane)).find((run) => run[0] <= k && k < run[1]);
      act.mark(lane.names, from, to, value !== 1, true);
    };
    watch(node, (from) => {
      const keep = valuesOf(lane)[from] !== 1;
      return { drag: (a, b, done) => act.mark(lane.names, a, b, keep, done), tap: whole };
    });
    let paint = null; // what Shift and an arrow mark with: the other of what is under the time mark at first
    node.addEventListener("blur", () => { paint = null; });
    node.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: -1, ArrowRight: 1 }[event.key], far = { Home: 0, End: state.frames - 1 }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "Enter" || event.key === " ") whole(frame);
      else if (way === undefined && far === undefined) return;
      else {
        const from = frame, to = far !== undefined ? far : Math.min(Math.max(frame + way, 0), state.frames - 1);
        act.seek(to);
        if (event.shiftKey) {
          if (paint === null) paint = valuesOf(lane)[from] !== 1;
          act.mark(lane.names, Math.min(from, to), Math.max(from, to) + 1, paint, true);
        } else paint = null;
      }
      event.preventDefault();
      event.stopPropagation();
    });
    return lane;
  }

  function show(next, now) {
    state = next;
    ruler.max = state.frames - 1;
    for (const lane of lanes) {
      lane.node.setAttribute("aria-valuemax", String(state.frames - 1));
      lane.node.replaceChildren(...runsOf(valuesOf(lane)).map(([from, to, value]) => {
        const words = value === 1 ? STAYS : value ? PARTLY : NEW, wide = ((to - from) / state.frames) * box.clientWidth > 90;
        const run = element("div", { className: `edit-run ${value === 1 ? "edit-stays" : value ? "edit-partly" : "edit-new"}`, textContent: wide ? words : "", title: words });
        place(run, from, to);
        return run;
      }));
    }
    pins.replaceChildren(...[...new Set(state.pins.map((pin) => pin.frame))].map((when) => {
      const mark = element("i");
      mark.style.left = `${(100 * (when + 0.5)) / state.frames}%`;
      return mark;
    }));
    seek(now);
  }
  /* Puts the time mark at a frame. */
  function seek(now) {
    frame = Math.min(now, state.frames - 1);
    if (document.activeElement !== ruler || Number(ruler.value) !== frame) ruler.value = frame;
    ruler.setAttribute("aria-valuetext", time(frame));
    head.style.left = `${(100 * (frame + 0.5)) / state.frames}%`;
    for (const lane of lanes) {
      const value = valuesOf(lane)[frame];
      lane.node.setAttribute("aria-valuenow", String(frame));
      lane.node.setAttribute("aria-valuetext", `${time(frame)}: ${value === 1 ? STAYS : value ? PARTLY : NEW}`);
    }
  }
  return { show, seek };
}

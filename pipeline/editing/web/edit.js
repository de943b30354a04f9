/* Changing a motion: the panel below the figure, what it holds, and what it asks of the server. */

import { buildLanes } from "./lanes.js";
import { figureTools } from "./figure.js";
import { element } from "./serve.js";
import { HANDLES, History, freshState, mark, missing, paceOf, pin, resize, rowsOf, taskOf, walk } from "./task.js";

const one = (id) => document.getElementById(id);
const panel = one("edit"), go = one("edit-go"), why = one("edit-why"), marks = one("edit-marks"), draw = one("edit-draw"), joints = one("edit-joint");
const CLIP = /\.(npz|bvh|glb|vrma?)$/i, ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }, PIXELS = 6;

/* The part of a page (`serve.js`). */
export function begin(page) {
  const { info, say } = page, fps = info.fps, rows = info.edit.possible ? rowsOf(info) : [];
  let clip = null, history = null, draft = null, viewer = null, mounted = null, busy = null, turn = 0, seen = -1;
  let results = new Map(); // by the state that they are of
  const state = () => draft || history.now;

  joints.append(...Object.entries(HANDLES).map(([name, { label }]) => new Option(label, name)));
  const style = () => {
    const of = (name) => getComputedStyle(one("edit-colours")).getPropertyValue(name);
    return { accent: of("color"), card: of("background-color"), ink: of("border-left-color") };
  };
  const tools = figureTools({
    names: info.joint_names, state, style,
    active: () => history !== null,
    hold: () => { viewer.play(false); viewer.setFrame(viewer.frame); },
    drag: (joint, frame, position, done) => change((next) => pin(next, joint, frame, position, fps), done),
    drew: (points) => {
      tools.draw(false);
      if (points) change((next) => { if (!walk(next, Math.min(viewer.frame, next.frames - 10), points)) tell("That path was too short: draw from the figure's feet to where it is to go."); }, true);
      update();
    },
  });
  const lanes = info.edit.possible ? buildLanes(one("edit-time"), rows, fps, {
    seek: (frame) => { viewer.play(false); viewer.setFrame(frame); lanes.seek(frame); },
    mark: (names, from, to, keep, done) => change((next) => mark(next, names, from, to, keep), done),
    cancel: () => { draft = null; update(); },
  }) : null;

  /* A new state from the one before the gesture; kept in the history when the gesture is done. */
  function change(how, done) {
    const next = structuredClone(history.now);
    how(next);
    draft = done ? null : next;
    if (done) history.push(next);
    update();
  }

  function tell(words, wrong) {
    why.textContent = words;
    why.classList.toggle("serve-wrong", Boolean(wrong));
  }

  function update() {
    const now = state(), lack = missing(now, rows, fps, info.edit.max_speed), result = results.get(history.now);
    mount(result ? result.answer.viewer : clip.viewer);
    lanes.show(now, viewer.frame);
    viewer.refresh();
    go.disabled = !busy && Boolean(lack);
    go.textContent = busy ? "Stop" : result ? "Try another" : "Make the change";
    if (!busy) tell(lack || (result ? result.words : ready(now)));
    one("edit-undo").disabled = Boolean(busy) || !history.canUndo;
    one("edit-redo").disabled = Boolean(busy) || !history.canRedo;
    page.savable(result && result.saved);
    draw.setAttribute("aria-pressed", String(tools.drawing));
    draw.textContent = tools.drawing ? "Do not draw" : now.path ? "Draw another path" : "Draw a path";
    if (document.activeElement !== one("edit-caption")) one("edit-caption").value = now.caption;
    if (document.activeElement !== one("edit-seconds")) one("edit-seconds").value = (now.frames / fps).toFixed(1);
    marks.replaceChildren(...[...now.pins.map((one) => ({
      words: `${HANDLES[one.joint].label} at ${(one.frame / fps).toFixed(2)} s`, frame: one.frame, joint: one.joint,
      drop: (next) => { next.pins = next.pins.filter(({ joint, frame }) => joint !== one.joint || frame !== one.frame); },
    })), ...(now.path ? [{ words: pathWords(now), frame: now.path.from, drop: (next) => { next.path = null; } }] : [])].map(chip));
    marks.hidden = !marks.children.length;
  }
  const pathWords = (now) => {
    const { metres, speed } = paceOf(now, fps);
    return `path of ${metres.toFixed(1)} m from ${(now.path.from / fps).toFixed(1)} s on, ${speed.toFixed(1)} m/s${speed > 2.2 ? ", a run" : ""}`;
  };
  const ready = (now) => `Ready. What is striped is made anew${now.caption.trim() ? `, as “${now.caption.trim()}” says` : ""}.`;

  /* Something that was dragged or drawn: goes to its time, or takes it away. */
  function chip({ words, frame, joint, drop }) {
    const to = element("button", { type: "button", textContent: words, onclick: () => { viewer.play(false); viewer.setFrame(frame); } });
    const title = `Take away: ${words}`, off = element("button", { type: "button", textContent: "×", title, ariaLabel: title, onclick: () => change(drop, true) });
    if (joint) {
      to.title = "Arrow keys move it, with Shift in large steps";
      to.addEventListener("keydown", (event) => {
        const way = ARROWS[event.key];
        if (!way) return;
        event.preventDefault();
        viewer.setFrame(frame);
        nudge(joint, ...way.map((v) => v * PIXELS * (event.shiftKey ? 4 : 1)));
      });
    }
    return element("span", {}, to, off);
  }

  /* Moves a joint at the frame that is shown, and leaves the keys with it. */
  function nudge(joint, right, down) {
    tools.nudge(joint, right, down);
    const at = history.now.pins.findIndex((pin) => pin.joint === joint && pin.frame === viewer.frame);
    if (at >= 0) marks.children[at].firstChild.focus();
  }

  function mount(data) {
    if (data === mounted) return;
    const camera = viewer && viewer.camera, frame = viewer && viewer.frame;
    mounted = data;
    viewer = page.mount(data, (ctx, lens, k, at) => {
      tools.over(ctx, lens, k, at);
      if (k === 0 && history && viewer && viewer.frame !== seen) lanes.seek(seen = viewer.frame);
    });
    tools.attach(viewer);
    if (camera) viewer.look(camera);
    viewer.play(data.motions.length > 1);
    viewer.setFrame(data.motions.length > 1 ? 0 : frame || Math.floor(data.motions[0].frames / 2));
  }

  /* Begins with a clip: `{ ref, viewer, frames, caption, name }`; `ref` is what the server knows it by. */
  function open(opened) {
    clip = opened;
    one("edit-name").textContent = clip.name;
    history = new History(freshState(rows, clip));
    results = new Map();
    draft = mounted = viewer = null;
    stop();
    panel.hidden = false;
    document.body.classList.add("serve-editing");
    window.scrollTo(0, 0);
    update();
  }
  function close() {
    const now = history.now, result = results.get(now);
    tools.draw(false);
    panel.hidden = true;
    document.body.classList.remove("serve-editing");
    history = viewer = null;
    stop();
    page.show(result ? changed(result, now.caption) : clip);
  }
  /* What was made, as a clip of its own. */
  function changed({ answer, saved }, caption) {
    const [, after] = answer.viewer.motions, name = clip.name.endsWith(", changed") ? clip.name : `${clip.name}, changed`;
    return { ref: answer.clip, saved, viewer: { ...answer.viewer, motions: [{ ...after, label: "changed" }] }, frames: after.frames, caption, name };
  }
  const sentence = (words) => `${words[0].toUpperCase()}${words.slice(1)}.`;

  /* Forgets the request under way, which `busy` aborts. */
  function stop() {
    turn += 1;
    if (busy) busy.abort();
    busy = null;
  }

  /* Asks for what is marked, or for an exact change of the clip. */
  async function make(exact) {
    const mine = ++turn, now = history.now, before = results.get(now), seed = before ? before.answer.seed + 1 : 0;
    const asked = { clip: clip.ref, task: exact || taskOf(now, rows, fps), seed, format: "viewer" }, began = performance.now();
    busy = new AbortController();
    update();
    const clock = setInterval(() => tell(`Working… ${Math.round((performance.now() - began) / 1000)} s`), 1000);
    tell("Working…");
    try {
      const answer = await (await page.post("/api/edit", asked, busy.signal)).json();
      if (mine !== turn) return;
      const took = ((performance.now() - began) / 1000).toFixed(1);
      const result = { saved: { path: "/api/edit", body: asked }, answer, words: "" };
      results.set(now, result);
      busy = null;
      update();
      result.words = [`Made in ${took} s.`, ...answer.lines.map(sentence), ...answer.notes.map(sentence)].filter(Boolean).join(" ");
      update();
    } catch (error) {
      if (mine !== turn) return;
      busy = null;
      update();
      tell(error.message, true);
    } finally {
      clearInterval(clock);
    }
  }

  go.addEventListener("click", () => {
    if (!busy) { make(); return; }
    stop();
    update();
    tell("Stopped.");
  });
  one("edit-nudge").addEventListener("click", () => nudge(joints.value, 0, 0));
  for (const button of panel.querySelectorAll("[data-task]")) button.addEventListener("click", () => { if (!busy) make(JSON.parse(button.dataset.task)); });
  one("edit-close").addEventListener("click", close);
  one("edit-undo").addEventListener("click", () => { history.undo(); update(); });
  one("edit-redo").addEventListener("click", () => { history.redo(); update(); });
  one("edit-none").addEventListener("click", () => change((next) => mark(next, rows.map(({ name }) => name), 0, next.frames, false), true));
  one("edit-all").addEventListener("click", () => change((next) => Object.assign(next, freshState(rows, clip)), true));
  draw.addEventListener("click", () => {
    if (!tools.drawing) { viewer.play(false); viewer.setFrame(Math.min(viewer.frame, Math.max(state().frames - 10, 0))); }
    tools.draw(!tools.drawing);
    if (tools.drawing) viewer.canvas(0).scrollIntoView({ block: "nearest" });
    update();
  });
  one("edit-caption").addEventListener("change", () => change((next) => { next.caption = one("edit-caption").value; }, true));
  one("edit-seconds").addEventListener("change", () => {
    const frames = Math.round(Number(one("edit-seconds").value) * fps), most = Math.floor(info.limits.seconds * fps);
    if (frames >= fps / 2) change((next) => resize(next, Math.min(frames, most)), true); else update();
  });
  document.addEventListener("keydown", (event) => {
    if (panel.hidden || !(event.ctrlKey || event.metaKey) || event.target.matches("input[type=text]")) return;
    const back = event.key === "z" && !event.shiftKey, forth = event.key === "y" || (event.key.toLowerCase() === "z" && event.shiftKey);
    if (!back && !forth) return;
    if (back) history.undo(); else history.redo();
    update();
    event.preventDefault();
  });

  /* A motion file, to be changed. */
  async function takeClip(file) {
    const mine = page.next(), answer = await page.send("/api/clips", file, info.limits.clip_bytes, `Reading ${file.name}…`);
    if (!answer || mine !== page.turn) return;
    page.current = { ref: answer.clip, viewer: answer.viewer, frames: answer.frames, caption: answer.caption, name: file.name };
    page.note(answer.notes, []);
    say(`${file.name}: ${answer.seconds.toFixed(1)} s of motion`);
    open(page.current);
  }
  function take(file, alone) {
    if (!CLIP.test(file.name) && !alone) return false;
    if (!info.edit.possible) say(`${file.name}: ${info.edit.why}`, true);
    else if (!CLIP.test(file.name)) say(`${file.name} is no motion that can be read here: drop a BVH, GLB, VRMA or npz file`, true);
    else takeClip(file);
    return true;
  }
  const refresh = () => { one("change").hidden = history !== null || !info.edit.possible; };

  one("change").addEventListener("click", () => { page.note([], []); open(page.current); });
  one("clip").addEventListener("change", () => { if (one("clip").files.length) takeClip(one("clip").files[0]); });
  for (const node of document.querySelectorAll(".edit-can")) node.hidden = !info.edit.possible;
  one("change-not").hidden = info.edit.possible;
  one("change-not").textContent = info.edit.why;
  return { tell, take, refresh, able: info.edit.possible, get opened() { return history !== null; } };
}

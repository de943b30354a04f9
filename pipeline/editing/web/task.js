/* What is to change of a clip: the state that the page edits, its history, and the task that the server reads. */

/* Rows of the time line; `but` is what a row leaves to another one. */
const ROWS = [
  { name: "upper", label: "Upper body", parts: ["upper"], but: ["hands"] },
  { name: "lower", label: "Legs, path", parts: ["lower"], but: [] },
  { name: "hands", label: "Fingers", parts: ["hands"], but: [] },
  { name: "face", label: "Face", parts: ["face"], but: [] },
];

/* What of a figure can be dragged, what it is called, and the rows that must be free to follow. */
export const HANDLES = {
  head: { label: "head", rows: ["upper"] },
  left_wrist: { label: "left hand", rows: ["upper"] },
  right_wrist: { label: "right hand", rows: ["upper"] },
  pelvis: { label: "hips", rows: ["upper", "lower"] },
  left_ankle: { label: "left foot", rows: ["lower"] },
  right_ankle: { label: "right foot", rows: ["lower"] },
};

const AROUND = 0.5; // seconds on either side of a dragged joint that are made anew with it
const POINTS = 60; // of a path in a task, at most
const STEP = 0.12; // metres between two points of a path

/* The rows of a model: fingers and a face only where it makes them. */
export const rowsOf = (info) => ROWS.filter(({ name }) => (name === "hands" ? info.joint_names.length > 22 : name !== "face" || info.face));

/* All of a clip kept. */
export function freshState(rows, { frames, caption }) {
  const kept = Object.fromEntries(rows.map(({ name }) => [name, new Uint8Array(frames).fill(1)]));
  return { clip: frames, frames, kept, path: null, pins: [], caption };
}

/* States that were, and those that were taken back. */
export class History {
  constructor(state) { this.states = [state]; this.at = 0; }
  get now() { return this.states[this.at]; }
  get canUndo() { return this.at > 0; }
  get canRedo() { return this.at < this.states.length - 1; }
  push(state) { this.states = [...this.states.slice(0, this.at + 1), state]; this.at += 1; }
  undo() { if (this.canUndo) this.at -= 1; }
  redo() { if (this.canRedo) this.at += 1; }
}

/* Keeps or frees frames `from` up to `to` of some rows; what the clip does not have cannot be kept. Fingers go with the arms:
   they cannot stay where they are while these move. */
export function mark(state, names, from, to, keep) {
  const linked = keep ? { hands: "upper", upper: "hands" } : { upper: "hands" };
  const all = new Set(names.flatMap((name) => [name, linked[name]]).filter((name) => name in state.kept));
  for (const name of all) state.kept[name].fill(keep ? 1 : 0, Math.max(from, 0), Math.min(Math.max(to, 0), state.clip));
}

/* [from, to, value] of equal values next to each other. */
export function runsOf(values) {
  const runs = [];
  values.forEach((value, k) => {
    if (k && values[k - 1] === value) runs[runs.length - 1][1] = k + 1; else runs.push([k, k + 1, value]);
  });
  return runs;
}

/* 1 where all rows are kept, 0 where none is, 0.5 between. */
export function together(state) {
  const rows = Object.values(state.kept);
  return Array.from({ length: state.frames }, (_, k) => {
    const count = rows.filter((row) => row[k]).length;
    return count === rows.length ? 1 : count ? 0.5 : 0;
  });
}

export function resize(state, frames) {
  for (const name of Object.keys(state.kept)) {
    const row = new Uint8Array(frames);
    row.set(state.kept[name].subarray(0, frames));
    state.kept[name] = row;
  }
  state.pins = state.pins.filter((pin) => pin.frame < frames);
  if (state.path && state.path.from >= frames - 1) state.path = null;
  state.frames = frames;
}

/* Has a joint somewhere at a frame, and frees what must move for it. */
export function pin(state, joint, frame, position, fps) {
  state.pins = [...state.pins.filter((old) => old.joint !== joint || old.frame !== frame), { joint, frame, position }].sort((a, b) => a.frame - b.frame);
  const reach = Math.round(AROUND * fps);
  mark(state, HANDLES[joint].rows, frame - reach, frame + reach + 1, false);
}

/* A path over the floor, [x, z] each, walked from a frame on to the end. */
export function walk(state, from, points) {
  const even = [points[0]];
  for (const point of points) if (Math.hypot(point[0] - even.at(-1)[0], point[1] - even.at(-1)[1]) >= STEP) even.push(point);
  if (even.length < 3) return false;
  state.path = { from, points: even };
  mark(state, Object.keys(state.kept), from + 1, state.frames, false);
  return true;
}

/* Metres from the beginning of a path to each of its points. */
export function distances(points) {
  let sum = 0;
  return points.map((point, k) => (sum += k ? Math.hypot(point[0] - points[k - 1][0], point[1] - points[k - 1][1]) : 0));
}

/* Where on the floor the path is at a frame, [x, z]: it is walked evenly, to the last frame. */
export function placeAt({ path: { from, points }, frames }, frame) {
  const far = distances(points), wanted = (far.at(-1) * (frame - from)) / (frames - 1 - from);
  const k = Math.max(far.findIndex((metres) => metres >= wanted - 1e-9), 1), share = (wanted - far[k - 1]) / (far[k] - far[k - 1]);
  return [0, 1].map((i) => points[k - 1][i] + share * (points[k][i] - points[k - 1][i]));
}

/* Length of the path, and metres a second. */
export function paceOf(state, fps) {
  const metres = distances(state.path.points).at(-1);
  return { metres, speed: (metres * fps) / (state.frames - 1 - state.path.from) };
}

/* Why nothing can be made of it yet, in one sentence; empty where it can. */
export function missing(state, rows, fps, maxSpeed) {
  if (state.path && paceOf(state, fps).speed > maxSpeed) return "The path is too long for the time: draw a shorter one, or make the motion longer.";
  const changed = state.frames !== state.clip || rows.some(({ name }) => state.kept[name].some((kept) => !kept));
  return changed ? "" : "Nothing would change yet: do one of the three things above.";
}

/* The task as the server reads it (`EditTask`). */
export function taskOf(state, rows, fps) {
  const at = (frame) => Math.round((1000 * frame) / fps) / 1000, keep = [];
  const kept = Array.from({ length: Math.min(state.frames, state.clip) }, (_, k) => rows.map(({ name }) => state.kept[name][k]).join(""));
  for (const [from, to, marks] of runsOf(kept)) {
    const span = { start: at(from), end: at(to) };
    if (!marks.includes("0")) keep.push({ ...span, parts: ["all"] });
    else rows.forEach(({ parts, but }, k) => { if (marks[k] === "1") keep.push({ ...span, parts, but }); });
  }
  const task = { caption: state.caption.trim(), keep };
  if (state.frames !== state.clip) task.seconds = at(state.frames);
  task.pins = state.pins.map(({ joint, frame, position }) => ({ joint, at: at(frame), position }));
  if (state.path) {
    const { from } = state.path, last = state.frames - 1, count = Math.min(Math.ceil((last - from) / 2), POINTS);
    task.path = Array.from({ length: count }, (_, k) => { // the frame that it begins in stays
      const frame = from + Math.round(((last - from) * (k + 1)) / count), [x, z] = placeAt(state, frame);
      return { at: at(frame), x, z };
    });
  }
  return task;
}

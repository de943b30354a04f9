/* What is drawn over the figure and dragged there: joints to be somewhere, and a path over the floor. */

import { HANDLES, placeAt } from "./task.js";

const DOT = 7, GRASP = { mouse: 14, touch: 26 }; // pixels: a dot's radius, and how near to it a pointer takes hold

/* Tools on the first figure of a viewer.

   `host` gives `state()`, the joints' `names`, and takes `drag(joint, frame, position, done)`,
   `drew(points, done)` and `hold()`, which stops the motion. */
export function figureTools(host) {
  const joint = (name) => host.names.indexOf(name), handles = Object.keys(HANDLES).filter((name) => joint(name) >= 0);
  let viewer = null, held = null, near = null, drawing = null;

  const onFloor = ([x, z], level) => [x, level, z];
  const placeOf = (joints, j) => [joints[3 * j], joints[3 * j + 1], joints[3 * j + 2]];
  const frame = () => Math.min(viewer.frame, host.state().clip - 1);
  const pinned = (name, at) => host.state().pins.find((pin) => pin.joint === name && pin.frame === at);
  const now = (name) => { const found = pinned(name, frame()); return found ? found.position : placeOf(viewer.joints(0), joint(name)); };
  const pixel = (event) => { const box = viewer.canvas(0).getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const pointAt = (lens, [x, y], depth) => viewer.rayThrough(lens, x, y).map((v, i) => lens.eye[i] + depth * v);
  const reached = (at, depth) => {
    const [x, y, z] = pointAt(viewer.lens(0), at, depth);
    return [x, Math.max(y, viewer.floor(0)), z];
  };
  /* Moves a joint at the frame that is shown by pixels, as dragging does. */
  const nudge = (name, right, down) => {
    const [x, y, depth] = viewer.project(viewer.lens(0), now(name));
    host.hold();
    host.drag(name, frame(), reached([x + right, y + down], depth), true);
  };
  const handleAt = (event) => {
    const [x, y] = pixel(event), lens = viewer.lens(0);
    const far = handles.map((name) => { const p = viewer.project(lens, now(name)); return [Math.hypot(p[0] - x, p[1] - y), name]; }).sort((a, b) => a[0] - b[0])[0];
    return far && far[0] < GRASP[event.pointerType === "touch" ? "touch" : "mouse"] ? far[1] : null;
  };
  const floorAt = (event) => {
    const lens = viewer.lens(0), ray = viewer.rayThrough(lens, ...pixel(event)), depth = (viewer.floor(0) - lens.eye[1]) / ray[1];
    if (!(depth > 0) || depth > 40) return null; // above the horizon
    return [0, 2].map((i) => lens.eye[i] + depth * ray[i]);
  };

  function press(event) {
    if (event.button || held || !host.active()) return;
    if (drawing) {
      const place = floorAt(event);
      if (!place) return;
      const root = placeOf(viewer.joints(0, frame()), 0);
      held = { points: [[root[0], root[2]], place] };
    } else {
      const name = handleAt(event);
      if (!name) return;
      held = { name, frame: frame(), depth: viewer.project(viewer.lens(0), now(name))[2], moved: false };
    }
    host.hold();
    viewer.canvas(0).setPointerCapture(event.pointerId);
    event.stopImmediatePropagation();
    event.preventDefault();
  }
  function move(event) {
    if (!held) {
      const over = host.active() && !drawing && event.pointerType === "mouse" && !event.buttons ? handleAt(event) : null;
      if (over !== near) { near = over; viewer.refresh(); }
      viewer.canvas(0).classList.toggle("edit-near", Boolean(near));
      return;
    }
    event.stopImmediatePropagation();
    if (held.points) {
      const place = floorAt(event);
      if (place) held.points.push(place);
    } else {
      held.moved = true;
      held.position = reached(pixel(event), held.depth);
      host.drag(held.name, held.frame, held.position, false);
    }
    viewer.refresh();
  }
  function release(event) {
    if (!held) return;
    event.stopImmediatePropagation();
    const was = held;
    held = null;
    if (was.points) host.drew(event.type === "pointerup" ? was.points : null);
    else if (was.moved) host.drag(was.name, was.frame, was.position, true);
    viewer.refresh();
  }

  /* Listens before the viewer does, which turns the camera by the same gestures. */
  function attach(shown) {
    viewer = shown;
    held = near = drawing = null;
    const canvas = viewer.canvas(0), first = { capture: true };
    canvas.addEventListener("pointerdown", press, first);
    canvas.addEventListener("pointermove", move, first);
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, release, first);
  }

  /* Looks down while a path is drawn. */
  function draw(on) {
    if (Boolean(drawing) === on) return;
    if (on) {
      drawing = viewer.camera;
      viewer.look({ pitch: 1.1, zoom: 0.5, panX: 0, panY: 0 });
    } else {
      viewer.look(drawing);
      drawing = null;
    }
    viewer.canvas(0).classList.toggle("edit-drawing", on);
  }

  // ---- drawing
  function drawPath(ctx, lens, points, level, colour) {
    const seen = points.map((point) => viewer.project(lens, onFloor(point, level))).filter((p) => p[2] > 0.2);
    if (seen.length < 2) return;
    ctx.strokeStyle = ctx.fillStyle = colour;
    ctx.lineJoin = ctx.lineCap = "round";
    ctx.lineWidth = 4;
    ctx.beginPath();
    for (const [x, y] of seen) ctx.lineTo(x, y);
    ctx.stroke();
    const [x, y] = seen.at(-1), [u, v] = seen[Math.max(seen.length - 4, 0)], angle = Math.atan2(y - v, x - u);
    ctx.beginPath();
    for (const side of [0, 2.5, -2.5]) ctx.lineTo(x + 13 * Math.cos(angle + side), y + 13 * Math.sin(angle + side));
    ctx.fill();
  }
  function dot(ctx, [x, y], radius, fill, stroke) {
    ctx.beginPath();
    ctx.arc(x, y, radius, 0, 2 * Math.PI);
    ctx.fillStyle = fill;
    ctx.strokeStyle = stroke;
    ctx.lineWidth = 2.5;
    ctx.fill();
    ctx.stroke();
  }
  function label(ctx, [x, y], words, style) {
    ctx.font = "600 12.5px system-ui, sans-serif";
    const wide = ctx.measureText(words).width, left = Math.min(Math.max(x + 13, 4), ctx.canvas.clientWidth - wide - 12);
    ctx.fillStyle = style.card;
    ctx.globalAlpha = 0.9;
    ctx.beginPath();
    ctx.roundRect(left - 5, y - 10, wide + 10, 20, 6);
    ctx.fill();
    ctx.globalAlpha = 1;
    ctx.fillStyle = style.ink;
    ctx.fillText(words, left, y + 4.5);
  }
  /* From where a joint is to where it is drawn. */
  function drawPull(ctx, lens, joints, name, goal, colour) {
    ctx.strokeStyle = colour;
    ctx.lineCap = "round";
    ctx.lineWidth = 9;
    ctx.globalAlpha = 0.45;
    ctx.beginPath();
    for (const p of [placeOf(joints, joint(name)), goal]) { const [x, y] = viewer.project(lens, p); ctx.lineTo(x, y); }
    ctx.stroke();
    ctx.globalAlpha = 1;
  }

  /* Over the clip's figure: dots to drag and what was dragged. Over the result's: what it was to meet. */
  function over(ctx, lens, k, at) {
    if (!viewer || !host.active()) return;
    const state = host.state(), style = host.style(), level = viewer.floor(k), own = Math.round(at), joints = viewer.joints(k);
    const path = held && held.points ? held.points : state.path && state.path.points;
    if (path) {
      drawPath(ctx, lens, path, level, style.accent);
      if (state.path && !held && own >= state.path.from) dot(ctx, viewer.project(lens, onFloor(placeAt(state, own), level)), 5, style.card, style.accent);
    }
    for (const { joint: name, frame: when, position } of state.pins) {
      if (when !== own) continue;
      if (k === 0) drawPull(ctx, lens, joints, name, position, style.accent);
      dot(ctx, viewer.project(lens, position), DOT + 2, k ? "transparent" : style.accent, style.accent);
    }
    if (drawing && !held && k === 0) label(ctx, [2, 54], "Draw on the floor, from the feet on", style);
    if (k || drawing || viewer.playing) return;
    for (const name of handles) {
      const place = viewer.project(lens, now(name)), taken = pinned(name, own);
      if (!taken) dot(ctx, place, name === near ? DOT + 2 : DOT, style.card, style.accent);
      if (name === near || (held && held.name === name)) label(ctx, place, HANDLES[name].label, style);
    }
  }

  return { attach, draw, over, nudge, get drawing() { return Boolean(drawing); } };
}

/* The viewer itself: cells, one shared camera, one shared clock, controls. */

const VIEWS = { "3/4": [0.62, 0.2], front: [0, 0.08], side: [Math.PI / 2, 0.08], top: [0.62, 1.35] };
const SPEEDS = [0.1, 0.25, 0.5, 1, 1.5, 2];
const KEYS = "Space plays · ←/→ step a frame · Home/End ends · +/− zoom · Shift+arrows turn · 1–4 views · C close-up · F follow · R reset";

function element(tag, properties, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(properties || {})) {
    if (key in node && key !== "list") node[key] = value; else node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
}

const isDark = () => (document.documentElement.dataset.theme || (window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";

function readTheme(root) {
  const style = getComputedStyle(root), pair = "light-dark(";
  const value = (name) => {
    const text = style.getPropertyValue(`--mlv-${name}`).trim();
    return text.startsWith(pair) ? text.slice(pair.length, -1).split(", ")[Number(isDark())] : text;
  };
  const parts = (text) => (text.startsWith("#") ? [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16)) : text.match(/\d+/g).slice(0, 3).map(Number));
  const share = (text) => parts(text).map((v) => v / 255);
  // In the order of the body's swatches: limbs and trunk, skin and hair, face.
  const swatches = ["right", "centre", "left", "skin", "hair", "eye-white", "feature", "hair", "lip", "mouth"];
  return {
    palette: new Float32Array(swatches.flatMap((name) => share(value(name)))), fallen: share(value("shadow")),
    sides: ["centre", "left", "right", "skin"].map(value), shadow: value("shadow"), feature: value("feature"),
    grid: value("grid"), floorNear: value("floor-near"), floorFar: value("floor-far"), trail: value("trail"),
  };
}

/* `options`: `page`, whether the viewer has a page of its own; `over(ctx, lens, k, frame)`, which draws on top of cell k. */
function mountViewer(root, data, options) {
  const page = Boolean(options && options.page), over = options && options.over;
  const clips = data.motions.map((raw) => openClip(raw, data.skeletons[raw.skeleton], data.faceStep));
  const sounds = data.sounds || [], scores = data.scores || [];
  clips.forEach((clip, k) => { clip.sound = data.motions[k].sound; clip.score = scores[data.motions[k].score]; });
  const duration = Math.max(...clips.map((c) => c.duration));
  const rate = Math.max(...clips.map((c) => c.fps));
  const last = Math.round(duration * rate);
  const calm = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  const state = { time: 0, playing: !calm, speed: 1, follow: true, draws: 0, close: false };
  const camera = { yaw: 0, pitch: 0, zoom: 1, panX: 0, panY: 0 };
  let theme, stale = true, dragging = 0, printing = false;
  const stage = clips.some((clip) => clip.pose) ? openStage() : null;
  const life = new AbortController(), whileHere = { signal: life.signal };
  const refresh = () => { stale = true; };

  // ---- page furniture: on a page of its own the bar is the window's lower edge, in a report it stands above the figures
  const header = element("header", { className: "mlv-header" },
    element("h1", { textContent: data.title }), ...(data.note ? [element("p", { textContent: data.note })] : []));
  const { board, cells } = buildCells(clips);
  const strip = scores.length ? buildStrip(duration) : null;
  const bar = buildBar(last, duration, strip, sounds.length > 0);
  const { box, more } = buildScroller(clips.length, ...(page ? [header, board, bar.help] : [board]));
  root.append(...(page ? [box, more, bar.node] : [bar.node, box, more, bar.help]));
  root.classList.toggle("mlv-single", clips.length === 1);
  root.classList.toggle("mlv-few", clips.length > 1 && clips.length < 4 && board.children.length === 1);
  if (page) {
    box.tabIndex = -1; // the keys that scroll a page scroll the box
    box.focus({ preventScroll: true });
  }
  bar.theme.hidden = !page;
  const button = (name, act) => bar[name].addEventListener("click", act);

  // ---- clock
  const localFrame = (clip) => clamp(state.time * clip.fps, 0, clip.frames - 1); // shorter motions hold their last frame
  const frame = () => clamp(Math.round(state.time * rate), 0, last);
  const play = (on) => {
    if (!on) state.time = player.halt(state.time);
    else if (state.time >= duration) state.time = 0;
    state.playing = on;
    bar.play.textContent = on ? "❚❚" : "▶";
    bar.play.setAttribute("aria-label", on ? "Pause" : "Play");
    bar.play.title = on ? "Pause (space)" : "Play (space)";
    refresh();
  };
  const setFrame = (k) => { state.time = clamp(k, 0, last) / rate; refresh(); };
  const step = (by) => { play(false); setFrame(frame() + by); };

  // ---- sound and score: those of one motion at a time
  let lead = null;
  const leads = (clip) => clip.sound === lead.sound && clip.score === lead.score;
  const player = makePlayer(sounds, {
    changed: () => {
      bar.sound.setAttribute("aria-pressed", String(player.on));
      bar.sound.disabled = player.failed;
      bar.sound.title = player.failed ? "This browser cannot play the sound" : player.on ? "Sound off (M)" : "Sound on (M)";
      bar.sound.setAttribute("aria-label", bar.sound.title);
      if (player.on) for (const other of window.__viewers) if (other !== handle) other.setSound(false);
      for (const { clip, hear } of cells) hear.setAttribute("aria-pressed", String(leads(clip) && (player.on || clip.sound === undefined)));
      refresh();
    },
    stopped: () => play(false),
  });
  const follow = (clip) => {
    lead = clip;
    player.choose(clip.sound);
    if (strip) strip.show(clip.score);
    refresh();
  };
  const setSound = (on) => player.turn(on && lead.sound !== undefined);

  // ---- camera
  const setView = (name) => {
    [camera.yaw, camera.pitch] = VIEWS[name];
    camera.zoom = 1; camera.panX = camera.panY = 0; state.close = false;
    refresh();
  };
  const toggle = (name, key) => {
    state[key] = !state[key];
    bar[name].setAttribute("aria-pressed", String(state[key]));
    refresh();
  };
  const zoom = (factor) => { camera.zoom = clamp(camera.zoom * factor, 0.25, 12); refresh(); };
  const turn = (dx, dy) => {
    camera.yaw -= dx * 0.008;
    camera.pitch = clamp(camera.pitch + dy * 0.008, -0.1, 1.5);
    refresh();
  };
  const pan = (dx, dy, height) => { camera.panX -= (dx / height) / camera.zoom; camera.panY += (dy / height) / camera.zoom; refresh(); };

  const lensOf = (cell, width, height) => {
    const { clip, room } = cell, local = localFrame(clip);
    const [x, z] = state.follow || state.close ? pathAt(clip, local) : clip.frame.middle;
    let distance = fitDistance(room.height, room.radius, state.follow ? 0 : room.travel, width, height);
    const target = [x, clip.floor + room.height * 0.455, z];
    if (state.close && clip.skeleton.head >= 0) {
      headCentre(clip.skeleton, jointsAt(clip, local)).forEach((v, k) => { target[k] = v; });
      distance = 1.35 * (clip.pose ? clip.pose.size : 1);
    }
    distance /= camera.zoom;
    const span = 2 * distance * Math.tan(FIELD_OF_VIEW / 2) * camera.zoom;
    const right = [Math.cos(camera.yaw), 0, -Math.sin(camera.yaw)];
    for (const k of [0, 2]) target[k] += right[k] * camera.panX * span;
    target[1] += camera.panY * span;
    return makeLens(target, camera.yaw, camera.pitch, distance, width, height);
  };

  const lensOfCell = (cell) => lensOf(cell, cell.canvas.clientWidth, cell.canvas.clientHeight);

  // ---- drawing
  // Ground, trail and what is written on a cell; sticks too where the stage cannot draw, else what it is to draw.
  const paint = (cell) => {
    const { canvas, clip } = cell, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return null;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const ctx = cell.ctx, local = localFrame(clip);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    const lens = lensOf(cell, width, height), face = faceAt(clip, local, data.faceNeutral);
    const centre = state.follow ? pathAt(clip, local) : clip.frame.middle;
    drawGround(ctx, lens, centre, clip.floor, theme);
    drawTrail(ctx, lens, clip, local, theme);
    cell.now.show(segmentAt(clip.score, state.time));
    const own = Math.round(local), over = state.time > clip.duration + 0.5 / clip.fps;
    cell.count.textContent = `${own + 1} / ${clip.frames}${over ? " · ended" : ""}`;
    if (stage && stage.ready && clip.pose) {
      const item = stageItem(stage, clip, lens, local, face, theme, state.playing && !printing ? clips.length : 0);
      return item && Object.assign(item, { ctx });
    }
    drawSticks(ctx, lens, clip, local, theme);
    return null;
  };
  const paintAll = (some) => {
    const items = some.map(paint).filter(Boolean);
    if (items.length) stage.draw(items, (item) => item.ctx.drawImage(stage.canvas, ...item.source, ...item.box));
    if (over) for (const cell of some) over(cell.ctx, lensOfCell(cell), cells.indexOf(cell), localFrame(cell.clip));
  };
  let before = 0;
  const tick = (now) => {
    if (life.signal.aborted) return;
    const passed = Math.min((now - before) / 1000, 0.1);
    before = now;
    if (state.playing && !dragging && duration > 0) {
      state.time = player.advance(state.time, passed);
      if (state.time > duration + 0.35) state.time = 0; // a short rest on the last frame before the next round
      stale = true;
    } else player.rest();
    if (stale && !printing) {
      stale = false;
      paintAll(cells.filter((cell) => cell.visible));
      const shown = Math.min(state.time, duration);
      bar.scrub.value = frame();
      const segment = lead ? segmentAt(lead.score, state.time) : null;
      bar.scrub.setAttribute("aria-valuetext", `${shown.toFixed(2)} seconds${segment ? `, ${segment[2]}` : ""}`);
      if (strip) strip.mark(state.time);
      bar.time.textContent = `${shown.toFixed(2)} / ${duration.toFixed(2)} s`;
      state.draws += 1;
    }
    requestAnimationFrame(tick);
  };

  // ---- events
  button("play", () => play(!state.playing));
  button("back", () => step(-1));
  button("forth", () => step(1));
  button("follow", () => toggle("follow", "follow"));
  button("close", () => toggle("close", "close"));
  button("theme", () => { document.documentElement.dataset.theme = isDark() ? "light" : "dark"; });
  const setSpeed = (value) => { state.speed = value; player.setSpeed(value); };
  bar.speed.addEventListener("change", () => setSpeed(Number(bar.speed.value)));
  button("sound", () => setSound(!player.on));
  bar.volume.addEventListener("input", () => {
    player.setVolume(Number(bar.volume.value));
    if (!player.on) setSound(true);
  });
  const several = new Set(clips.map((clip) => `${clip.sound} ${scores.indexOf(clip.score)}`)).size > 1;
  for (const cell of cells) {
    cell.hear.hidden = !several || (cell.clip.sound === undefined && !cell.clip.score);
    cell.hear.addEventListener("click", () => {
      const off = player.on && leads(cell.clip);
      follow(cell.clip);
      setSound(cell.clip.sound !== undefined && !off);
    });
  }
  bar.scrub.addEventListener("input", () => { play(false); setFrame(Number(bar.scrub.value)); });
  for (const name of Object.keys(VIEWS)) {
    button(`view ${name}`, () => { setView(name); bar.close.setAttribute("aria-pressed", "false"); });
  }
  const actions = {
    " ": () => play(!state.playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1),
    Home: () => setFrame(0), End: () => { play(false); setFrame(last); }, "+": () => zoom(1.15), "=": () => zoom(1.15),
    "-": () => zoom(1 / 1.15), f: () => bar.follow.click(), c: () => bar.close.click(),
    r: () => bar["view 3/4"].click(), t: () => bar.theme.click(), m: () => setSound(!player.on),
  };
  Object.keys(VIEWS).forEach((name, k) => { actions[k + 1] = () => bar[`view ${name}`].click(); });
  const turns = { ArrowLeft: [12, 0], ArrowRight: [-12, 0], ArrowUp: [0, 12], ArrowDown: [0, -12] };
  (page ? document : root).addEventListener("keydown", (event) => {
    const target = event.target;
    if (event.ctrlKey || event.metaKey || event.altKey || target.tagName === "SELECT" || target === bar.volume) return;
    if (target.tagName === "BUTTON" && event.key === " ") return;
    const act = event.shiftKey && turns[event.key] ? () => turn(...turns[event.key]) : actions[event.key];
    if (!act || (event.shiftKey && !turns[event.key] && event.key !== "+")) return;
    act();
    event.preventDefault();
  }, whileHere);
  const wheelAllowed = () => page || root.contains(document.activeElement);
  for (const cell of cells) {
    watchPointer(cell.canvas, { turn, pan, zoom, wheelAllowed, reset: () => bar["view 3/4"].click() });
  }
  bar.scrub.addEventListener("pointerdown", () => { dragging += 1; });
  window.addEventListener("pointerup", () => { dragging = 0; }, whileHere);

  // Paper is white and has every figure: also those out of sight, and in light colours whatever the screen has.
  window.addEventListener("beforeprint", () => {
    const set = document.documentElement.dataset, chosen = set.theme;
    printing = true;
    set.theme = "light";
    theme = readTheme(root);
    paintAll(cells);
    if (chosen === undefined) delete set.theme; else set.theme = chosen;
  }, whileHere);
  window.addEventListener("afterprint", () => { printing = false; rethemed(); }, whileHere);
  const rethemed = () => { if (!printing) { theme = readTheme(root); refresh(); } };
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", rethemed, whileHere);
  const themes = new MutationObserver(rethemed);
  themes.observe(document.documentElement, { attributes: true, attributeFilter: ["data-theme"] });
  const sizes = new ResizeObserver(refresh);
  const sight = new IntersectionObserver((entries) => {
    for (const entry of entries) cells.find((c) => c.canvas === entry.target).visible = entry.isIntersecting;
    refresh();
  }, { rootMargin: "80px" });
  for (const cell of cells) { sizes.observe(cell.canvas); sight.observe(cell.canvas); }

  /* Leaves nothing behind: for pages that show one motion after another. */
  const remove = () => {
    life.abort();
    setSound(false);
    for (const observer of [themes, sizes, sight]) observer.disconnect();
    if (stage) {
      stage.watchers.delete(refresh);
      clips.forEach(stage.forget);
    }
    root.replaceChildren();
    window.__viewers.splice(window.__viewers.indexOf(handle), 1);
    window.__viewer = window.__viewers[0];
  };
  const handle = {
    get frame() { return frame(); }, get time() { return state.time; }, get playing() { return state.playing; },
    get draws() { return state.draws; }, get frames() { return last + 1; }, get camera() { return { ...camera }; },
    get follow() { return state.follow; },
    remove, play, setFrame, paint: () => paintAll(cells.filter((cell) => cell.visible)), setView, turn, toggle: (name) => toggle(name, name),
    get sound() { return player.on; }, get audio() { return player.audio; },
    get segment() { return lead && segmentAt(lead.score, state.time); },
    get view() { return stage && stage.ready ? "webgl" : "2d"; }, stage,
    bones: (k) => [...bonesAt(clips[k], localFrame(clips[k]))], // what moves the mesh now, for checks from outside
    lens: (k) => lensOfCell(cells[k]), canvas: (k) => cells[k].canvas, floor: (k) => clips[k].floor,
    joints: (k, at = localFrame(clips[k])) => jointsAt(clips[k], at),
    look: (from) => { Object.assign(camera, from); refresh(); }, project, rayThrough, refresh, setSpeed, setSound,
  };
  window.__viewers = window.__viewers || [];
  window.__viewers.push(handle);
  window.__viewer = window.__viewers[0];

  if (stage) stage.watchers.add(refresh);
  setView("3/4");
  play(state.playing);
  rethemed();
  follow(clips.find((clip) => clip.sound !== undefined) || clips.find((clip) => clip.score) || clips[0]);
  player.turn(false);
  requestAnimationFrame(tick);
  return handle;
}

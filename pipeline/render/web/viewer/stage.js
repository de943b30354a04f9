/* The stage: one WebGL2 canvas for all figures of a page, drawn side by side and copied into their cells.

   Browsers give a page few contexts, and reports have many cells; so cells stay plain canvases with the ground
   on them, on which the plain figure is drawn where there is no WebGL2 or the context goes away. */

const LAMP_ABOVE = unit([-0.25, 1.4, 0.55]); // from which side light comes, in the world
const LAMP_SLOPE = [LAMP_ABOVE[0] / LAMP_ABOVE[1], LAMP_ABOVE[2] / LAMP_ABOVE[1]];
const SHADOW_SPREAD = 0.11; // metres over which the shadow's rim is soft
const BODY_REACH = 0.15, HEAD_REACH = 0.27; // how far the body goes beyond its joints, metres
const NEAR_DETAIL = 400; // a figure of so many pixels is drawn with all vertices
const FEW = 2; // without a GPU, more moving figures than that have the far detail

/* The page's stage, or null: no WebGL2, or no body. */
const openStage = (() => {
  let stage;
  return () => {
    if (stage === undefined) stage = BODY && makeStage();
    return stage;
  };
})();

function makeStage() {
  const canvas = document.createElement("canvas");
  const software = drawnInSoftware();
  const gl = canvas.getContext("webgl2", { alpha: true, antialias: !software, depth: true, powerPreference: "high-performance" });
  let painter = gl && makePainter(gl);
  if (!painter) return null;
  const limit = Math.min(gl.getParameter(gl.MAX_RENDERBUFFER_SIZE), 8192); // asked once: an answer waits for all that is under way
  const watchers = new Set();
  const changed = () => { for (const watcher of watchers) watcher(); };
  canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); painter = null; changed(); });
  canvas.addEventListener("webglcontextrestored", () => { painter = makePainter(gl); changed(); });

  const stage = { canvas, gl, software, watchers, get ready() { return painter !== null; } };
  /* Draws the items and hands each to `show(item)`, its picture in `item.source` of the canvas. */
  stage.draw = (items, show) => {
    for (let rest = items; rest.length && painter;) {
      const { group, width, height } = packed(rest.slice(0, painter.most), limit);
      fitCanvas(canvas, width, height);
      for (const item of group) { // WebGL counts from below
        item.source = [...item.rect];
        item.rect[1] = canvas.height - item.rect[1] - item.rect[3];
      }
      painter.fall(group);
      group.forEach((item, k) => painter.draw(item, k));
      group.forEach(show);
      rest = rest.slice(group.length);
    }
  };
  stage.forget = (clip) => { if (painter) painter.forget(clip); };
  return stage;
}

/* All of the canvas is copied with each picture: it grows as it must and shrinks where half of it is not used. */
function fitCanvas(canvas, width, height) {
  const waste = canvas.width * canvas.height > 2 * width * height;
  if (waste || canvas.width < width || canvas.height < height) {
    canvas.width = waste ? width : Math.max(width, canvas.width);
    canvas.height = waste ? height : Math.max(height, canvas.height);
  }
}

/* Whether the processor makes the pixels: smooth edges then come from drawing a still picture twice as large. */
function drawnInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  let name = gl.getParameter(gl.RENDERER);
  const info = name === "WebKit WebGL" && gl.getExtension("WEBGL_debug_renderer_info"); // where the name is masked
  if (info) name = gl.getParameter(info.UNMASKED_RENDERER_WEBGL);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

/* As many of the items as fit, each with its `rect`: shelves from left to right and top to bottom. */
function packed(items, limit) {
  const group = [];
  let x = 0, y = 0, shelf = 0, width = 1;
  for (const item of items) {
    const w = Math.min(Math.ceil(item.box[2] * item.ratio), limit), h = Math.min(Math.ceil(item.box[3] * item.ratio), limit);
    if (x + w > Math.min(limit, 2048) && x > 0) { x = 0; y += shelf; shelf = 0; }
    if (y + h > limit && group.length) break;
    item.rect = [x, y, w, h];
    x += w;
    shelf = Math.max(shelf, h);
    width = Math.max(width, x);
    group.push(item);
  }
  const steps = (size) => 64 * Math.ceil(size / 64); // a canvas that grows now and then, not with every frame
  return { group, width: steps(width), height: steps(y + shelf) };
}

/* What the stage needs to draw a clip's frame, or null where nothing of it is in view; `moving` figures, none in a still picture. */
function stageItem(stage, clip, lens, frame, face, theme, moving) {
  const bones = bonesAt(clip, frame), pose = clip.pose, level = clip.floor - SOLE, size = pose.size;
  const field = shadowField(pose.places, level, size), box = figureBox(lens, clip, field, level);
  if (!box) return null;
  const pixels = window.devicePixelRatio || 1, hasty = stage.software && moving > 0, coarse = hasty && moving > FEW;
  const ratio = hasty ? Math.min(pixels, 1) : Math.min(stage.software ? 2 * pixels : pixels, 2);
  const tall = ((1.7 * size * lens.focal) / Math.max(lens.distance, NEAR)) * ratio;
  const detail = coarse || tall < NEAR_DETAIL ? 1 : 0;
  return {
    clip, lens, box, ratio, detail, field, level, palette: theme.palette, shadow: theme.fallen, face: faceWeights(face),
    bones, taps: coarse ? 5 : 10,
  };
}

/* Ground [x, z, width, depth] on which the shadow falls. */
function shadowField(places, level, size) {
  let west = Infinity, east = -Infinity, north = Infinity, south = -Infinity;
  for (let k = 0; k < places.length; k += 3) {
    const h = Math.max(places[k + 1] - level, 0), x = places[k] - LAMP_SLOPE[0] * h, z = places[k + 2] - LAMP_SLOPE[1] * h;
    west = Math.min(west, x); east = Math.max(east, x);
    north = Math.min(north, z); south = Math.max(south, z);
  }
  const reach = 0.2 * size + SHADOW_SPREAD;
  return [west - reach, north - reach, east - west + 2 * reach, south - north + 2 * reach];
}

/* The part of the cell [x, y, width, height] that figure and shadow can touch, CSS pixels; all of it from close by. */
function figureBox(lens, clip, [x, z, width, depth], level) {
  const { places, size } = clip.pose, low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  let near = false;
  const take = (p, reach) => {
    const [px, py, away, scale] = project(lens, p);
    near = near || away < reach + NEAR;
    [px, py].forEach((v, i) => {
      low[i] = Math.min(low[i], v - reach * scale);
      high[i] = Math.max(high[i], v + reach * scale);
    });
  };
  for (let j = 0; j < clip.joints; j++) {
    take(places.subarray(3 * j, 3 * j + 3), size * (j === clip.skeleton.head ? HEAD_REACH : BODY_REACH));
  }
  if (lens.back[1] > 0) for (const [u, v] of [[0, 0], [1, 0], [0, 1], [1, 1]]) take([x + u * width, level, z + v * depth], 0);
  const room = [lens.width, lens.height], start = [0, 1].map((i) => (near ? 0 : Math.floor(clamp(low[i], 0, room[i]))));
  const end = [0, 1].map((i) => (near ? room[i] : Math.ceil(clamp(high[i], 0, room[i]))));
  return end[0] > start[0] && end[1] > start[1] ? [...start, end[0] - start[0], end[1] - start[1]] : null;
}

/* Camera and plane geometry. World: metres, Y up. Screen: CSS pixels, Y down. */

const FIELD_OF_VIEW = 0.5; // radians, vertical; long enough a lens to keep limbs in proportion
const NEAR = 0.15;

const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const mix = (a, b, t) => a + (b - a) * t;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
function unit(a) {
  const length = Math.hypot(a[0], a[1], a[2]) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
}

/* A pinhole camera `distance` metres from `target`, seen from heading `yaw` (0 = from +Z) and height angle `pitch`. */
function makeLens(target, yaw, pitch, distance, width, height) {
  const cp = Math.cos(pitch);
  const back = [Math.sin(yaw) * cp, Math.sin(pitch), Math.cos(yaw) * cp];
  const right = [Math.cos(yaw), 0, -Math.sin(yaw)];
  const up = cross(back, right);
  const eye = [target[0] + back[0] * distance, target[1] + back[1] * distance, target[2] + back[2] * distance];
  return {
    eye, back, right, up, distance, width, height,
    focal: height / 2 / Math.tan(FIELD_OF_VIEW / 2), cx: width / 2, cy: height / 2,
  };
}

/* Writes x, y (pixels), depth (metres) and pixels per metre of one point into out[at..at+3]. */
function projectTo(lens, x, y, z, out, at) {
  const dx = x - lens.eye[0], dy = y - lens.eye[1], dz = z - lens.eye[2];
  const r = lens.right, u = lens.up, b = lens.back;
  const depth = -(dx * b[0] + dy * b[1] + dz * b[2]);
  const s = lens.focal / Math.max(depth, NEAR);
  out[at] = lens.cx + (dx * r[0] + dy * r[1] + dz * r[2]) * s;
  out[at + 1] = lens.cy - (dx * u[0] + dy * u[1] + dz * u[2]) * s;
  out[at + 2] = depth;
  out[at + 3] = s;
}

function project(lens, p) {
  const out = [0, 0, 0, 0];
  projectTo(lens, p[0], p[1], p[2], out, 0);
  return out;
}

/* Adds the outline of two circles and their common tangents to the path; returns the angles for side lines. */
function capsulePath(ctx, x1, y1, r1, x2, y2, r2) {
  const dx = x2 - x1, dy = y2 - y1, gap = Math.hypot(dx, dy);
  if (gap <= Math.abs(r1 - r2) + 1e-6) {
    const big = r1 >= r2;
    const x = big ? x1 : x2, y = big ? y1 : y2, r = Math.max(r1, r2);
    ctx.moveTo(x + r, y);
    ctx.arc(x, y, r, 0, 2 * Math.PI);
    return null;
  }
  const along = Math.atan2(dy, dx), open = Math.acos((r1 - r2) / gap);
  const a = along + open, b = along - open;
  ctx.moveTo(x1 + r1 * Math.cos(a), y1 + r1 * Math.sin(a));
  ctx.arc(x1, y1, r1, a, b + 2 * Math.PI);
  ctx.arc(x2, y2, r2, b, a);
  ctx.closePath();
  return [a, b];
}

/* Convex hull (monotone chain) of flat [x, y, x, y, ...]; returns a flat list in order. */
function convexHull(flat) {
  const points = [];
  for (let i = 0; i < flat.length; i += 2) points.push([flat[i], flat[i + 1]]);
  points.sort((p, q) => p[0] - q[0] || p[1] - q[1]);
  const turn = (o, p, q) => (p[0] - o[0]) * (q[1] - o[1]) - (p[1] - o[1]) * (q[0] - o[0]);
  const half = (list) => {
    const out = [];
    for (const p of list) {
      while (out.length > 1 && turn(out[out.length - 2], out[out.length - 1], p) <= 0) out.pop();
      out.push(p);
    }
    out.pop();
    return out;
  };
  return [...half(points), ...half(points.reverse())].flat();
}

const CIRCLE = Array.from({ length: 16 }, (_, k) => [Math.cos((k * Math.PI) / 8), Math.sin((k * Math.PI) / 8)]);

/* Hull of circles [x, y, r, ...] as a flat polygon. */
function hullOfCircles(circles) {
  const flat = [];
  for (let i = 0; i < circles.length; i += 3) {
    for (const [c, s] of CIRCLE) flat.push(circles[i] + circles[i + 2] * c, circles[i + 1] + circles[i + 2] * s);
  }
  return convexHull(flat);
}

function polygonPath(ctx, flat) {
  ctx.moveTo(flat[0], flat[1]);
  for (let i = 2; i < flat.length; i += 2) ctx.lineTo(flat[i], flat[i + 1]);
  ctx.closePath();
}

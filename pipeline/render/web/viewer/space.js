/* The camera. World: metres, Y up. Screen: CSS pixels, Y down. */

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

/* From the eye through a pixel: the step that goes one metre deep. */
function rayThrough(lens, x, y) {
  const right = (x - lens.cx) / lens.focal, up = (lens.cy - y) / lens.focal;
  return lens.back.map((back, i) => right * lens.right[i] + up * lens.up[i] - back);
}

/* Pixels x and y, depth in metres, and pixels per metre of a point. */
function project(lens, p) {
  const d = minus(p, lens.eye), depth = -dot(d, lens.back), s = lens.focal / Math.max(depth, NEAR);
  return [lens.cx + dot(d, lens.right) * s, lens.cy - dot(d, lens.up) * s, depth, s];
}

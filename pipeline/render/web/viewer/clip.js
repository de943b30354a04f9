/* Unpacking of the embedded clips, and the camera frame each one asks for. */

function bytesOf(base64) {
  const text = atob(base64), out = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) out[k] = text.charCodeAt(k);
  return out;
}

function openClip(raw, skeleton, faceStep) {
  const bytes = new DataView(bytesOf(raw.positions).buffer);
  const count = raw.frames * raw.joints;
  const positions = new Float32Array(count * 3);
  for (let k = 0; k < count * 3; k++) positions[k] = raw.low[k % 3] + raw.step[k % 3] * bytes.getUint16(2 * k, true);
  let face = null;
  if (raw.face) {
    const view = new DataView(bytesOf(raw.face).buffer);
    face = Float32Array.from({ length: raw.frames * 5 }, (_, k) => view.getInt16(2 * k, true) * faceStep);
  }
  const lowest = raw.low[1];
  const clip = {
    label: raw.label, caption: raw.caption, note: raw.note, group: raw.group, fps: raw.fps, frames: raw.frames,
    joints: raw.joints, positions, face, skeleton,
    duration: (raw.frames - 1) / raw.fps,
    floor: Math.abs(lowest) < 0.5 ? 0 : lowest, // canonical clips stand on 0; others on their lowest point
  };
  clip.pose = openPose(raw, raw.joints);
  clip.root = (frame, axis) => positions[clamp(frame, 0, raw.frames - 1) * raw.joints * 3 + axis];
  clip.path = smoothPath(clip);
  clip.frame = frameOf(clip);
  return clip;
}

/* Root path [T][x, z], averaged over about 0.8 s: what a following camera looks at. */
function smoothPath(clip) {
  const reach = Math.max(1, Math.round(clip.fps * 0.4));
  return Array.from({ length: clip.frames }, (_, k) => {
    let x = 0, z = 0;
    for (let d = -reach; d <= reach; d++) {
      x += clip.root(k + d, 0);
      z += clip.root(k + d, 2);
    }
    return [x / (2 * reach + 1), z / (2 * reach + 1)];
  });
}

const percentile = (values, share) => values.sort((a, b) => a - b)[Math.floor((values.length - 1) * share)];

/* How much room the figure takes: around the following camera's target, and over its whole way. */
function frameOf(clip) {
  const tops = [], sides = [], steps = Math.max(1, Math.floor(clip.frames / 60));
  let west = Infinity, east = -Infinity, north = Infinity, south = -Infinity;
  for (let k = 0; k < clip.frames; k += steps) {
    let top = -Infinity, side = 0;
    const [px, pz] = clip.path[k];
    for (let j = 0; j < clip.joints; j++) {
      const i = (k * clip.joints + j) * 3;
      top = Math.max(top, clip.positions[i + 1]);
      side = Math.max(side, Math.hypot(clip.positions[i] - px, clip.positions[i + 2] - pz));
    }
    tops.push(top);
    sides.push(side);
    west = Math.min(west, px); east = Math.max(east, px);
    north = Math.min(north, pz); south = Math.max(south, pz);
  }
  const head = clip.skeleton.head < 0 ? 0.03 : 0.2 * (clip.pose ? clip.pose.size : 1);
  return {
    height: clamp(percentile(tops, 0.98) - clip.floor + head, 0.3, 5),
    radius: clamp(percentile(sides, 0.9) + 0.06, 0.2, 4),
    middle: [(west + east) / 2, (north + south) / 2],
    travel: clamp(Math.hypot(east - west, south - north) / 2, 0, 12),
  };
}

function pathAt(clip, frame) {
  const k = Math.min(Math.floor(frame), clip.frames - 1), next = Math.min(k + 1, clip.frames - 1);
  return [0, 1].map((axis) => mix(clip.path[k][axis], clip.path[next][axis], frame - k));
}

function faceAt(clip, frame, neutral) {
  if (!clip.face) return neutral;
  const k = Math.min(Math.floor(frame), clip.frames - 1), next = Math.min(k + 1, clip.frames - 1);
  return neutral.map((_, c) => mix(clip.face[5 * k + c], clip.face[5 * next + c], frame - k));
}

/* Distance from which a figure of this height and radius fits a cell, while it moves `travel` metres either way. */
function fitDistance(height, radius, travel, width, tall) {
  const tan = Math.tan(FIELD_OF_VIEW / 2);
  const up = Math.max(height * 0.58, radius * 1.05) + 0.25 * travel, across = (radius + travel) * 1.08;
  return Math.max(up / tan, (across * tall) / (tan * width)) + radius * 0.3 + travel * 0.7;
}

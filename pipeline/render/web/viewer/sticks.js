/* The plain figure: a line a bone and a ball for the head, where there is no WebGL2 or the skeleton has no body. */

const STICK = [0.13, 0.007, 0.05]; // half a line's width: this share of the bone's length, and no less or more than so many metres
const HEAD_BALL = 0.1;

/* Joints [3 * N] of a clip between two frames. */
function jointsAt(clip, frame, out = new Float32Array(3 * clip.joints)) {
  const k = Math.min(Math.floor(frame), clip.frames - 1), next = Math.min(k + 1, clip.frames - 1), t = frame - k, n = out.length;
  for (let i = 0; i < n; i++) out[i] = mix(clip.positions[k * n + i], clip.positions[next * n + i], t);
  return out;
}

/* The middle of the head: as far beyond its joint, nearly, as the neck is before it. */
function headCentre({ parents, head }, joints) {
  return [0, 1, 2].map((i) => joints[3 * head + i] + 0.8 * (joints[3 * head + i] - joints[3 * parents[head] + i]));
}

function drawSticks(ctx, lens, clip, frame, theme) {
  const { parents, sides, head } = clip.skeleton, joints = jointsAt(clip, frame), bones = [], level = clip.floor - SOLE;
  const at = (j) => [joints[3 * j], joints[3 * j + 1], joints[3 * j + 2]];
  parents.forEach((parent, j) => {
    if (parent < 0) return;
    const a = at(parent), b = at(j);
    bones.push({ a, b, radius: clamp(STICK[0] * Math.hypot(...minus(b, a)), STICK[1], STICK[2]), colour: theme.sides[sides[j]] });
  });
  if (head >= 0) bones.push({ a: headCentre(clip.skeleton, joints), b: headCentre(clip.skeleton, joints), radius: HEAD_BALL, colour: theme.sides[3] });
  const fall = ([x, y, z]) => [x - LAMP_SLOPE[0] * (y - level), level, z - LAMP_SLOPE[1] * (y - level)];
  ctx.lineCap = "round";
  ctx.globalAlpha = 0.12;
  for (const { a, b, radius } of bones) drawStick(ctx, project(lens, fall(a)), project(lens, fall(b)), radius, theme.shadow);
  ctx.globalAlpha = 1;
  const seen = bones.map(({ a, b, radius, colour }) => ({ p: project(lens, a), q: project(lens, b), radius, colour }));
  for (const { p, q, radius, colour } of seen.sort((one, two) => two.p[2] + two.q[2] - one.p[2] - one.q[2])) {
    drawStick(ctx, p, q, radius + 1 / p[3], theme.feature);
    drawStick(ctx, p, q, radius, colour);
  }
}

function drawStick(ctx, p, q, radius, colour) {
  if (p[2] < NEAR || q[2] < NEAR) return;
  ctx.strokeStyle = colour;
  ctx.lineWidth = Math.max(radius * (p[3] + q[3]), 1.2);
  ctx.beginPath();
  ctx.moveTo(p[0], p[1]);
  ctx.lineTo(q[0], q[1] + 0.01); // a line of no length would not be drawn
  ctx.stroke();
}

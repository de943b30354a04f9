/* The head: an ellipsoid with hair, ears, nose and a face of brows, eyes and mouth laid on its surface. */

const HEAD_SIZE = [0.083, 0.118, 0.098]; // half width, half height, half depth, metres

/* Axes and centre of the head from the neck, head and shoulder nodes. */
function headPose(nodes, head, scale) {
  const at = (k) => [nodes[3 * k], nodes[3 * k + 1], nodes[3 * k + 2]];
  const neck = at(head.neck), skull = at(head.head);
  const shoulder = minus(at(head.left), at(head.right));
  // At rest the head joint stands before the neck joint by a third of its height: tilt that back to find "up".
  const lean = unit(minus(skull, neck));
  let left = unit(shoulder);
  const slant = cross(left, lean);
  const up = unit([0, 1, 2].map((i) => lean[i] - 0.31 * slant[i]));
  const along = dot(left, up);
  left = unit([0, 1, 2].map((i) => left[i] - along * up[i]));
  const front = cross(left, up);
  const size = HEAD_SIZE.map((v) => v * scale);
  const centre = [0, 1, 2].map((i) => skull[i] + up[i] * size[1] * 0.62 + front[i] * size[2] * 0.12);
  return { centre, left, up, front, size };
}

/* Ellipse on screen of an ellipsoid with half axes `size` along left, up, front. */
function ellipsoidOnScreen(lens, pose, size, centre) {
  const p = project(lens, centre);
  let xx = 0, xy = 0, yy = 0;
  [pose.left, pose.up, pose.front].forEach((axis, k) => {
    const x = dot(axis, lens.right) * size[k] * p[3], y = -dot(axis, lens.up) * size[k] * p[3];
    xx += x * x; xy += x * y; yy += y * y;
  });
  const mean = (xx + yy) / 2, spread = Math.hypot((xx - yy) / 2, xy);
  return {
    x: p[0], y: p[1], a: Math.sqrt(mean + spread), b: Math.sqrt(Math.max(mean - spread, 1e-6)),
    angle: 0.5 * Math.atan2(2 * xy, xx - yy), depth: p[2],
  };
}

function fillEllipsoid(ctx, lens, pose, size, centre, tones) {
  const e = ellipsoidOnScreen(lens, pose, size, centre);
  ctx.beginPath();
  ctx.ellipse(e.x, e.y, e.a, e.b, e.angle, 0, 2 * Math.PI);
  const r = Math.max(e.a, e.b);
  const shade = ctx.createRadialGradient(e.x - 0.35 * r, e.y - 0.5 * r, 0.1 * r, e.x, e.y, 1.15 * r);
  shade.addColorStop(0, tones.light);
  shade.addColorStop(0.5, tones.base);
  shade.addColorStop(1, tones.dark);
  ctx.fillStyle = shade;
  ctx.fill();
  ctx.strokeStyle = tones.edge;
  ctx.lineWidth = 1;
  ctx.stroke();
}

/* Returns a function that maps face coordinates (metres left, metres up, lift off the skin) to the screen. */
function faceMap(lens, pose) {
  const [a, b, c] = pose.size;
  return (x, y, lift = 0.001) => {
    const z = c * Math.sqrt(Math.max(1 - (x / a) ** 2 - (y / b) ** 2, 0.02)) + lift;
    const p = [0, 1, 2].map((i) => pose.centre[i] + pose.left[i] * x + pose.up[i] * y + pose.front[i] * z);
    const n = [x / (a * a), y / (b * b), z / (c * c)];
    const normal = unit([0, 1, 2].map((i) => pose.left[i] * n[0] + pose.up[i] * n[1] + pose.front[i] * n[2]));
    return { p: project(lens, p), facing: dot(normal, unit(minus(lens.eye, p))) };
  };
}

function tracePoints(ctx, points) {
  ctx.beginPath();
  points.forEach(({ p }, k) => (k ? ctx.lineTo(p[0], p[1]) : ctx.moveTo(p[0], p[1])));
}

function drawHead(ctx, lens, pose, face, theme, tones) {
  const scale = pose.size[0] / HEAD_SIZE[0];
  const place = (x, y, z) => [0, 1, 2].map((i) => pose.centre[i] + pose.left[i] * x + pose.up[i] * y + pose.front[i] * z);
  const parts = [{ size: pose.size, centre: pose.centre, tones }];
  for (const side of [-1, 1]) {
    const ear = [0.014, 0.032, 0.02].map((v) => v * scale);
    parts.push({ size: ear, centre: place(side * 0.083 * scale, -0.008 * scale, -0.008 * scale), tones });
  }
  const hair = [0.087, 0.1, 0.094].map((v) => v * scale);
  parts.push({ size: hair, centre: place(0, 0.03 * scale, -0.024 * scale), tones: theme.tones.hair });
  for (const part of parts) part.depth = project(lens, part.centre)[2];
  parts[3].depth += 0.012 * scale; // seen from the side, the hair lies behind the skull
  parts.sort((p, q) => q.depth - p.depth);
  for (const part of parts) fillEllipsoid(ctx, lens, pose, part.size, part.centre, part.tones);
  drawFace(ctx, lens, pose, face, theme, scale);
}

function drawFace(ctx, lens, pose, face, theme, scale) {
  const on = faceMap(lens, pose);
  const [smile, brow, eyeOpen, mouthOpen, frown] = face;
  const pixel = lens.focal / Math.max(lens.distance, NEAR) * scale;
  const seen = (x, y) => on(x * scale, y * scale).facing > 0.12;
  const path = (list) => list.map(([x, y, lift]) => on(x * scale, y * scale, lift === undefined ? 0.001 : lift * scale));
  ctx.lineCap = ctx.lineJoin = "round";

  for (const side of [-1, 1]) {
    const cx = side * 0.033, cy = 0.004;
    if (!seen(cx, cy)) continue;
    const open = clamp(eyeOpen, 0.06, 1.7) * 0.0115;
    const ring = (rx, ry, dx = 0) =>
      path(Array.from({ length: 18 }, (_, k) => [
        cx + dx + rx * Math.cos((k * Math.PI) / 9), cy + clamp(ry * Math.sin((k * Math.PI) / 9), -open, open),
      ]));
    tracePoints(ctx, ring(0.0175, open));
    ctx.closePath();
    ctx.fillStyle = theme.eyeWhite;
    ctx.fill();
    ctx.strokeStyle = theme.feature;
    ctx.lineWidth = clamp(0.0025 * pixel, 0.5, 3);
    ctx.stroke();
    tracePoints(ctx, ring(0.0088, 0.0095));
    ctx.closePath();
    ctx.fillStyle = theme.feature;
    ctx.fill();
    // Lowered brows make an angry V, a frown lifts their inner ends as sorrow does.
    const lift = clamp(brow, -1.5, 1.5), raise = lift * (lift > 0 ? 0.013 : 0.004);
    const inner = 0.007 * frown + Math.min(lift, 0) * 0.013;
    tracePoints(ctx, path([
      [side * 0.014, 0.031 + raise + inner], [side * 0.032, 0.039 + raise + 0.25 * inner],
      [side * 0.052, 0.033 + raise * 0.8 - 0.003 * frown],
    ]));
    ctx.lineWidth = clamp(0.0065 * pixel, 1, 7);
    ctx.strokeStyle = theme.brow;
    ctx.stroke();
  }

  if (seen(0, -0.055)) drawMouth(ctx, path, theme, pixel, clamp(smile - frown, -1.5, 1.5), clamp(mouthOpen, 0, 1.5));
  const nose = path([[0, 0.012, 0.001], [0.002, -0.02, 0.02], [-0.004, -0.027, 0.003]]);
  if (nose[0].facing > -0.1) {
    tracePoints(ctx, nose);
    ctx.strokeStyle = theme.nose;
    ctx.lineWidth = clamp(0.0045 * pixel, 0.8, 5);
    ctx.stroke();
  }
}

function drawMouth(ctx, path, theme, pixel, curve, open) {
  const wide = 0.03 + 0.006 * Math.max(curve, 0) - 0.006 * Math.min(open, 1);
  const lip = (drop) =>
    Array.from({ length: 11 }, (_, k) => {
      const u = (k - 5) / 5;
      return [wide * u, -0.055 + curve * 0.019 * (u * u - 0.45) - drop * (1 - u * u)];
    });
  const upper = lip(-0.006 * open), lower = lip(0.032 * open);
  tracePoints(ctx, path([...upper, ...lower.reverse()]));
  ctx.closePath();
  if (open > 0.08) {
    ctx.fillStyle = theme.mouth;
    ctx.fill();
  }
  ctx.strokeStyle = theme.lip;
  ctx.lineWidth = clamp(0.0058 * pixel, 1, 6);
  ctx.stroke();
}

/* The figure: shaded tapered limbs, trunk hulls and head, painted from far to near. */

const LAMP = [-0.55, -0.83]; // where light comes from on the screen
const FOG_STEPS = 10;
const TRUNK_BIAS = 0.05; // metres: a thigh or upper arm must stand out this far to be painted over the trunk
const NECK_BIAS = 0.06; // and the neck goes under the chin
const SKIN = 3;

const parseColour = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
const toColour = (rgb) => `rgb(${rgb.map((v) => Math.round(clamp(v, 0, 255))).join(",")})`;
const blend = (a, b, t) => a.map((v, k) => mix(v, b[k], t));

/* Tones of one body colour at each depth of fog. */
function toneRamp(hex, fogHex, strength) {
  const colour = parseColour(hex), fog = parseColour(fogHex);
  return Array.from({ length: FOG_STEPS + 1 }, (_, k) => {
    const haze = (c) => toColour(blend(c, fog, (strength * k) / FOG_STEPS));
    return {
      light: haze(blend(colour, [255, 255, 255], 0.36)), base: haze(colour),
      dark: haze(blend(colour, [12, 16, 34], 0.46)), edge: haze(blend(colour, [8, 10, 24], 0.62)),
    };
  });
}

/* Interpolated drawing nodes of a clip at a fractional frame: flat [M * 3]. */
function nodesAt(clip, figure, frame) {
  const k = Math.min(Math.floor(frame), clip.frames - 1), next = Math.min(k + 1, clip.frames - 1), t = frame - k;
  const width = clip.joints * 3, p = clip.positions, out = clip.nodes;
  figure.blends.forEach((parts, node) => {
    let x = 0, y = 0, z = 0;
    for (const [joint, weight] of parts) {
      const i = k * width + joint * 3, j = next * width + joint * 3;
      x += weight * mix(p[i], p[j], t);
      y += weight * mix(p[i + 1], p[j + 1], t);
      z += weight * mix(p[i + 2], p[j + 2], t);
    }
    out[3 * node] = x; out[3 * node + 1] = y; out[3 * node + 2] = z;
  });
  return out;
}

function limbShade(ctx, tones, x1, y1, x2, y2, r) {
  let nx = -(y2 - y1), ny = x2 - x1;
  const length = Math.hypot(nx, ny);
  if (length < 1e-3) [nx, ny] = LAMP; else { nx /= length; ny /= length; }
  let lit = nx * LAMP[0] + ny * LAMP[1];
  if (lit < 0) { nx = -nx; ny = -ny; lit = -lit; }
  const mx = (x1 + x2) / 2, my = (y1 + y2) / 2;
  const shade = ctx.createLinearGradient(mx + nx * r, my + ny * r, mx - nx * r, my - ny * r);
  const peak = 0.5 - 0.3 * lit;
  shade.addColorStop(0, tones.base);
  shade.addColorStop(peak, tones.light);
  shade.addColorStop(Math.min(peak + 0.34, 0.8), tones.base);
  shade.addColorStop(1, tones.dark);
  return shade;
}

function drawFigure(ctx, lens, clip, figure, nodes, face, theme) {
  const count = figure.blends.length, s = clip.screen;
  for (let k = 0; k < count; k++) projectTo(lens, nodes[3 * k], nodes[3 * k + 1], nodes[3 * k + 2], s, 4 * k);
  const items = [];
  const fogOf = (depth) => clamp(Math.round(((depth - lens.distance + 0.3) / 1.6) * FOG_STEPS), 0, FOG_STEPS);

  for (const [a, b, ra, rb, side, fine] of figure.capsules) {
    if (s[4 * a + 2] < NEAR || s[4 * b + 2] < NEAR) continue;
    const depth = (s[4 * a + 2] + s[4 * b + 2]) / 2 + (side === SKIN ? NECK_BIAS : 0);
    items.push({ depth, draw: () => drawLimb(ctx, s, a, b, ra * clip.scale, rb * clip.scale, fine, theme.tones[side][fogOf(depth)]) });
  }
  for (const [side, members, radii] of figure.hulls) {
    if (members.some((m) => s[4 * m + 2] < NEAR)) continue;
    const depth = members.reduce((sum, m) => sum + s[4 * m + 2], 0) / members.length - (side ? 0 : TRUNK_BIAS);
    items.push({ depth, draw: () => drawHull(ctx, s, members, radii, clip.scale, side === 0, theme.tones[side][fogOf(depth)]) });
  }
  if (figure.head && s[4 * figure.head.head + 2] > NEAR) {
    const pose = headPose(nodes, figure.head, clip.scale);
    const depth = project(lens, pose.centre)[2];
    items.push({ depth, draw: () => drawHead(ctx, lens, pose, face, theme, theme.tones[SKIN][fogOf(depth)]) });
  }
  items.sort((p, q) => q.depth - p.depth);
  for (const item of items) item.draw();
}

function drawLimb(ctx, s, a, b, ra, rb, fine, tones) {
  const x1 = s[4 * a], y1 = s[4 * a + 1], x2 = s[4 * b], y2 = s[4 * b + 1];
  const r1 = Math.max(ra * s[4 * a + 3], 0.6), r2 = Math.max(rb * s[4 * b + 3], 0.6);
  ctx.beginPath();
  const sides = capsulePath(ctx, x1, y1, r1, x2, y2, r2);
  if (fine && r1 < 3.5) {
    ctx.lineWidth = 0.8;
    ctx.strokeStyle = tones.edge;
    ctx.stroke();
    ctx.fillStyle = tones.base;
    ctx.fill();
    return;
  }
  ctx.fillStyle = limbShade(ctx, tones, x1, y1, x2, y2, Math.max(r1, r2));
  ctx.fill();
  if (!sides) return;
  // Only the flanks are outlined: round ends stay open, so that limbs flow into each other at the joints.
  ctx.beginPath();
  for (const angle of sides) {
    ctx.moveTo(x1 + r1 * Math.cos(angle), y1 + r1 * Math.sin(angle));
    ctx.lineTo(x2 + r2 * Math.cos(angle), y2 + r2 * Math.sin(angle));
  }
  ctx.lineWidth = 1;
  ctx.strokeStyle = tones.edge;
  ctx.stroke();
}

function drawHull(ctx, s, members, radii, scale, deep, tones) {
  const circles = [];
  let x = 0, y = 0;
  members.forEach((m, k) => {
    circles.push(s[4 * m], s[4 * m + 1], radii[k] * scale * s[4 * m + 3]);
    x += s[4 * m] / members.length;
    y += s[4 * m + 1] / members.length;
  });
  const outline = hullOfCircles(circles);
  let reach = 0;
  for (let i = 0; i < outline.length; i += 2) reach = Math.max(reach, Math.hypot(outline[i] - x, outline[i + 1] - y));
  const shade = ctx.createRadialGradient(x + LAMP[0] * 0.45 * reach, y + LAMP[1] * 0.45 * reach, 0, x, y, 1.15 * reach);
  shade.addColorStop(0, tones.light);
  shade.addColorStop(0.45, tones.base);
  shade.addColorStop(1, deep ? tones.dark : tones.base);
  ctx.beginPath();
  polygonPath(ctx, outline);
  ctx.fillStyle = shade;
  ctx.fill();
  ctx.lineWidth = 1;
  ctx.strokeStyle = tones.edge;
  ctx.globalAlpha = deep ? 0.55 : 0.4;
  ctx.stroke();
  ctx.globalAlpha = 1;
}

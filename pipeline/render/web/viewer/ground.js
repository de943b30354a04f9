/* What lies around the figure: the ground disc with its grid, and the root's path. */

const SOLE = 0.03; // the foot joints run above the soles by about this much, metres
const GRID_REACH = 4;

function drawGround(ctx, lens, centre, floor, theme) {
  const y = floor - SOLE;
  const middle = project(lens, [centre[0], y, centre[1]]);
  const reach = GRID_REACH * middle[3];
  const glow = ctx.createRadialGradient(middle[0], middle[1], 0, middle[0], middle[1], reach * 0.8);
  glow.addColorStop(0, theme.floorNear);
  glow.addColorStop(1, theme.floorFar);
  ctx.fillStyle = glow;
  ctx.beginPath();
  for (let k = 0; k < 48; k++) {
    const angle = (k * Math.PI) / 24;
    const p = project(lens, [centre[0] + GRID_REACH * Math.cos(angle), y, centre[1] + GRID_REACH * Math.sin(angle)]);
    if (p[2] > NEAR) ctx.lineTo(p[0], p[1]);
  }
  ctx.fill();
  drawGrid(ctx, lens, centre, y, theme);
}

/* Half-metre squares, fixed in the world, that fade with the distance from `centre`. */
function drawGrid(ctx, lens, centre, y, theme) {
  const bands = 5;
  const strokes = [Array.from({ length: bands }, () => []), Array.from({ length: bands }, () => [])];
  const piece = 0.5;
  for (const alongX of [true, false]) {
    const [u0, v0] = alongX ? centre : [centre[1], centre[0]];
    for (let v = Math.ceil((v0 - GRID_REACH) * 2) / 2; v <= v0 + GRID_REACH; v += 0.5) {
      const half = Math.sqrt(Math.max(GRID_REACH * GRID_REACH - (v - v0) * (v - v0), 0));
      const major = Math.abs(v - Math.round(v)) < 0.01 ? 1 : 0;
      for (let u = u0 - half; u < u0 + half; u += piece) {
        const end = Math.min(u + piece, u0 + half);
        const far = Math.hypot((u + end) / 2 - u0, v - v0) / GRID_REACH;
        const band = Math.min(Math.floor(far * bands), bands - 1);
        strokes[major][band].push(alongX ? [u, v, end, v] : [v, u, v, end]);
      }
    }
  }
  ctx.strokeStyle = theme.grid;
  for (const major of [0, 1]) {
    ctx.lineWidth = major ? 1.2 : 0.7;
    strokes[major].forEach((segments, band) => {
      ctx.globalAlpha = (major ? 0.85 : 0.5) * (1 - band / bands) ** 1.4;
      ctx.beginPath();
      for (const [x1, z1, x2, z2] of segments) {
        const a = project(lens, [x1, y, z1]), b = project(lens, [x2, y, z2]);
        if (a[2] <= NEAR || b[2] <= NEAR) continue;
        ctx.moveTo(a[0], a[1]);
        ctx.lineTo(b[0], b[1]);
      }
      ctx.stroke();
    });
  }
  ctx.globalAlpha = 1;
}

/* The root's way over the ground: all of it faint, what has passed strong, a dot for each second. */
function drawTrail(ctx, lens, clip, frame, theme) {
  const y = clip.floor - SOLE;
  const at = (k) => project(lens, [clip.root(k, 0), y, clip.root(k, 2)]);
  const line = (from, to) => {
    ctx.beginPath();
    let pen = false;
    for (let k = from; k <= to; k++) {
      const p = at(k);
      if (p[2] <= NEAR) { pen = false; continue; }
      if (pen) ctx.lineTo(p[0], p[1]); else ctx.moveTo(p[0], p[1]);
      pen = true;
    }
    ctx.stroke();
  };
  ctx.lineJoin = ctx.lineCap = "round";
  ctx.strokeStyle = ctx.fillStyle = theme.trail;
  ctx.lineWidth = 2;
  ctx.globalAlpha = 0.28;
  line(0, clip.frames - 1);
  ctx.globalAlpha = 0.9;
  ctx.lineWidth = 2.5;
  line(0, Math.floor(frame));
  for (let second = 0; second * clip.fps < clip.frames; second++) {
    const p = at(Math.round(second * clip.fps));
    if (p[2] <= NEAR) continue;
    ctx.globalAlpha = second * clip.fps <= frame ? 0.9 : 0.3;
    ctx.beginPath();
    ctx.ellipse(p[0], p[1], 0.035 * p[3] + 1, (0.035 * p[3] + 1) * Math.max(lens.back[1], 0.3), 0, 0, 2 * Math.PI);
    ctx.fill();
  }
  ctx.globalAlpha = 1;
}

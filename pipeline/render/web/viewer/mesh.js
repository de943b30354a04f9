/* The body's mesh, unpacked from the page's BODY, and fitted to the bones of a clip. */

const arrayOf = (base64, Type) => new Type(bytesOf(base64).buffer);

/* One detail of the body: vertices at rest with normals, four joints and shares, and a colour each; triangles; shapes of the face. */
function openMesh(raw) {
  const packed = arrayOf(raw.places, Uint16Array), places = new Float32Array(packed.length), count = packed.length / 3;
  for (let k = 0; k < places.length; k++) places[k] = raw.low[k % 3] + raw.step[k % 3] * packed[k];
  const row = new Uint16Array(count); // of the shapes' displacements, counted from 1; 0 where a vertex never moves
  arrayOf(raw.moving, Uint16Array).forEach((vertex, k) => { row[vertex] = k + 1; });
  return {
    count, places, row, moves: arrayOf(raw.moves, Int8Array), shapes: raw.shapes, moveStep: raw.moveStep, normals: arrayOf(raw.normals, Int8Array),
    joints: arrayOf(raw.joints, Uint8Array), shares: arrayOf(raw.shares, Uint8Array),
    swatch: arrayOf(raw.swatch, Uint8Array), triangles: arrayOf(raw.triangles, Uint16Array),
  };
}

/* The body as the script carries it, opened when the first figure asks; null on pages without one. */
const openBody = (() => {
  let body = null;
  return () => {
    if (!body && BODY) {
      body = { parents: BODY.parents, rest: arrayOf(BODY.rest, Float32Array), details: BODY.details.map(openMesh) };
    }
    return body;
  };
})();

/* Vertices on a clip's own skeleton, [x, y, z, nx, ny, nz] each: every joint's surroundings stretched as its bones are. */
function fitMesh(mesh, body, pose) {
  const count = pose.jointOf.length, shift = new Float32Array(3 * count), out = new Float32Array(6 * mesh.count);
  for (let j = 0; j < count; j++) {
    const own = pose.jointOf[j], s = 9 * own;
    for (let i = 0; i < 3; i++) {
      shift[3 * j + i] = pose.rest[3 * own + i] - dot(pose.stretch.subarray(s + 3 * i, s + 3 * i + 3), body.rest.subarray(3 * own, 3 * own + 3));
    }
  }
  const local = new Float32Array(9);
  for (let v = 0; v < mesh.count; v++) {
    const place = mesh.places.subarray(3 * v, 3 * v + 3), normal = mesh.normals.subarray(3 * v, 3 * v + 3);
    local.fill(0);
    for (let k = 4 * v; k < 4 * v + 4; k++) {
      const share = mesh.shares[k] / 255, j = mesh.joints[k], s = 9 * pose.jointOf[j];
      if (!share) continue;
      for (let i = 0; i < 9; i++) local[i] += share * pose.stretch[s + i];
      for (let i = 0; i < 3; i++) out[6 * v + i] += share * shift[3 * j + i];
    }
    const rows = [0, 3, 6].map((i) => local.subarray(i, i + 3));
    // Normals turn by the matrix of cofactors, whose rows are products of the others.
    const turned = unit([dot(cross(rows[1], rows[2]), normal), dot(cross(rows[2], rows[0]), normal), dot(cross(rows[0], rows[1]), normal)]);
    for (let i = 0; i < 3; i++) {
      out[6 * v + i] += dot(rows[i], place);
      out[6 * v + 3 + i] = turned[i];
    }
  }
  return out;
}

/* Vertices [x, y, z, nx, ny, nz] each of `fitted`, moved by three rows [m, m, m, shift] a joint, into `out`.

   The script does it, not a shader: so there is one way for browsers with a graphics card and without. */
function skinMesh(mesh, fitted, bones, face, size, out) {
  const { count, joints, shares, row, moves, shapes } = mesh, step = mesh.moveStep * size;
  for (let v = 0; v < count; v++) {
    let o = 4 * v, s = shares[o] / 255, b = 12 * joints[o];
    let xx = s * bones[b], xy = s * bones[b + 1], xz = s * bones[b + 2], xw = s * bones[b + 3];
    let yx = s * bones[b + 4], yy = s * bones[b + 5], yz = s * bones[b + 6], yw = s * bones[b + 7];
    let zx = s * bones[b + 8], zy = s * bones[b + 9], zz = s * bones[b + 10], zw = s * bones[b + 11];
    for (const end = o + 4; ++o < end && shares[o] > 0;) { // the largest shares come first
      s = shares[o] / 255;
      b = 12 * joints[o];
      xx += s * bones[b]; xy += s * bones[b + 1]; xz += s * bones[b + 2]; xw += s * bones[b + 3];
      yx += s * bones[b + 4]; yy += s * bones[b + 5]; yz += s * bones[b + 6]; yw += s * bones[b + 7];
      zx += s * bones[b + 8]; zy += s * bones[b + 9]; zz += s * bones[b + 10]; zw += s * bones[b + 11];
    }
    o = 6 * v;
    let x = fitted[o], y = fitted[o + 1], z = fitted[o + 2];
    if (row[v]) {
      for (let k = 0, at = 3 * shapes * (row[v] - 1); k < shapes; k++, at += 3) {
        const weight = face[k] * step;
        if (weight) { x += weight * moves[at]; y += weight * moves[at + 1]; z += weight * moves[at + 2]; }
      }
    }
    out[o] = xx * x + xy * y + xz * z + xw;
    out[o + 1] = yx * x + yy * y + yz * z + yw;
    out[o + 2] = zx * x + zy * y + zz * z + zw;
    x = fitted[o + 3]; y = fitted[o + 4]; z = fitted[o + 5];
    out[o + 3] = xx * x + xy * y + xz * z;
    out[o + 4] = yx * x + yy * y + yz * z;
    out[o + 5] = zx * x + zy * y + zz * z;
  }
}

/* Skinning on the processor, where the processor makes the pixels too: there a vertex that is moved by the
   shader costs many times as much, because each of its bones is fetched by itself. */

/* Vertices [x, y, z, nx, ny, nz] each of `fitted`, moved by three rows [m, m, m, shift] a joint, into `out`. */
function skinMesh(mesh, fitted, bones, face, size, out) {
  const { count, joints, shares, row, rows, shapes } = mesh, step = mesh.moveStep * size;
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
      for (let k = 0, at = 4 * shapes * row[v]; k < shapes; k++, at += 4) {
        const weight = face[k] * step;
        if (weight) { x += weight * rows[at]; y += weight * rows[at + 1]; z += weight * rows[at + 2]; }
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

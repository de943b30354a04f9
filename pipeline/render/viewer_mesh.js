/* The body's mesh, unpacked from the page's BODY, and fitted to the bones of a clip. */

const arrayOf = (base64, Type) => new Type(bytesOf(base64).buffer);

/* One detail of the body: vertices at rest, four joints and shares each, colours, triangles, shapes of the face. */
function openMesh(raw) {
  const packed = arrayOf(raw.places, Uint16Array), places = new Float32Array(3 * raw.count);
  for (let k = 0; k < places.length; k++) places[k] = raw.low[k % 3] + raw.step[k % 3] * packed[k];
  // Row 0 of the shapes' displacements is for vertices that never move; those that do have the rows below.
  const moving = arrayOf(raw.moving, Uint16Array), width = raw.shapes.length;
  const moves = arrayOf(raw.moves, Int8Array), rows = new Int8Array(4 * width * (moving.length + 1));
  const row = new Uint16Array(raw.count);
  moving.forEach((vertex, k) => {
    row[vertex] = k + 1;
    for (let s = 0; s < width; s++) {
      for (let i = 0; i < 3; i++) rows[4 * ((k + 1) * width + s) + i] = moves[3 * (k * width + s) + i];
    }
  });
  return {
    count: raw.count, places, row, rows, shapes: width, moveStep: raw.moveStep,
    joints: arrayOf(raw.joints, Uint8Array), shares: arrayOf(raw.shares, Uint8Array),
    colour: arrayOf(raw.colour, Uint8Array), triangles: arrayOf(raw.triangles, Uint16Array),
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
  for (let v = 0; v < mesh.count; v++) {
    const x = mesh.places[3 * v], y = mesh.places[3 * v + 1], z = mesh.places[3 * v + 2];
    for (let k = 4 * v; k < 4 * v + 4; k++) {
      const share = mesh.shares[k] / 255, j = mesh.joints[k], s = 9 * pose.jointOf[j], m = pose.stretch;
      if (!share) continue;
      for (let i = 0; i < 3; i++) {
        out[6 * v + i] += share * (m[s + 3 * i] * x + m[s + 3 * i + 1] * y + m[s + 3 * i + 2] * z + shift[3 * j + i]);
      }
    }
  }
  addNormals(out, mesh.triangles);
  return out;
}

/* Sums of the triangles' own, each by its area. */
function addNormals(out, triangles) {
  const at = (v) => [out[6 * v], out[6 * v + 1], out[6 * v + 2]];
  for (let k = 0; k < triangles.length; k += 3) {
    const p = at(triangles[k]), n = cross(minus(at(triangles[k + 1]), p), minus(at(triangles[k + 2]), p));
    for (let c = 0; c < 3; c++) for (let i = 0; i < 3; i++) out[6 * triangles[k + c] + 3 + i] += n[i];
  }
  for (let v = 3; v < out.length; v += 6) {
    const n = unit([out[v], out[v + 1], out[v + 2]]);
    for (let i = 0; i < 3; i++) out[v + i] = n[i];
  }
}

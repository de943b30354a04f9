/* From a clip's joints and rotations to one matrix a bone, at any time between frames. */

const BONE_STRETCH = [0.5, 2]; // a bone is drawn no shorter and no longer than so many times its own length

/* What a clip brings beside its positions; null where its skeleton has no body. */
function openPose(raw, joints) {
  const body = raw.pose ? openBody() : null;
  if (!body) return null;
  const parents = body.parents.slice(0, joints), ends = parents.map((_, j) => {
    const children = parents.flatMap((parent, k) => (parent === j ? [k] : []));
    return children.length === 1 ? children[0] : -1;
  });
  const rowOf = new Int16Array(joints).fill(-1);
  raw.pose.turning.forEach((joint, k) => { rowOf[joint] = k; });
  const pose = {
    parents, ends, rowOf, width: raw.pose.turning.length, size: raw.pose.size,
    rest: arrayOf(raw.pose.rest, Float32Array), stretch: arrayOf(raw.pose.stretch, Float32Array),
    turns: unpackTurns(arrayOf(raw.pose.turns, Uint32Array)),
    // Which of the clip's joints moves each of the mesh's: fingers that a skeleton lacks go with their wrist.
    jointOf: body.parents.map((_, j) => { while (j >= joints) j = body.parents[j]; return j; }),
  };
  pose.matrices = new Float32Array(9 * joints);
  pose.places = new Float32Array(3 * joints);
  pose.quaternions = new Float32Array(4 * joints);
  pose.bones = new Float32Array(12 * pose.jointOf.length);
  return pose;
}

/* Quaternions x, y, z, w of rotations packed as `viewer.py` does it. */
function unpackTurns(packed) {
  const out = new Float32Array(4 * packed.length), wide = Math.SQRT2 / 1022, low = Math.SQRT1_2;
  packed.forEach((value, k) => {
    const left = value >>> 30;
    let rest = 1;
    for (let i = 1; i < 4; i++) {
      const part = ((value >>> (30 - 10 * i)) & 1023) * wide - low;
      out[4 * k + ((left + i) & 3)] = part;
      rest -= part * part;
    }
    out[4 * k + left] = Math.sqrt(Math.max(rest, 0));
  });
  return out;
}

/* Three rows [m, m, m, shift] for each joint of the mesh: what moves its vertices from rest to `frame` of the clip. */
function bonesAt(clip, frame) {
  const pose = clip.pose, k = Math.min(Math.floor(frame), clip.frames - 1), next = Math.min(k + 1, clip.frames - 1), t = frame - k;
  const { matrices, places, rest, bones } = pose;
  jointsAt(clip, frame, places);
  for (let j = 0; j < clip.joints; j++) {
    if (pose.rowOf[j] < 0) pose.quaternions.copyWithin(4 * j, 4 * pose.parents[j], 4 * pose.parents[j] + 4);
    else turnBetween(pose, j, k, next, t);
    matrixOf(pose.quaternions, 4 * j, matrices, 9 * j);
  }
  for (let j = 0; j < clip.joints; j++) if (pose.ends[j] >= 0) stretchBone(pose, j, pose.ends[j]);
  for (let b = 0; b < pose.jointOf.length; b++) {
    const j = pose.jointOf[b];
    for (let i = 0; i < 3; i++) {
      const m = 9 * j + 3 * i, x = matrices[m], y = matrices[m + 1], z = matrices[m + 2], o = 12 * b + 4 * i;
      bones[o] = x; bones[o + 1] = y; bones[o + 2] = z;
      bones[o + 3] = places[3 * j + i] - (x * rest[3 * j] + y * rest[3 * j + 1] + z * rest[3 * j + 2]);
    }
  }
  return bones;
}

function turnBetween(pose, joint, k, next, t) {
  const a = 4 * (k * pose.width + pose.rowOf[joint]), b = 4 * (next * pose.width + pose.rowOf[joint]), q = pose.turns;
  const along = q[a] * q[b] + q[a + 1] * q[b + 1] + q[a + 2] * q[b + 2] + q[a + 3] * q[b + 3], s = along < 0 ? -t : t;
  let size = 0;
  for (let i = 0; i < 4; i++) {
    const value = q[a + i] * (1 - t) + q[b + i] * s;
    pose.quaternions[4 * joint + i] = value;
    size += value * value;
  }
  for (let i = 0; i < 4; i++) pose.quaternions[4 * joint + i] /= Math.sqrt(size);
}

function matrixOf(q, at, out, to) {
  const x = q[at], y = q[at + 1], z = q[at + 2], w = q[at + 3];
  out[to] = 1 - 2 * (y * y + z * z); out[to + 1] = 2 * (x * y - z * w); out[to + 2] = 2 * (x * z + y * w);
  out[to + 3] = 2 * (x * y + z * w); out[to + 4] = 1 - 2 * (x * x + z * z); out[to + 5] = 2 * (y * z - x * w);
  out[to + 6] = 2 * (x * z - y * w); out[to + 7] = 2 * (y * z + x * w); out[to + 8] = 1 - 2 * (x * x + y * y);
}

/* A bone that is not as long as at rest stretches what hangs on it, along itself. */
function stretchBone(pose, joint, end) {
  const { matrices, places, rest } = pose, m = 9 * joint;
  const bone = [0, 1, 2].map((i) => rest[3 * end + i] - rest[3 * joint + i]), length = Math.hypot(...bone);
  if (length < 1e-6) return;
  const now = Math.hypot(...[0, 1, 2].map((i) => places[3 * end + i] - places[3 * joint + i]));
  const more = clamp(now / length, ...BONE_STRETCH) - 1, along = bone.map((v) => v / length);
  for (let i = 0; i < 3; i++) {
    const line = more * (matrices[m + 3 * i] * along[0] + matrices[m + 3 * i + 1] * along[1] + matrices[m + 3 * i + 2] * along[2]);
    for (let c = 0; c < 3; c++) matrices[m + 3 * i + c] += line * along[c];
  }
}

/* Weights of the face's shapes, of the five controls: the ends of each control are shapes of their own. */
function faceWeights([smile, brow, eye, mouth, frown]) {
  return [
    clamp(smile, -0.5, 1.5), clamp(frown, -0.5, 1.5), clamp(brow, 0, 1.5), clamp(-brow, 0, 1.5),
    clamp((eye - 1) / 0.6, 0, 1.2), clamp(1 - eye, 0, 1), clamp(mouth, 0, 1.5),
  ];
}

'use strict';
// Draws one GLB character with its skin, shapes and base colours, and plays its animations. Nothing is loaded.
// `root` holds nodes with `data-rig`: title, note, canvas, play, motion, time, clock; and buttons with `data-turn`.
// It ends when another one is drawn in the same root.
window.motionloomRig = async (root, data) => {
  const one = (name) => root.querySelector(`[data-rig=${name}]`);
  one('title').textContent = data.title;
  one('note').textContent = data.note;
  const file = Uint8Array.from(atob(data.glb), (letter) => letter.charCodeAt(0));
  const view = new DataView(file.buffer);
  const length = view.getUint32(12, true);
  const gltf = JSON.parse(new TextDecoder().decode(file.subarray(20, 20 + length)));
  const bin = file.subarray(28 + length);

  // Numbers of accessors.
  const KINDS = {
    5120: [Int8Array, 127], 5121: [Uint8Array, 255], 5122: [Int16Array, 32767], 5123: [Uint16Array, 65535],
    5125: [Uint32Array, 1], 5126: [Float32Array, 1],
  };
  const WIDTHS = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4, MAT4: 16 };
  function plain(viewNumber, offset, componentType, count, width) {
    const about = gltf.bufferViews[viewNumber];
    const [Kind] = KINDS[componentType];
    const size = Kind.BYTES_PER_ELEMENT;
    const stride = about.byteStride || size * width;
    const out = new Kind(count * width);
    const bytes = new Uint8Array(out.buffer);
    const start = (about.byteOffset || 0) + (offset || 0);
    for (let row = 0; row < count; row++) {
      bytes.set(bin.subarray(start + row * stride, start + row * stride + size * width), row * size * width);
    }
    return out;
  }
  function values(number) {
    const about = gltf.accessors[number];
    const width = WIDTHS[about.type];
    const [Kind, most] = KINDS[about.componentType];
    let out = about.bufferView === undefined
      ? new Kind(about.count * width)
      : plain(about.bufferView, about.byteOffset, about.componentType, about.count, width);
    if (about.sparse) {
      const { count, indices, values: moved } = about.sparse;
      const at = plain(indices.bufferView, indices.byteOffset, indices.componentType, count, 1);
      const rows = plain(moved.bufferView, moved.byteOffset, about.componentType, count, width);
      for (let row = 0; row < count; row++) out.set(rows.subarray(row * width, (row + 1) * width), at[row] * width);
    }
    if (about.normalized) out = Float32Array.from(out, (value) => Math.max(value / most, -1));
    return out;
  }

  // Matrices, column by column.
  function multiply(a, b) {
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[k * 4 + r] * b[c * 4 + k];
      out[c * 4 + r] = sum;
    }
    return out;
  }
  function matrixOf(t, q, s) {
    const [x, y, z, w] = q;
    return new Float32Array([
      (1 - 2 * (y * y + z * z)) * s[0], 2 * (x * y + z * w) * s[0], 2 * (x * z - y * w) * s[0], 0,
      2 * (x * y - z * w) * s[1], (1 - 2 * (x * x + z * z)) * s[1], 2 * (y * z + x * w) * s[1], 0,
      2 * (x * z + y * w) * s[2], 2 * (y * z - x * w) * s[2], (1 - 2 * (x * x + y * y)) * s[2], 0,
      t[0], t[1], t[2], 1,
    ]);
  }

  const nodes = gltf.nodes.map((node) => ({
    t: node.translation || [0, 0, 0], q: node.rotation || [0, 0, 0, 1], s: node.scale || [1, 1, 1],
    own: node.matrix ? Float32Array.from(node.matrix) : null, parent: -1, weights: null, world: null,
  }));
  gltf.nodes.forEach((node, number) => (node.children || []).forEach((child) => { nodes[child].parent = number; }));
  const order = [];
  const visit = (number) => { order.push(number); (gltf.nodes[number].children || []).forEach(visit); };
  nodes.forEach((node, number) => { if (node.parent < 0) visit(number); });

  // Animations.
  const motions = (gltf.animations || []).map((animation) => {
    const channels = animation.channels.map((channel) => {
      const sampler = animation.samplers[channel.sampler];
      const times = values(sampler.input);
      const keys = values(sampler.output);
      return { ...channel.target, times, keys, width: keys.length / times.length };
    });
    return { name: animation.name, channels, end: Math.max(...channels.map((c) => c.times[c.times.length - 1])) };
  });
  function pose(motion, time) {
    for (const { node, path, times, keys, width } of motion.channels) {
      let right = 0;
      while (right < times.length - 1 && times[right] < time) right++;
      const left = Math.max(right - 1, 0);
      const span = times[right] - times[left];
      const share = span > 0 ? Math.min(Math.max((time - times[left]) / span, 0), 1) : 0;
      const now = [];
      for (let k = 0; k < width; k++) now.push(keys[left * width + k] * (1 - share) + keys[right * width + k] * share);
      if (path === 'rotation') {
        const size = Math.hypot(...now);
        nodes[node].q = now.map((value) => value / size);
      } else if (path === 'translation') nodes[node].t = now;
      else if (path === 'scale') nodes[node].s = now;
      else nodes[node].weights = now;
    }
    for (const number of order) {
      const node = nodes[number];
      const local = node.own || matrixOf(node.t, node.q, node.s);
      node.world = node.parent < 0 ? local : multiply(nodes[node.parent].world, local);
    }
  }

  // Drawing.
  const canvas = one('canvas').cloneNode();
  one('canvas').replaceWith(canvas);
  const gl = canvas.getContext('webgl2', { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    one('note').textContent += '\nThis browser draws no WebGL 2.';
    return;
  }
  function program(vertex, fragment) {
    const out = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, '#version 300 es\nprecision highp float;\n' + text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(out, shader);
    }
    ['position', 'normal', 'uv', 'joints', 'shares'].forEach((name, at) => gl.bindAttribLocation(out, at, name));
    gl.linkProgram(out);
    return out;
  }
  const draw = program(
    `in vec3 position; in vec3 normal; in vec2 uv; in vec4 joints; in vec4 shares;
     uniform mat4 seen, world; uniform sampler2D bones; uniform bool skinned; out vec3 n; out vec2 place;
     mat4 bone(float j) { int i = int(j) * 4; return mat4(texelFetch(bones, ivec2(i, 0), 0),
       texelFetch(bones, ivec2(i + 1, 0), 0), texelFetch(bones, ivec2(i + 2, 0), 0), texelFetch(bones, ivec2(i + 3, 0), 0)); }
     void main() { mat4 m = world;
       if (skinned) m = shares.x * bone(joints.x) + shares.y * bone(joints.y) + shares.z * bone(joints.z) + shares.w * bone(joints.w);
       n = mat3(m) * normal; place = uv; gl_Position = seen * m * vec4(position, 1.0); }`,
    `in vec3 n; in vec2 place; uniform vec4 colour; uniform sampler2D base; uniform float cutoff; uniform bool unlit; out vec4 pixel;
     void main() { vec4 c = colour * texture(base, place); if (c.a < cutoff) discard;
       vec3 d = normalize(n) * (gl_FrontFacing ? 1.0 : -1.0);
       float light = unlit ? 1.0 : 0.55 + 0.15 * d.y + 0.45 * max(dot(d, normalize(vec3(0.4, 0.7, 0.7))), 0.0);
       pixel = vec4(pow(c.rgb * light, vec3(1.0 / 2.2)), c.a); }`,
  );
  const lines = program(
    'in vec3 position; uniform mat4 seen; void main() { gl_Position = seen * vec4(position, 1.0); }',
    'out vec4 pixel; void main() { pixel = vec4(0.8, 0.84, 0.9, 1.0); }',
  );
  function buffer(target, numbers) {
    const out = gl.createBuffer();
    gl.bindBuffer(target, out);
    gl.bufferData(target, numbers, gl.DYNAMIC_DRAW);
    return out;
  }
  const white = new Uint8Array([255, 255, 255, 255]);
  async function texture(number) {
    const out = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, out);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.SRGB8_ALPHA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, white);
    const image = number === undefined ? undefined : gltf.images[gltf.textures[number].source];
    if (image && image.bufferView !== undefined) { // pictures in other files are not opened
      const about = gltf.bufferViews[image.bufferView];
      const start = about.byteOffset || 0;
      const blob = new Blob([bin.subarray(start, start + about.byteLength)], { type: image.mimeType });
      const picture = await createImageBitmap(blob, { colorSpaceConversion: 'none', premultiplyAlpha: 'none' }).catch(() => null);
      if (picture) {
        gl.bindTexture(gl.TEXTURE_2D, out);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.SRGB8_ALPHA8, gl.RGBA, gl.UNSIGNED_BYTE, picture);
        gl.generateMipmap(gl.TEXTURE_2D);
        return out;
      }
    }
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    return out;
  }
  const parts = [];
  for (const [number, node] of gltf.nodes.entries()) {
    if (node.mesh === undefined) continue;
    const mesh = gltf.meshes[node.mesh];
    for (const part of mesh.primitives) {
      const packed = Object.values(part.attributes).some((at) => gltf.bufferViews[gltf.accessors[at].bufferView]?.extensions);
      if ((part.mode ?? 4) !== 4 || packed || part.extensions?.KHR_draco_mesh_compression) continue;
      const material = gltf.materials?.[part.material] || {};
      const colour = material.pbrMetallicRoughness || {};
      const position = Float32Array.from(values(part.attributes.POSITION));
      const count = position.length / 3;
      const index = part.indices === undefined ? Uint32Array.from({ length: count }, (_, k) => k) : Uint32Array.from(values(part.indices));
      let normal = part.attributes.NORMAL === undefined ? null : Float32Array.from(values(part.attributes.NORMAL));
      if (!normal) {
        normal = new Float32Array(position.length);
        for (let k = 0; k < index.length; k += 3) {
          const [a, b, c] = [index[k] * 3, index[k + 1] * 3, index[k + 2] * 3];
          const u = [0, 1, 2].map((x) => position[b + x] - position[a + x]);
          const v = [0, 1, 2].map((x) => position[c + x] - position[a + x]);
          const across = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
          for (const corner of [a, b, c]) for (let x = 0; x < 3; x++) normal[corner + x] += across[x];
        }
      }
      const vao = gl.createVertexArray();
      gl.bindVertexArray(vao);
      const given = [
        [position, 3], [normal, 3],
        [part.attributes.TEXCOORD_0 === undefined ? new Float32Array(count * 2) : Float32Array.from(values(part.attributes.TEXCOORD_0)), 2],
        [part.attributes.JOINTS_0 === undefined ? new Float32Array(count * 4) : Float32Array.from(values(part.attributes.JOINTS_0)), 4],
        [part.attributes.WEIGHTS_0 === undefined ? new Float32Array(count * 4) : Float32Array.from(values(part.attributes.WEIGHTS_0)), 4],
      ];
      const buffers = given.map(([numbers, width], at) => {
        const out = buffer(gl.ARRAY_BUFFER, numbers);
        gl.enableVertexAttribArray(at);
        gl.vertexAttribPointer(at, width, gl.FLOAT, false, 0, 0);
        return out;
      });
      buffer(gl.ELEMENT_ARRAY_BUFFER, index);
      gl.bindVertexArray(null);
      const targets = (part.targets || []).map((target) => (target.POSITION === undefined ? null : values(target.POSITION)));
      const skin = node.skin === undefined ? null : gltf.skins[node.skin];
      parts.push({
        node: number, vao, count: index.length, position, points: buffers[0], targets, skin, joints: given[3][0], shares: given[4][0],
        bind: skin && skin.inverseBindMatrices !== undefined ? values(skin.inverseBindMatrices) : null,
        bones: skin ? gl.createTexture() : null,
        texture: await texture(colour.baseColorTexture?.index), colour: colour.baseColorFactor || [1, 1, 1, 1],
        cutoff: material.alphaMode === 'MASK' ? material.alphaCutoff ?? 0.5 : 0.003, blend: material.alphaMode === 'BLEND',
        unlit: Boolean(material.extensions?.KHR_materials_unlit),
      });
    }
  }
  parts.sort((a, b) => a.blend - b.blend);
  const grid = [];
  for (let k = -20; k <= 20; k++) grid.push(k / 2, 0, -10, k / 2, 0, 10, -10, 0, k / 2, 10, 0, k / 2);
  const floor = gl.createVertexArray();
  gl.bindVertexArray(floor);
  buffer(gl.ARRAY_BUFFER, new Float32Array(grid));
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);

  // It may be taller than a grown person of its legs: what is drawn of its first moment says.
  let size = data.size;
  if (motions.length) pose(motions[0], 0);
  for (const { node, skin, bind, position, joints, shares } of motions.length ? parts : []) {
    for (let k = 0; k < position.length / 3; k += 7) {
      const four = [0, 1, 2, 3].map((n) => shares[k * 4 + n]);
      const joint = joints[k * 4 + four.indexOf(Math.max(...four))];
      const world = skin ? nodes[skin.joints[joint]].world : nodes[node].world;
      const m = skin && bind ? multiply(world, bind.subarray(joint * 16, joint * 16 + 16)) : world;
      const [x, y, z] = position.subarray(k * 3, k * 3 + 3);
      size = Math.min(Math.max(size, 1.05 * (m[1] * x + m[5] * y + m[9] * z + m[13])), 3 * data.size);
    }
  }

  let turn = 0.7;
  let tilt = 0.12;
  let far = 1;
  function frame() {
    const width = canvas.clientWidth * devicePixelRatio;
    const height = canvas.clientHeight * devicePixelRatio;
    if (canvas.width !== Math.round(width) || canvas.height !== Math.round(height)) {
      canvas.width = Math.round(width);
      canvas.height = Math.round(height);
    }
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.93, 0.95, 0.98, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    // The camera looks at the hips from around, as far away as the character is tall.
    const hips = nodes[data.hips].world;
    const at = [hips[12], size * 0.5, hips[14]];
    const away = size * 1.9 * far;
    const angle = turn + data.ahead;
    const back = [Math.sin(angle) * Math.cos(tilt), Math.sin(tilt), Math.cos(angle) * Math.cos(tilt)];
    const side = [Math.cos(angle), 0, -Math.sin(angle)];
    const up = [back[1] * side[2] - back[2] * side[1], back[2] * side[0] - back[0] * side[2], back[0] * side[1] - back[1] * side[0]];
    const eye = at.map((value, k) => value + back[k] * away);
    const dot = (a) => -(a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2]);
    const look = new Float32Array([
      side[0], up[0], back[0], 0, side[1], up[1], back[1], 0, side[2], up[2], back[2], 0, dot(side), dot(up), dot(back), 1,
    ]);
    const [near, end, focus] = [size * 0.02, size * 40, 1 / Math.tan(0.32)];
    const lens = new Float32Array([
      (focus * height) / width, 0, 0, 0, 0, focus, 0, 0, 0, 0, (end + near) / (near - end), -1, 0, 0, (2 * end * near) / (near - end), 0,
    ]);
    const seen = multiply(lens, look);
    gl.useProgram(lines);
    gl.uniformMatrix4fv(gl.getUniformLocation(lines, 'seen'), false, seen);
    gl.bindVertexArray(floor);
    gl.drawArrays(gl.LINES, 0, grid.length / 3);
    gl.useProgram(draw);
    const uniform = (name) => gl.getUniformLocation(draw, name);
    gl.uniformMatrix4fv(uniform('seen'), false, seen);
    gl.uniform1i(uniform('base'), 0);
    gl.uniform1i(uniform('bones'), 1);
    for (const part of parts) {
      const weights = nodes[part.node].weights || gltf.meshes[gltf.nodes[part.node].mesh].weights;
      if (weights && part.targets.length) {
        const moved = part.position.slice();
        part.targets.forEach((target, k) => {
          if (target && weights[k]) for (let i = 0; i < moved.length; i++) moved[i] += weights[k] * target[i];
        });
        gl.bindBuffer(gl.ARRAY_BUFFER, part.points);
        gl.bufferSubData(gl.ARRAY_BUFFER, 0, moved);
      }
      if (part.skin) {
        const matrices = new Float32Array(part.skin.joints.length * 16);
        part.skin.joints.forEach((joint, k) => {
          const world = nodes[joint].world;
          matrices.set(part.bind ? multiply(world, part.bind.subarray(k * 16, k * 16 + 16)) : world, k * 16);
        });
        gl.activeTexture(gl.TEXTURE1);
        gl.bindTexture(gl.TEXTURE_2D, part.bones);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, matrices.length / 4, 1, 0, gl.RGBA, gl.FLOAT, matrices);
        for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
      }
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, part.texture);
      gl.uniform1i(uniform('skinned'), part.skin ? 1 : 0);
      gl.uniform1i(uniform('unlit'), part.unlit ? 1 : 0);
      gl.uniform1f(uniform('cutoff'), part.cutoff);
      gl.uniform4fv(uniform('colour'), part.colour);
      gl.uniformMatrix4fv(uniform('world'), false, nodes[part.node].world);
      (part.blend ? gl.enable : gl.disable).call(gl, gl.BLEND);
      gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      gl.bindVertexArray(part.vao);
      gl.drawElements(gl.TRIANGLES, part.count, gl.UNSIGNED_INT, 0);
    }
  }

  // Controls.
  const [play, chosen, slider, clock] = ['play', 'motion', 'time', 'clock'].map(one);
  chosen.replaceChildren(...motions.map((motion, number) => new Option(motion.name, number)));
  let time = 0;
  let going = !matchMedia('(prefers-reduced-motion: reduce)').matches;
  let last = performance.now();
  const label = () => { play.textContent = going ? 'Pause' : 'Play'; };
  play.onclick = () => { going = !going; label(); };
  slider.oninput = () => { time = slider.value * motions[chosen.value].end; going = false; label(); };
  chosen.onchange = () => { time = 0; };
  root.querySelectorAll('[data-turn]').forEach((button) => { button.onclick = () => { turn = Number(button.dataset.turn); }; });
  canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
  canvas.onpointermove = (event) => {
    if (!event.buttons) return;
    turn -= event.movementX * 0.01;
    tilt = Math.min(Math.max(tilt + event.movementY * 0.01, -0.3), 1.5);
  };
  canvas.onwheel = (event) => { event.preventDefault(); far = Math.min(Math.max(far * Math.exp(event.deltaY * 0.001), 0.15), 5); };
  root.onkeydown = (event) => {
    if (event.key !== ' ' || event.target.closest('button, input, select')) return;
    event.preventDefault();
    play.click();
  };
  label();
  function tick(now) {
    if (!canvas.isConnected) {
      gl.getExtension('WEBGL_lose_context')?.loseContext();
      return;
    }
    const motion = motions[chosen.value];
    if (going) time = (time + (now - last) / 1000) % motion.end;
    last = now;
    slider.value = time / motion.end;
    clock.textContent = `${time.toFixed(2)} / ${motion.end.toFixed(2)} s`;
    pose(motion, time);
    frame();
    requestAnimationFrame(tick);
  }
  requestAnimationFrame(tick);
  window.drawn = parts.length;
};

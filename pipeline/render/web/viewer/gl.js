/* WebGL2 without a framework: programs, the buffers of meshes and clips, and the three things that are drawn. */

const TILE = 128, TILES = 8; // pixels of one figure's shadow, and how many stand side by side

function buildProgram(gl, [vertex, fragment]) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  const at = {};
  for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
    const name = gl.getActiveUniform(program, k).name.replace("[0]", "");
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}

/* All of one context's objects; null where it cannot draw the body. */
function makePainter(gl) {
  const body = openBody();
  const [figures, falls, shadows] = [BODY_PROGRAM, FALL_PROGRAM, SHADOW_PROGRAM].map((source) => buildProgram(gl, source));
  if (!body || !figures || !falls || !shadows) return null;
  const details = body.details.map((mesh) => uploadDetail(gl, mesh));
  const clips = new Map();

  const corners = gl.createVertexArray();
  gl.bindVertexArray(corners);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);

  const fallen = gl.createTexture(), target = gl.createFramebuffer();
  gl.bindTexture(gl.TEXTURE_2D, fallen);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RG8, TILE * TILES, TILE * TILES);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  for (const size of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, size, gl.LINEAR);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, fallen, 0);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);

  /* The clip's own vertices of one detail, fitted when they are first drawn. */
  const arrayOfClip = (clip, level) => {
    if (!clips.has(clip)) clips.set(clip, []);
    const made = clips.get(clip);
    if (!made[level]) made[level] = uploadClip(gl, details[level], fitMesh(details[level].mesh, body, clip.pose));
    return made[level];
  };
  const skin = (item, level) => {
    const own = arrayOfClip(item.clip, level);
    skinMesh(details[level].mesh, own.fitted, item.bones, item.face, item.clip.pose.size, own.placed);
    gl.bindVertexArray(own.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, own.buffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, own.placed);
    gl.drawElements(gl.TRIANGLES, details[level].indices, gl.UNSIGNED_SHORT, 0);
  };
  const aim = (use, { lens, box }) => {
    for (const name of ["eye", "right", "up", "back"]) gl.uniform3fv(use.at[name], lens[name]);
    const [x, y, width, height] = box, focal = 2 * lens.focal;
    gl.uniform4f(use.at.onto, focal / width, focal / height, (2 * (lens.cx - x)) / width - 1, 1 - (2 * (lens.cy - y)) / height);
    gl.uniform2f(use.at.depths, Math.max(lens.distance - 6, 0.05), lens.distance + 6);
  };
  const tileOf = (k) => [k % TILES, Math.floor(k / TILES)];

  return {
    most: TILES * TILES,
    /* What every figure's light leaves on the ground, each in a tile of its own. */
    fall(items) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, target);
      gl.disable(gl.DEPTH_TEST);
      gl.disable(gl.CULL_FACE);
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(0, 0, TILE * Math.min(items.length, TILES), TILE * Math.ceil(items.length / TILES));
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.enable(gl.BLEND);
      gl.blendEquation(gl.MAX);
      gl.useProgram(falls.program);
      items.forEach((item, k) => {
        const [column, line] = tileOf(k), [x, z, width, depth] = item.field;
        gl.viewport(column * TILE, line * TILE, TILE, TILE);
        gl.uniform4f(falls.at.field, x + width / 2, z + depth / 2, 2 / width, 2 / depth);
        gl.uniform3f(falls.at.fall, LAMP_SLOPE[0], LAMP_SLOPE[1], item.level);
        skin(item, details.length - 1);
      });
      gl.blendEquation(gl.FUNC_ADD);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    },
    /* Shadow and figure into the item's rectangle [x, y, width, height] of the drawing buffer. */
    draw(item, k) {
      gl.viewport(...item.rect);
      gl.scissor(...item.rect);
      gl.enable(gl.SCISSOR_TEST);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      if (item.lens.back[1] > 0) {
        const [column, line] = tileOf(k);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
        gl.disable(gl.DEPTH_TEST);
        gl.disable(gl.CULL_FACE);
        gl.useProgram(shadows.program);
        aim(shadows, item);
        gl.uniform4fv(shadows.at.ground, item.field);
        gl.uniform1f(shadows.at.level, item.level);
        gl.uniform4f(shadows.at.tile, column / TILES, line / TILES, 1 / TILES, 1 / TILES);
        gl.uniform2f(shadows.at.spread, SHADOW_SPREAD / item.field[2], SHADOW_SPREAD / item.field[3]);
        gl.uniform3fv(shadows.at.tint, item.shadow);
        gl.uniform1i(shadows.at.taps, item.taps);
        gl.uniform1i(shadows.at.fallen, 1);
        gl.activeTexture(gl.TEXTURE1);
        gl.bindTexture(gl.TEXTURE_2D, fallen);
        gl.bindVertexArray(corners);
        gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
        gl.disable(gl.BLEND);
      }
      gl.enable(gl.DEPTH_TEST);
      gl.enable(gl.CULL_FACE);
      gl.useProgram(figures.program);
      aim(figures, item);
      gl.uniform3fv(figures.at.palette, item.palette);
      gl.uniform3fv(figures.at.lamp, LAMP_ABOVE);
      skin(item, item.detail);
    },
    forget(clip) {
      for (const made of clips.get(clip) || []) if (made) made.remove();
      clips.delete(clip);
    },
  };
}

function uploadDetail(gl, mesh) {
  const fill = (data, kind) => {
    const buffer = gl.createBuffer();
    gl.bindVertexArray(null);
    gl.bindBuffer(kind, buffer);
    gl.bufferData(kind, data, gl.STATIC_DRAW);
    return buffer;
  };
  return {
    mesh, indices: mesh.triangles.length, triangles: fill(mesh.triangles, gl.ELEMENT_ARRAY_BUFFER),
    swatch: fill(mesh.swatch, gl.ARRAY_BUFFER),
  };
}

/* A clip's own vertices at rest, and in `placed` where they are moved to. */
function uploadClip(gl, detail, fitted) {
  const array = gl.createVertexArray(), buffer = gl.createBuffer();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, fitted, gl.DYNAMIC_DRAW);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 24, 0);
  gl.vertexAttribPointer(1, 3, gl.FLOAT, false, 24, 12);
  gl.bindBuffer(gl.ARRAY_BUFFER, detail.swatch);
  gl.vertexAttribIPointer(2, 1, gl.UNSIGNED_BYTE, 0, 0);
  for (const k of [0, 1, 2]) gl.enableVertexAttribArray(k);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, detail.triangles);
  gl.bindVertexArray(null);
  return { array, buffer, fitted, placed: new Float32Array(fitted.length), remove: () => { gl.deleteVertexArray(array); gl.deleteBuffer(buffer); } };
}

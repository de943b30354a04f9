/* The programs of the WebGL2 view: the body, its fall onto the ground, and the soft shadow there. */

/* Vertices come as the script has moved them (mesh.js). */
const PLACED = `#version 300 es
precision highp float;
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 normal;
layout(location = 2) in uint swatch;
`;

/* The lens of space.js: `onto` scales and moves its pixels into the box that is drawn, `depths` is near and far. */
const LENS = `
uniform vec3 eye, right, up, back;
uniform vec4 onto;
uniform vec2 depths;
vec4 seen(vec3 p) {
  vec3 d = p - eye;
  float depth = -dot(d, back);
  float z = ((depths.y + depths.x) * depth - 2.0 * depths.y * depths.x) / (depths.y - depths.x);
  return vec4(dot(d, right) * onto.x + depth * onto.z, dot(d, up) * onto.y + depth * onto.w, z, depth);
}
`;

const BODY_PROGRAM = [`${PLACED}${LENS}
out vec3 vNormal;
out vec3 vPlace;
flat out uint vSwatch;
void main() {
  vPlace = place;
  vNormal = normal;
  vSwatch = swatch;
  gl_Position = seen(place);
}`, `#version 300 es
precision highp float;
in vec3 vNormal;
in vec3 vPlace;
flat in uint vSwatch;
uniform vec3 palette[10];
uniform vec3 eye, lamp;
out vec4 shade;
void main() {
  vec3 n = normalize(vNormal), v = normalize(eye - vPlace), base = palette[vSwatch];
  bool painted = vSwatch > 4u; // on the face
  float facing = max(dot(n, v), 0.0);
  float key = max((dot(n, lamp) + 0.2) / 1.2, 0.0);
  float sky = 0.5 + 0.5 * n.y;
  float light = 0.48 + 0.16 * sky + 0.46 * key + 0.12 * facing;
  if (painted) light = mix(light, 1.0, 0.5);
  float shine = max(dot(n, normalize(lamp + v)), 0.0), far = 1.0 - facing;
  float four = shine * shine * shine * shine, eight = four * four;
  float gloss = eight * eight * eight * four * (painted ? 0.05 : 0.1), rim = far * far * far;
  vec3 lit = base * mix(vec3(0.86, 0.9, 1.0), vec3(1.03, 1.0, 0.95), clamp(key + 0.25, 0.0, 1.0)) * light;
  lit = mix(lit, lit * 0.72 + vec3(0.1, 0.12, 0.16) * sky, rim * 0.6) + gloss;
  shade = vec4(min(lit, vec3(1.0)), 1.0);
}`];

/* Height above the ground where the light meets it: red falls off within half a metre, green is all of the figure. */
const FALL_PROGRAM = [`${PLACED}
uniform vec4 field;
uniform vec3 fall;
out float vHeight;
void main() {
  vHeight = max(place.y - fall.z, 0.0);
  gl_Position = vec4((place.xz - fall.xy * vHeight - field.xy) * field.zw, 0.0, 1.0);
}`, `#version 300 es
precision highp float;
in float vHeight;
out vec4 shade;
void main() { shade = vec4(clamp(1.0 - vHeight / 0.5, 0.0, 1.0), 1.0, 0.0, 1.0); }`];

const SHADOW_PROGRAM = [`#version 300 es
precision highp float;
layout(location = 0) in vec2 corner;
uniform vec4 ground;
uniform float level;
${LENS}
out vec2 vAt;
void main() {
  vAt = corner;
  gl_Position = seen(vec3(ground.x + corner.x * ground.z, level, ground.y + corner.y * ground.w));
}`, `#version 300 es
precision highp float;
in vec2 vAt;
uniform sampler2D fallen;
uniform vec4 tile;
uniform vec2 spread;
uniform vec3 tint;
uniform int taps;
out vec4 shade;
const vec2 disc[10] = vec2[](
  vec2(0.224, 0.000), vec2(-0.286, 0.262), vec2(0.044, -0.498), vec2(0.360, 0.470), vec2(-0.661, -0.117),
  vec2(0.626, -0.398), vec2(-0.209, 0.779), vec2(-0.399, -0.769), vec2(0.866, 0.316), vec2(-0.901, 0.372));
vec2 at(vec2 move) { return texture(fallen, tile.xy + tile.zw * clamp(vAt + move * spread, 0.0, 1.0)).rg; }
void main() {
  float wide = 0.0, close = at(vec2(0.0)).r;
  for (int k = 0; k < 10; k++) {
    if (k >= taps) break;
    wide += at(disc[k * 10 / taps]).g;
    if (k % 3 == 0) close += at(0.4 * disc[k]).r;
  }
  close /= float((taps + 2) / 3 + 1);
  float dark = 0.2 * wide / float(taps) + 0.3 * close * sqrt(close);
  shade = vec4(tint, 1.0) * dark;
}`];

// GLSL of the primitives that cameras and lidars see (vinesim/kernels/raster/primitives.py): every vertex finds its
// primitive and the pose that carries it in textures, so that a body moves by eight numbers, whatever grows on it.

const COMMON = /* glsl */ `
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
uniform sampler2D poses;      // two texels a carrier: place, quaternion
uniform sampler2D shapes;     // four texels a primitive: a b c d
uniform usampler2D surfaces;  // one texel a primitive: colour and sky in bytes, material, carrier
uniform mat4 projectionMatrix;
uniform mat4 modelViewMatrix;
uniform float leafExtent[24]; // of each outline: largest |u|, lowest and highest v, unused
in vec3 position;
in uint row;
out vec3 vPlace;
out vec3 vNormal;
out vec3 vLocal;              // of leaves: u, v, outline; of others: along, seed
flat out uvec4 vSurface;
flat out vec4 vDetail;

vec3 turn(vec4 q, vec3 v) { return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v); }
vec4 texel(sampler2D table, uint i, int shift) {
  int width = 1 << shift;
  return texelFetch(table, ivec2(int(i) & (width - 1), int(i) >> shift), 0);
}
vec4 shape(int k) { return texel(shapes, row * 4u + uint(k), 10); }
vec3 across(vec3 v) { return normalize(abs(v.z) < 0.8 ? cross(v, vec3(0, 0, 1)) : cross(v, vec3(1, 0, 0))); }
vec3 unpackNormal(float packed) {
  float n = packed - 1.0, level = floor(n / 2047.0);
  vec2 flat2 = vec2(n - level * 2047.0, level) / 2046.0 * 2.0 - 1.0;
  vec3 v = vec3(flat2, 1.0 - abs(flat2.x) - abs(flat2.y));
  if (v.z < 0.0) v.xy = (1.0 - abs(v.yx)) * vec2(v.x < 0.0 ? -1.0 : 1.0, v.y < 0.0 ? -1.0 : 1.0);
  return normalize(v);
}
`;

const FINISH = /* glsl */ `
  vec4 q = texel(poses, vSurface.z * 2u + 1u, 9);
  vPlace = texel(poses, vSurface.z * 2u, 9).xyz + turn(q, p);
  vNormal = turn(q, n);
  vDetail.xyz = turn(q, vDetail.xyz);
  gl_Position = projectionMatrix * modelViewMatrix * vec4(vPlace, 1.0);
}
`;

const START = /* glsl */ `
void main() {
  vSurface = texelFetch(surfaces, ivec2(int(row) & 511, int(row) >> 9), 0);
  vec4 a = shape(0), b = shape(1);
  vec3 p, n;
  vDetail = vec4(0.0);
  vLocal = vec3(0.0);
`;

/** Vertex shaders by the name of the kind. */
export const VERTEX = {
  // position: x y on the unit circle, z: -1 first pole, 0 and 1 rings, 2 last pole
  cone: COMMON + START + /* glsl */ `
  vec3 axis = b.xyz - a.xyz;
  float len = max(length(axis), 1e-9);
  axis /= len;
  vec3 side = across(axis), up = cross(axis, side);
  float s = clamp(position.z, 0.0, 1.0), r = mix(a.w, b.w, s);
  bool pole = position.z < -0.5 || position.z > 1.5;
  n = pole ? axis * (s * 2.0 - 1.0) : side * position.x + up * position.y;
  p = mix(a.xyz, b.xyz, s) + n * r;
  vLocal = vec3(shape(2).x + s * len, shape(2).y, atan(position.y, position.x));
` + FINISH,
  // position: x y on the unit circle, z: 0 and 1 sides, -1 and 2 ends (flat), or their centres
  cylinder: COMMON + START + /* glsl */ `
  vec3 axis = normalize(b.xyz - a.xyz);
  vec3 side = across(axis), up = cross(axis, side);
  float s = clamp(position.z, 0.0, 1.0);
  bool end = position.z < -0.5 || position.z > 1.5;
  vec3 radial = side * position.x + up * position.y;
  n = end ? axis * (s * 2.0 - 1.0) : normalize(radial);
  p = mix(a.xyz, b.xyz, s) + radial * a.w;
` + FINISH,
  spheroid: COMMON + START + /* glsl */ `
  float along = dot(position, b.xyz);
  p = a.xyz + a.w * (position + b.xyz * along * (b.w - 1.0));
  n = normalize(position - b.xyz * along * (1.0 - 1.0 / b.w));
  vDetail = shape(3);
  vLocal = vec3(shape(2).xy, 0.0);
` + FINISH,
  ellipsoid: COMMON + START + /* glsl */ `
  vec3 half3 = vec3(a.w, shape(2).xy);
  p = a.xyz + turn(b, position * half3);
  n = turn(b, normalize(position / half3));
` + FINISH,
  // position: a corner of the cube, normal from the axis whose coordinate is doubled
  box: COMMON + START + /* glsl */ `
  vec3 half3 = vec3(a.w, shape(2).xy);
  vec3 face = step(1.5, abs(position)) * sign(position);
  p = a.xyz + turn(b, clamp(position, -1.0, 1.0) * half3);
  n = turn(b, face);
` + FINISH,
  // not instanced: three vertices after each other are the corners
  triangle: COMMON + START + /* glsl */ `
  vec4 corner = shape(gl_VertexID % 3);
  p = corner.xyz;
  n = unpackNormal(corner.w);
` + FINISH,
  // position: x from -1 to 1 across, y from 0 to 1 along
  leaf: COMMON + START + /* glsl */ `
  vec4 c = shape(2), d = shape(3);
  int outline = int(b.w) * 4;
  float u = position.x * leafExtent[outline], v = mix(leafExtent[outline + 1], leafExtent[outline + 2], position.y);
  float w = -(d.x * u * u + d.y * v * v + d.z * abs(u));
  vec3 side = cross(b.xyz, c.xyz);
  p = a.xyz + a.w * (side * u + b.xyz * v + c.xyz * w);
  n = normalize(c.xyz + side * (2.0 * d.x * u + d.z * sign(u)) + b.xyz * 2.0 * d.y * v);
  vLocal = vec3(u, v, b.w);
  vDetail.w = d.w;
` + FINISH,
};

const LIGHT = /* glsl */ `
precision highp float;
precision highp int;
precision highp sampler2DArray;
uniform vec3 eye;
uniform vec3 sun;
uniform sampler2DArray outlines;
uniform sampler2D sunDepth;
uniform mat4 sunMatrix;

float hash(vec3 p) { p = fract(p * 0.3183099 + 0.1); p *= 17.0; return fract(p.x * p.y * p.z * (p.x + p.y + p.z)); }
float noise(vec3 x) {
  vec3 i = floor(x), f = fract(x);
  f = f * f * (3.0 - 2.0 * f);
  return mix(
    mix(mix(hash(i), hash(i + vec3(1, 0, 0)), f.x), mix(hash(i + vec3(0, 1, 0)), hash(i + vec3(1, 1, 0)), f.x), f.y),
    mix(mix(hash(i + vec3(0, 0, 1)), hash(i + vec3(1, 0, 1)), f.x),
        mix(hash(i + vec3(0, 1, 1)), hash(i + vec3(1, 1, 1)), f.x), f.y), f.z);
}

// Share of the sun's light that reaches a point: four samples of the depth that the sun sees.
float sunShare(vec3 place, vec3 normal, float elsewhere) {
  vec4 clip = sunMatrix * vec4(place + normal * 0.012, 1.0);
  vec3 at = clip.xyz * 0.5 + 0.5;
  vec2 edge = abs(at.xy - 0.5);
  if (max(edge.x, edge.y) > 0.49 || at.z > 1.0) return elsewhere;
  vec2 size = vec2(textureSize(sunDepth, 0)), f = fract(at.xy * size - 0.5);
  ivec2 corner = ivec2(floor(at.xy * size - 0.5));
  vec4 lit;
  for (int k = 0; k < 4; ++k)
    lit[k] = step(at.z - 6e-4, texelFetch(sunDepth, corner + ivec2(k & 1, k >> 1), 0).x);
  return mix(mix(lit.x, lit.y, f.x), mix(lit.z, lit.w, f.x), f.y);
}

vec3 shade(vec3 albedo, vec3 through, vec3 n, vec3 place, float sky, float gloss, float sharp) {
  vec3 view = normalize(eye - place);
  float facing = dot(n, sun), share = sunShare(place, n, smoothstep(0.2, 0.7, sky));
  vec3 light = vec3(2.9, 2.6, 2.15) * max(facing, 0.0) * share;
  light += vec3(0.52, 0.70, 1.0) * sky * (0.62 + 0.38 * n.z) + vec3(0.20, 0.17, 0.11) * (0.15 + 0.85 * sky) * (0.5 - 0.5 * n.z);
  vec3 colour = albedo * light + through * vec3(2.9, 2.6, 2.15) * max(-facing, 0.0) * share;
  vec3 halfway = normalize(view + sun);
  float fresnel = gloss + (1.0 - gloss) * pow(1.0 - max(dot(n, view), 0.0), 5.0);
  colour += vec3(2.9, 2.6, 2.15) * share * step(0.0, facing) * gloss * pow(max(dot(n, halfway), 0.0), sharp) * sharp * 0.12;
  colour += vec3(0.52, 0.70, 1.0) * sky * fresnel * 0.35 * step(0.02, gloss);
  return colour;
}

vec3 display(vec3 colour, vec3 place) {
  float far = 1.0 - exp(-length(eye - place) * 0.0035);
  colour = mix(colour, vec3(0.50, 0.60, 0.72) * 1.1, far) * 0.8;
  colour = colour * (2.51 * colour + 0.03) / (colour * (2.43 * colour + 0.59) + 0.14);
  return pow(clamp(colour, 0.0, 1.0), vec3(1.0 / 2.2));
}
`;

const MATERIALS = `
const uint FOLIAGE = 0u, BERRY = 1u, CANE = 2u, BARK = 3u, POST = 4u, WIRE = 5u, STEM = 6u, GRASS = 11u, LAMP = 12u;
const uint METAL = 14u, GLASS = 17u, PAINT = 10u, PLASTIC = 7u;
`;

const VARYINGS = /* glsl */ `
in vec3 vPlace;
in vec3 vNormal;
in vec3 vLocal;
flat in uvec4 vSurface;
flat in vec4 vDetail;
out vec4 pixel;
`;

const CUT = /* glsl */ `
  if (LEAF) {
    vec2 uv = vec2((vLocal.x + 1.0) * 0.5, (vLocal.y + 0.75) * 0.5);
    if (texture(outlines, vec3(uv, vLocal.z)).x <= 0.5) discard;
  }
`;

/** Fragment shader of a kind. */
export function fragment(kind) {
  return LIGHT + MATERIALS + VARYINGS + `const bool LEAF = ${kind === "leaf"}, SPHEROID = ${kind === "spheroid"};` +
  /* glsl */ `
void main() {
` + CUT + /* glsl */ `
  uint packed = vSurface.x, material = vSurface.y;
  vec3 albedo = pow(vec3(packed & 255u, (packed >> 8) & 255u, (packed >> 16) & 255u) / 255.0, vec3(2.2));
  float sky = float(packed >> 24) / 255.0, gloss = 0.03, sharp = 12.0;
  vec3 n = normalize(vNormal), through = vec3(0.0);
  if (LEAF) {
    if (dot(n, eye - vPlace) < 0.0) n = -n;
    float rib = abs(vLocal.x) * 30.0, veins = material == FOLIAGE ? exp(-rib * rib) : 0.0;
    float tone = 0.8 + 0.4 * noise(vec3(vLocal.xy * 9.0, vLocal.z));
    vec3 old = vec3(0.30, 0.24, 0.05);
    albedo = mix(mix(albedo, old, smoothstep(0.55, 1.0, vDetail.w)) * tone, vec3(0.16, 0.22, 0.06), 0.5 * veins);
    through = albedo * vec3(1.5, 1.25, 0.45) * 0.55;
    gloss = material == FOLIAGE ? 0.035 : 0.02;
    sharp = 18.0;
  } else if (SPHEROID) {
    float shade0 = clamp(1.0 - (vDetail.w + dot(vDetail.xyz, n)), 0.12, 1.0);
    float bloom = smoothstep(0.25, 0.75, noise(vPlace * 260.0)) * 0.16;
    albedo = mix(albedo, vec3(0.42, 0.46, 0.58), bloom);
    sky *= shade0;
    through = albedo * 0.25;
    gloss = 0.045;
    sharp = 60.0;
  } else if (material == CANE || material == BARK || material == POST) {
    float grain = noise(vec3(vLocal.x * (material == CANE ? 60.0 : 25.0), vLocal.z * 5.0, vLocal.y * 13.0));
    albedo *= 0.65 + 0.7 * grain;
  } else if (material == METAL || material == WIRE) {
    gloss = 0.35; sharp = 40.0;
  } else if (material == PAINT || material == PLASTIC || material == GLASS) {
    gloss = 0.04; sharp = 50.0;
  }
  vec3 colour = material == LAMP ? albedo * 4.0 : shade(albedo, through, n, vPlace, sky, gloss, sharp);
  pixel = vec4(display(colour, vPlace), 1.0);
}
`;
}

/** Fragment shader for what the sun sees: only depth. */
export function depthOnly(kind) {
  return `precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray outlines;
in vec3 vLocal;
out vec4 pixel;
const bool LEAF = ${kind === "leaf"};
void main() {
${CUT}
  pixel = vec4(1.0);
}`;
}

export const GROUND_VERTEX = /* glsl */ `
precision highp float;
uniform mat4 projectionMatrix;
uniform mat4 modelViewMatrix;
in vec3 position;
out vec3 vPlace;
void main() {
  vPlace = position;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;

export const GROUND_FRAGMENT = LIGHT + /* glsl */ `
uniform sampler2D groundSky;
uniform vec3 ground;   // lowest x and y, side of a cell
uniform vec2 rows;     // y of the first row of vines, distance of rows
in vec3 vPlace;
out vec4 pixel;
void main() {
  vec2 cell = (vPlace.xy - ground.xy) / ground.z, size = vec2(textureSize(groundSky, 0));
  vec2 at = (clamp(cell, vec2(0.0), size - 1.0) + 0.5) / size;
  float inside = step(0.0, min(min(cell.x, cell.y), min(size.x - cell.x, size.y - cell.y)));
  float sky = mix(1.0, texture(groundSky, at).x, inside);
  float broad = noise(vec3(vPlace.xy * 0.55, 1.0)), fine = noise(vec3(vPlace.xy * 9.0, 4.0));
  float grit = noise(vec3(vPlace.xy * 70.0, 7.0));
  float lane = (vPlace.y - rows.x) / rows.y, away = abs(lane - round(lane)) * rows.y;
  float green = smoothstep(0.40, 0.62, 0.55 * broad + 0.25 * fine + 0.26 - 0.26 * smoothstep(0.65, 0.25, away));
  vec3 soil = vec3(0.17, 0.115, 0.07) * (0.7 + 0.35 * fine + 0.35 * grit);
  vec3 grass = vec3(0.085, 0.125, 0.03) * (0.6 + 0.5 * fine + 0.4 * grit);
  vec3 colour = shade(mix(soil, grass, green), vec3(0.0), vec3(0.0, 0.0, 1.0), vPlace, sky, 0.0, 8.0);
  pixel = vec4(display(colour, vPlace), 1.0);
}`;

export const SKY_VERTEX = /* glsl */ `
precision highp float;
uniform mat4 projectionMatrix;
uniform mat4 modelViewMatrix;
in vec3 position;
out vec3 vPlace;
void main() {
  vPlace = position;
  gl_Position = projectionMatrix * vec4(mat3(modelViewMatrix) * position, 1.0);
  gl_Position.z = gl_Position.w;
}`;

export const SKY_FRAGMENT = LIGHT + /* glsl */ `
in vec3 vPlace;
out vec4 pixel;
void main() {
  vec3 d = normalize(vPlace);
  float up = max(d.z, 0.0), glow = max(dot(d, sun), 0.0);
  vec3 colour = mix(vec3(0.74, 0.80, 0.86), vec3(0.20, 0.40, 0.80), pow(up, 0.55)) * 1.15;
  float cloud = smoothstep(0.52, 0.78, noise(vec3(d.xy / (up + 0.12) * 1.6, 2.0)) * 0.65 + 0.35 * noise(vec3(d.xy / (up + 0.12) * 5.0, 5.0)));
  colour = mix(colour, vec3(1.05), cloud * 0.55 * smoothstep(0.02, 0.25, up));
  colour += vec3(1.0, 0.85, 0.6) * (pow(glow, 64.0) * 0.5 + pow(glow, 1500.0) * 12.0);
  pixel = vec4(display(colour, eye), 1.0);
}`;

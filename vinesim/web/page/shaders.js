// GLSL of the primitives of cameras and lidars (vinesim/kernels/raster/primitives.py). Every vertex reads its primitive
// and the pose of its carrier from textures, so that moving a body changes only eight numbers.

import { BERRIES, GROUND, LEAVES, LEAVES_AT_VERTICES, LIGHT, MATERIALS, SKY, SOLIDS } from "./light.js";

/** Width of the texture with the rows of the primitives that are drawn. */
export const LIST_WIDTH = 1024;

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
uniform float leafExtent[64]; // of each outline: largest |u|, lowest and highest v, unused
uniform usampler2D listed;    // rows of the primitives that are drawn; largest number: none
uniform int copies;           // of the mesh in an instance
uniform vec3 eye;
uniform vec3 sun;
in vec3 position;
in uint copy;
uint row;                     // of the primitive
out vec3 vPlace;
out vec3 vNormal;
out vec3 vLocal;              // of leaves: u, v, outline; of berries: seed, depth, along; of others: place in the grain
out float vSky;               // share of the sky that is visible
flat out uvec4 vSurface;      // as in surfaces, and the bits of a seed
flat out vec4 vDetail;
flat out vec3 vTint;          // linear RGB

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

const PLACED = /* glsl */ `
  vec4 q = texel(poses, vSurface.z * 2u + 1u, 9);
  vPlace = texel(poses, vSurface.z * 2u, 9).xyz + turn(q, p);
  vNormal = turn(q, n);
  vDetail.xyz = turn(q, vDetail.xyz);
  gl_Position = projectionMatrix * modelViewMatrix * vec4(vPlace, 1.0);
`;
const FINISH = `${PLACED}}`;

const START = /* glsl */ `
void main() {
  int k = gl_InstanceID * copies + int(copy);
  row = texelFetch(listed, ivec2(k % ${LIST_WIDTH}, k / ${LIST_WIDTH}), 0).x;
  if (row == 0xffffffffu) { // out of the picture
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  vSurface = texelFetch(surfaces, ivec2(int(row) & 511, int(row) >> 9), 0);
  vec4 a = shape(0), b = shape(1);
  vec3 p, n;
  vDetail = vec4(0.0);
  vLocal = vec3(0.0);
  vSky = float(vSurface.x >> 24) / 255.0;
  vTint = pow(vec3(vSurface.x & 255u, (vSurface.x >> 8) & 255u, (vSurface.x >> 16) & 255u) / 255.0, vec3(2.2));
  vSurface.w = floatBitsToUint(shape(2).y);
`;

/** Vertex shader of a triangle that faces the eye, or the sun, and stands for a spheroid. */
function ballVertex(isForSun) {
  return (
    COMMON +
    /* glsl */ `
flat out vec4 vBall;
flat out vec4 vAxis;
` +
    START +
    /* glsl */ `
  vec4 pose = texel(poses, vSurface.z * 2u + 1u, 9);
  vec3 origin = texel(poses, vSurface.z * 2u, 9).xyz, centre = origin + turn(pose, a.xyz);
  float widest = a.w * max(b.w, 1.0);
  vec3 way = ${isForSun ? "sun" : "eye - centre"};
  float away = max(length(way), 1.05 * widest);
  vec3 side = across(way / away), up = cross(way / away, side);
  float outline = widest * ${isForSun ? "1.0" : "away / sqrt(away * away - widest * widest)"};
  vBall = vec4(centre, a.w);
  vAxis = vec4(turn(pose, b.xyz), b.w);
  vDetail = shape(3);
  vDetail.xyz = turn(pose, vDetail.xyz);
  vLocal = vec3(shape(2).xy, 0.0);
  vNormal = way;
  vPlace = centre + outline * (side * position.x + up * position.y);
  gl_Position = projectionMatrix * modelViewMatrix * vec4(vPlace, 1.0);
}
`
  );
}

/** Vertex shaders by the name of the kind. */
export const VERTEX = {
  // position: x y on the unit circle, z: -1 first pole, 0 and 1 rings, 2 last pole
  cone:
    COMMON +
    START +
    /* glsl */ `
  vec3 axis = b.xyz - a.xyz;
  float len = max(length(axis), 1e-9);
  axis /= len;
  vec3 side = across(axis), up = cross(axis, side);
  float s = clamp(position.z, 0.0, 1.0), r = mix(a.w, b.w, s);
  bool pole = position.z < -0.5 || position.z > 1.5;
  n = pole ? axis * (s * 2.0 - 1.0) : side * position.x + up * position.y;
  p = mix(a.xyz, b.xyz, s) + n * r;
  vLocal = vec3(position.xy * r, shape(2).x + s * len);
  if (shape(2).w > 0.0) vSky = mix(vSky, shape(2).z, s); // light is continuous from one piece of wood to the next
` +
    FINISH,
  // position: x y on the unit circle, z: 0 and 1 sides, -1 and 2 ends (flat), or their centres
  cylinder:
    COMMON +
    START +
    /* glsl */ `
  vec3 axis = normalize(b.xyz - a.xyz);
  vec3 side = across(axis), up = cross(axis, side);
  float s = clamp(position.z, 0.0, 1.0);
  bool end = position.z < -0.5 || position.z > 1.5;
  vec3 radial = side * position.x + up * position.y;
  n = end ? axis * (s * 2.0 - 1.0) : normalize(radial);
  p = mix(a.xyz, b.xyz, s) + radial * a.w;
  vLocal = vec3(position.xy * a.w, s * length(b.xyz - a.xyz));
` +
    FINISH,
  spheroid:
    COMMON +
    START +
    /* glsl */ `
  float along = dot(position, b.xyz);
  p = a.xyz + a.w * (position + b.xyz * along * (b.w - 1.0));
  n = normalize(position - b.xyz * along * (1.0 - 1.0 / b.w));
  vDetail = shape(3);
  vLocal = vec3(shape(2).xy, along);
` +
    FINISH,
  // a triangle around the outline of a spheroid; position: x y in units of the outline's radius
  ball: ballVertex(false),
  ellipsoid:
    COMMON +
    START +
    /* glsl */ `
  vec3 half3 = vec3(a.w, shape(2).xy);
  vLocal = position * half3;
  p = a.xyz + turn(b, vLocal);
  n = turn(b, normalize(position / half3));
` +
    FINISH,
  // position: a corner of the cube, normal from the axis whose coordinate is doubled
  box:
    COMMON +
    START +
    /* glsl */ `
  vec3 half3 = vec3(a.w, shape(2).xy);
  vec3 face = step(1.5, abs(position)) * sign(position);
  vLocal = clamp(position, -1.0, 1.0) * half3;
  p = a.xyz + turn(b, vLocal);
  n = turn(b, face);
` +
    FINISH,
  // position: x is the number of the corner
  triangle:
    COMMON +
    START +
    /* glsl */ `
  vec4 corner = shape(int(position.x));
  p = vLocal = corner.xyz;
  vSurface.w = 0u;
  n = unpackNormal(corner.w);
` +
    FINISH,
  // position: x from -1 to 1 across, y from 0 to 1 along
  leaf:
    COMMON +
    LEAVES_AT_VERTICES +
    START +
    /* glsl */ `
  vec4 c = shape(2), d = shape(3);
  int outline = int(b.w) * 4;
  float u = position.x * leafExtent[outline], v = mix(leafExtent[outline + 1], leafExtent[outline + 2], position.y);
  float w = d.x * u * u + d.y * v * v + d.z * abs(u);
  vec3 side = cross(b.xyz, c.xyz);
  p = a.xyz + a.w * (side * u + b.xyz * v + c.xyz * w);
  n = normalize(c.xyz - side * (2.0 * d.x * u + d.z * sign(u)) - b.xyz * 2.0 * d.y * v);
  vLocal = vec3(u, v, b.w);
  vSurface.w = floatBitsToUint(c.w);
  vDetail = vec4(b.xyz, d.w); // midrib and age
` +
    PLACED +
    /* glsl */ `
#ifdef PLAIN
  lightLeaf(vNormal, c.w);
#endif
}
`,
};

const VARYINGS = /* glsl */ `
in vec3 vPlace;
in vec3 vNormal;
in vec3 vLocal;
in float vSky;
flat in uvec4 vSurface;
flat in vec4 vDetail;
flat in vec3 vTint;
out vec4 pixel;
`;

/** Finds the point of a spheroid behind a pixel of the triangle that stands for the spheroid. */
const BALL = /* glsl */ `
flat in vec4 vBall; // centre [m], radius [m]
flat in vec4 vAxis; // axis, ratio of the lengths along and across it

/** Point on the sphere of radius 1 to which the spheroid is scaled; w: along the ray, from the triangle [m]; 0: missed. */
bool onBall(vec3 d, out vec3 point, out float along) {
  vec3 squeeze = vAxis.xyz * (1.0 / vAxis.w - 1.0), from = vPlace - vBall.xyz;
  vec3 ray = d + squeeze * dot(d, vAxis.xyz), start = from + squeeze * dot(from, vAxis.xyz);
  float a = dot(ray, ray), b = dot(start, ray), inside = b * b - a * (dot(start, start) - vBall.w * vBall.w);
  along = -(b + sqrt(max(inside, 0.0))) / a;
  point = (start + along * ray) / vBall.w;
  return inside >= 0.0;
}
`;

const CUT = /* glsl */ `
  if (LEAF) {
    vec2 uv = vec2((vLocal.x + 1.0) * 0.5, (vLocal.y + 0.75) * 0.5);
    if (texture(outlines, vec3(uv, vLocal.z)).x <= 0.5) discard;
  }
`;

/** Vertex shader of a kind for the sun's depth map. */
export const vertexForSun = (kind) => (kind === "ball" ? ballVertex(true) : VERTEX[kind]);

/** Fragment shader of a kind. */
export function fragment(kind) {
  const isLeaf = kind === "leaf",
    isBall = kind === "ball";
  return (
    LIGHT +
    MATERIALS +
    (isLeaf ? LEAVES : BERRIES + SOLIDS) +
    VARYINGS +
    (isBall ? BALL : "") +
    `const bool LEAF = ${isLeaf};
void main() {
${CUT}
` +
    /* glsl */ `
  uint material = vSurface.y;
  vec3 tint = vTint, place = vPlace, local = vLocal;
  vec3 n = normalize(vNormal), d = normalize(vPlace - eye);
` +
    (isBall
      ? /* glsl */ `
  vec3 point;
  float ahead;
  if (!onBall(d, point, ahead)) discard;
  place += ahead * d;
  local.z = dot(point, vAxis.xyz);
  n = normalize(point + vAxis.xyz * local.z * (1.0 / vAxis.w - 1.0));
`
      : "") +
    /* glsl */ `
  float away = dot(n, d) + 0.15;
  if (!LEAF && away > 0.0) n = normalize(n - d * away); // at rims of coarse meshes normals point away from the eye
  float seed = uintBitsToFloat(vSurface.w);
` +
    (isLeaf
      ? /* glsl */ `
#ifdef PLAIN
  vec3 light = bladeLight(local, material);
#else
  Surface s = blade(n, tint, vSky, local, seed, vDetail, material, d);
  vec3 light = leaving(s, n, place, true, false);
#endif
`
      : kind === "spheroid" || isBall
        ? /* glsl */ `
  bool isBerry = material == BERRY;
  Surface s;
  if (isBerry) s = berry(n, tint, vSky, local, vDetail);
  else s = solid(n, tint, vSky, material, local, seed, place.z);
  vec3 light = leaving(s, n, place, false, isBerry);
`
        : /* glsl */ `
  Surface s = solid(n, tint, vSky, material, local, seed, place.z);
  vec3 light = leaving(s, n, place, false, false);
`) +
    /* glsl */ `
  pixel = vec4(display(light), 1.0);
}
`
  );
}

/** Fragment shader for the sun's depth map. */
export function depthOnly(kind) {
  return `precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray outlines;
uniform vec3 sun;
in vec3 vPlace;
in vec3 vLocal;
out vec4 pixel;
const bool LEAF = ${kind === "leaf"};
${kind === "ball" ? BALL : ""}
void main() {
${CUT}
${kind === "ball" ? `vec3 point; float ahead; if (!onBall(-sun, point, ahead)) discard;` : ""}
  pixel = vec4(1.0);
}`;
}

export const GROUND_VERTEX = /* glsl */ `
precision highp float;
uniform mat4 projectionMatrix;
uniform mat4 modelViewMatrix;
in vec3 position;
in vec2 rise;
out vec3 vPlace;
out vec2 vRise;
void main() {
  vPlace = position;
  vRise = rise;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;

export const GROUND_FRAGMENT =
  LIGHT +
  GROUND +
  /* glsl */ `
in vec3 vPlace;
in vec2 vRise;
out vec4 pixel;
void main() {
  Surface s = soil(vPlace.xy, vRise);
  pixel = vec4(display(leaving(s, s.normal, vPlace, false, false)), 1.0);
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

export const SKY_FRAGMENT =
  LIGHT +
  SKY +
  /* glsl */ `
in vec3 vPlace;
out vec4 pixel;
void main() {
  pixel = vec4(display(skyLight(normalize(vPlace))), 1.0);
}`;

// GLSL of the cameras' light (vinesim/kernels/shading) with the same tables: reflection and transmission of the light of
// sun, sky, canopy and ground, and tone mapping. Linear RGB. With PLAIN defined, for browsers without a graphics card, a
// pixel reads few texels: such browsers execute both sides of every condition.

/** Light for shaders that already have the uniforms eye and sun. */
export const LIGHT_AT_VERTICES = /* glsl */ `
precision highp sampler2DArray;
uniform vec3 sunColour;
uniform vec3 skyColour;
uniform vec3 hazeColour;
uniform vec3 groundColour;
uniform vec3 canopyColour;
uniform float paletteHazeRate; // [1/m]
uniform vec3 gain;            // exposure and white balance
uniform sampler2D noises;     // four octaves around 0.5, period 1
uniform sampler2DArray outlines;
uniform sampler2D sunDepth;
uniform mat4 sunMatrix;
uniform float sunTexel;       // [m]
uniform float sunDeep;        // from the nearest to the farthest depth [m]

struct Surface {
  vec3 normal;
  vec3 albedo;
  vec3 transmission;
  vec3 wrap;                  // how far light creeps round the terminator, by colour
  float sky, occlusion, specular, shininess, reflectivity, emission;
};

Surface diffuse(vec3 normal, vec3 albedo, float sky) {
  return Surface(normal, albedo, vec3(0.0), vec3(0.0), sky, 1.0, 0.03, 12.0, 0.0, 0.0);
}

vec4 noiseAt(vec2 at) { return texture(noises, at + 0.5 / 256.0); }

// Share of the sun's light that reaches a point, from four samples of the sun's depth map. Surfaces at grazing angles
// must not shade themselves through the resolution of texels.
float sunShare(vec3 place, vec3 normal, float sky) {
  float facing = min(dot(normal, sun), 1.0), steep = sqrt(1.0 - facing * facing) / max(facing, 0.12);
  vec4 clip = sunMatrix * vec4(place + normal * sunTexel * (0.5 + 0.8 * (1.0 - facing)), 1.0);
  vec3 at = clip.xyz * 0.5 + 0.5;
  at.z -= sunTexel * (0.3 + 0.4 * steep) / sunDeep;
  vec2 edge = abs(at.xy - 0.5);
  if (max(edge.x, edge.y) > 0.49 || at.z > 1.0) return sky > 0.7 ? 1.0 : sky;
  vec2 size = vec2(textureSize(sunDepth, 0)), f = fract(at.xy * size - 0.5);
  ivec2 corner = ivec2(floor(at.xy * size - 0.5));
#ifdef PLAIN
  return step(at.z, texelFetch(sunDepth, corner + ivec2(step(0.5, f)), 0).x);
#else
  vec4 lit;
  for (int k = 0; k < 4; ++k)
    lit[k] = step(at.z, texelFetch(sunDepth, corner + ivec2(k & 1, k >> 1), 0).x);
  return mix(mix(lit.x, lit.y, f.x), mix(lit.z, lit.w, f.x), f.y);
#endif
}

// Cool sky through the gaps, green light through leaves, warm bounce from the ground.
vec3 ambient(vec3 n, float sky) {
  float up = 0.5 + 0.5 * n.z;
  vec3 above = skyColour * sky * sky + canopyColour * (1.0 - sky);
  return above * (0.25 + 0.75 * up) + groundColour * (1.0 - up) * (0.35 + 0.65 * sky);
}

// Reflection in a glossy surface along r: gaps of sky in a dark canopy above, ground below.
vec3 mirrored(vec3 r, float sky) {
#ifdef PLAIN
  float hole = smoothstep(0.50 - 0.30 * sky, 0.78 - 0.30 * sky, 0.5 + 0.12 * (r.x - r.y));
#else
  float hole = smoothstep(0.50 - 0.30 * sky, 0.78 - 0.30 * sky, noiseAt(vec2(r.x * 0.16 + r.z * 0.09, r.y * 0.16 - r.z * 0.07)).y);
#endif
  vec3 above = mix(canopyColour * 0.4, skyColour * 1.3, hole);
  return mix(groundColour * 0.8, above, smoothstep(-0.25, 0.25, r.z));
}

// Highlight of the sun and reflection of the surroundings against the unit ray d.
vec3 glossed(Surface s, bool isLeaf, vec3 d, vec3 n, float facing, float lit) {
  float grazing = 1.0 - max(-dot(n, d), 0.0), squared = grazing * grazing;
  float fresnel = s.specular + (1.0 - s.specular) * squared * squared * grazing * min(s.specular * 14.0, 1.0) * 0.8;
  float peak = 1.0 - max(dot(n, normalize(sun - d)), 0.0);
  vec3 colour = sunColour * fresnel * exp(-s.shininess * peak) * (s.shininess * 0.14 + 0.4) * lit * max(facing + 0.05, 0.0);
  vec3 r = reflect(d, n);
  if (isLeaf) {
    vec3 above = mix(canopyColour * 0.45, skyColour, s.sky * s.sky);
    return colour + mix(groundColour, above, 0.5 + 0.5 * r.z) * min(fresnel, 0.16) * s.reflectivity * s.occlusion;
  }
  return colour + mirrored(r, s.sky) * fresnel * s.reflectivity * s.occlusion;
}

// Light from a surface towards the eye; plain is the normal of the shape without relief.
vec3 leaving(Surface s, vec3 plain, vec3 place, bool isLeaf, bool isBerry) {
  vec3 d = normalize(place - eye), n = s.normal;
  if (isLeaf && dot(plain, d) > 0.0) { n = -n; plain = -plain; }
  float facing = dot(n, sun), lit = sunShare(place, dot(plain, sun) < 0.0 ? -plain : plain, s.sky);
  vec3 direct = max((facing + s.wrap) / (1.0 + s.wrap), 0.0) * sunColour * lit * (0.35 + 0.65 * s.occlusion);
  vec3 colour = s.albedo * (direct + ambient(n, s.sky) * s.occlusion);
  if (isBerry) { // a long way through the berry: saturated, brightest at the rim
    float rim = clamp(0.55 - 0.75 * facing, 0.0, 1.0);
    float sunny = rim * rim * 0.30 * (0.15 + 0.85 * lit) * s.occlusion * (0.25 + 0.75 * s.sky);
    colour += s.transmission * (sunColour * sunny + ambient(-n, s.sky) * 0.35 * s.occlusion);
  } else if (s.transmission.x > 0.0)
    colour += s.transmission * (sunColour * max(-facing, 0.0) * lit * 0.55 + ambient(-n, s.sky) * 0.30 * s.occlusion);
  if (s.specular > 0.0) colour += glossed(s, isLeaf, d, n, facing, lit);
  colour += s.albedo * s.emission;
  return mix(colour, hazeColour, 0.6 * (1.0 - exp(-length(place - eye) * paletteHazeRate)));
}

// Tone mapping: the filmic curve of Narkowicz (2015), then sRGB. PLAIN: sRGB by square roots, within 1/255.
vec3 display(vec3 light) {
  vec3 x = min(light * gain, 3.0);
  vec3 film = clamp(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0);
#ifdef PLAIN
  vec3 root = sqrt(film), fourth = sqrt(root);
  return max(0.662002687 * root + 0.684122060 * fourth - 0.323583601 * sqrt(fourth) - 0.0225411470 * film, 0.0);
#else
  return mix(12.92 * film, 1.055 * pow(film, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, film));
#endif
}
`;

export const LIGHT = /* glsl */ `
precision highp float;
precision highp int;
uniform vec3 eye;
uniform vec3 sun;
${LIGHT_AT_VERTICES}`;

export const MATERIALS = /* glsl */ `
const uint FOLIAGE = 0u, BERRY = 1u, CANE = 2u, BARK = 3u, POST = 4u, WIRE = 5u, STEM = 6u, PLASTIC = 7u, CLOTH = 8u;
const uint SKIN = 9u, PAINT = 10u, GRASS = 11u, LAMP = 12u, RUBBER = 13u, METAL = 14u, STRAW = 15u, REFLEX = 16u, GLASS = 17u, OLD_BARK = 18u;
`;

/** Berries: local is seed, depth in the bunch, and position along the axis; neighbours is the light that others block. */
export const BERRIES = /* glsl */ `
Surface berry(vec3 n, vec3 tint, float sky, vec3 local, vec4 neighbours) {
  Surface s = diffuse(n, tint, sky);
  float pale = clamp(tint.y * 2.2, 0.0, 1.0);
  s.occlusion = clamp(1.0 - neighbours.w - dot(neighbours.xyz, n), 0.12 + 0.2 * pale, 1.0) * (0.4 + 0.6 * local.y);
  float red = clamp((tint.x - tint.y) * 4.0, 0.0, 1.0) * (1.0 - pale);
  s.wrap = vec3(0.12, 0.06, 0.08) + vec3(0.33, 0.34, 0.12) * pale + vec3(0.2, 0.05, 0.02) * red;
  s.transmission = tint * 1.8 * pale + vec3(0.26, 0.03, 0.012) * red + vec3(0.03, 0.003, 0.004);
  float bloom = 0.36 - 0.22 * pale - 0.06 * red, seed = local.x;
  vec4 wide = noiseAt(vec2(n.x * 0.20 + seed * 7.1, n.y * 0.20 + n.z * 0.31 + seed * 3.3));
#ifdef PLAIN
  vec4 fine = wide.zwxy;
#else
  vec4 fine = noiseAt(vec2(n.x * 1.1 + n.z * 0.6 + seed, n.y * 1.1 - n.z * 0.4));
#endif
  s.albedo *= 0.86 + 0.28 * wide.y;
  float amber = pale * 0.35 * clamp(8.0 * (tint.x / tint.y - 0.8), 0.0, 1.0);
  s.albedo = mix(s.albedo, vec3(0.46, 0.30, 0.06), amber * smoothstep(0.5, 0.8, wide.x + 0.15 * n.z));
  s.albedo *= 1.0 + pale * (0.14 * fine.z - 0.07) + red * 0.22 * step(0.82, fine.w);
  float dusty = bloom * smoothstep(0.30, 0.62, wide.x * 0.55 + wide.y * 0.45 + 0.12 * n.z) * (0.75 + 0.5 * fine.y);
  s.albedo = mix(s.albedo, vec3(0.07, 0.045, 0.025), smoothstep(0.986, 0.994, local.z));
  s.albedo = mix(s.albedo, vec3(0.16, 0.18, 0.06), 0.7 * (1.0 - smoothstep(-0.985, -0.95, local.z)));
  s.albedo = mix(s.albedo, vec3(0.40, 0.43, 0.60) + vec3(0.0, 0.04, -0.36) * pale, clamp(dusty, 0.0, 0.8));
  s.specular = 0.045;
  s.shininess = 70.0 - 72.0 * min(dusty, 0.75);
  s.reflectivity = 0.6 * (1.0 - min(dusty * 1.6, 0.85));
  return s;
}
`;

const FOLIAGE = /* glsl */ `
uniform vec3 paletteThrough;   // light through a leaf, relative to its albedo
uniform vec3 paletteUnder;     // felt of the lower side
uniform vec3 paletteUnderVein;
uniform vec3 paletteVein;
uniform vec3 paletteMargin;    // yellow edge
uniform vec3 paletteScorch;    // dead edge

// The upper side or the lower one: paler, felted, its veins stand out. Returns the colour of veins and its share.
vec4 sided(inout Surface s, bool isBelow) {
  s.albedo = isBelow ? mix(s.albedo * 1.05, paletteUnder, 0.42) : s.albedo;
  s.specular = isBelow ? 0.012 : 0.05;
  s.shininess = isBelow ? 6.0 : 22.0;
  s.reflectivity = isBelow ? 0.0 : 0.55;
  return isBelow ? vec4(paletteUnderVein, 0.7) : vec4(paletteVein, 0.40);
}

vec3 autumn(vec3 albedo, vec2 uv, float edge, float seed, float old) {
  float age = max(old - 0.42, 0.0) * 1.7; // a leaf turns late
  vec4 spot = noiseAt(uv * 0.13 + seed * vec2(5.3, 2.7));
  float yellow = age * (1.0 - smoothstep(0.0, 0.16 + 0.1 * age, edge - 0.10 * spot.y)) + 0.7 * smoothstep(0.62, 0.9, age) * spot.x;
  float brown = (1.0 - smoothstep(0.0, 0.03, edge - 0.05 * spot.z * age)) * smoothstep(0.35, 0.6, age);
  return mix(mix(albedo, paletteMargin, step(0.02, age) * clamp(yellow, 0.0, 1.0)), paletteScorch, brown);
}

void grass(inout Surface s, vec3 plain, float height) {
  s.albedo *= 0.35 + 0.75 * (0.5 + 0.5 * height);
  s.transmission = s.albedo * 0.7;
  s.specular = 0.012;
  s.normal = normalize(plain * 0.5 + vec3(0.0, 0.0, 0.8));
  s.occlusion = 0.35 + 0.65 * smoothstep(-0.75, 0.0, height);
}
`;

/** Leaves, grass and fallen leaves: local is u, v and the number of the outline; detail is the midrib and the age. */
export const LEAVES = /* glsl */ `
uniform sampler2DArray leaves; // veins, slopes of the relief across and along (0.5: none), tone
#ifdef PLAIN
in vec3 vColour;
in vec3 vVein;
in vec3 vGloss;
in float vClear;

// Light from the corners of a leaf, with the texture's tone and veins.
vec3 bladeLight(vec3 local, uint material) {
  vec2 across = dFdx(local.xy), down = dFdy(local.xy), uv = vec2((local.x + 1.0) * 0.5, (local.y + 0.75) * 0.5);
  float texel = sqrt(max(dot(across, across), dot(down, down)));
  float isNear = step(texel, 0.1) * float(material != GRASS);
  vec4 table = texture(leaves, vec3(uv, local.z));
  return vColour * mix(1.0, 0.72 + 0.5 * table.w, isNear) + vVein * (table.x * isNear * vClear / (1.0 + 6.0 * texel)) + vGloss;
}
#else
${FOLIAGE}
Surface blade(vec3 plain, vec3 tint, float sky, vec3 local, float seed, vec4 detail, uint material, vec3 d) {
  Surface s = diffuse(plain, tint, sky);
  if (material == GRASS) {
    grass(s, plain, local.y);
    return s;
  }
  vec2 across = dFdx(local.xy), down = dFdy(local.xy), uv = vec2((local.x + 1.0) * 0.5, (local.y + 0.75) * 0.5);
  float texel = sqrt(max(dot(across, across), dot(down, down)));
  vec4 table = texture(leaves, vec3(uv, local.z));
  float isNear = step(texel, 0.1);
  float clear = isNear * clamp(abs(dot(plain, d)) * 2.2, 0.0, 1.0) / (1.0 + 6.0 * texel), vein = table.x * clear;
  vec3 rib = normalize(detail.xyz), side = cross(rib, plain);
  s.normal = normalize(plain - (side * (table.y - 0.5) + rib * (table.z - 0.5)) * 1.2 * clear);
  s.albedo *= mix(1.0, 0.72 + 0.5 * table.w, isNear);
  float edge = (255.0 * texture(outlines, vec3(uv, local.z)).x - 128.0) * 0.0025;
  s.albedo = autumn(s.albedo, local.xy, edge, seed, detail.w);
  s.transmission = s.albedo * paletteThrough * (1.0 - 0.7 * vein);
  vec4 veins = sided(s, dot(plain, d) > 0.0);
  s.albedo = mix(s.albedo, veins.xyz, veins.w * vein);
  return s;
}
#endif
`;

/** Light at the corners of leaves, for browsers without a graphics card. The light that leaves a pixel is linear in the
 * tone and the veins of the texture: vColour is for tone 1, vVein for veins 1; vGloss has no texture. */
export const LEAVES_AT_VERTICES = /* glsl */ `
#ifdef PLAIN
${LIGHT_AT_VERTICES}
const uint GRASS = 11u;
out vec3 vColour;
out vec3 vVein;
out vec3 vGloss;
out float vClear;             // share of the veins that is visible
${FOLIAGE}
void lightLeaf(vec3 plain, float seed) {
  vec3 d = normalize(vPlace - eye);
  bool isBelow = dot(plain, d) > 0.0;
  Surface s = diffuse(plain, vTint, vSky);
  vec4 veins = vec4(0.0);
  vClear = clamp(abs(dot(plain, d)) * 2.2, 0.0, 1.0);
  if (vSurface.y == GRASS) grass(s, plain, vLocal.y);
  else {
    s.albedo = autumn(s.albedo, vLocal.xy, 0.06, seed, vDetail.w);
    s.transmission = s.albedo * paletteThrough;
    veins = sided(s, isBelow);
  }
  vec3 n = isBelow ? -s.normal : s.normal;
  float facing = dot(n, sun), lit = sunShare(vPlace, dot(plain, sun) < 0.0 ? -plain : plain, s.sky);
  vec3 direct = max(facing, 0.0) * sunColour * lit * (0.35 + 0.65 * s.occlusion) + ambient(n, s.sky) * s.occlusion;
  vec3 through = s.transmission * (sunColour * max(-facing, 0.0) * lit * 0.55 + ambient(-n, s.sky) * 0.30 * s.occlusion);
  float haze = 0.6 * (1.0 - exp(-length(vPlace - eye) * paletteHazeRate));
  vColour = (s.albedo * direct + through) * (1.0 - haze);
  vVein = ((veins.xyz - s.albedo) * veins.w * direct - 0.7 * through) * (1.0 - haze);
  vGloss = mix(glossed(s, true, d, n, facing, lit), hazeColour, haze);
}
#endif
`;

/** Wood and manufactured objects: grain is the position across (x, y) and along (z) the grain [m]. */
export const SOLIDS = /* glsl */ `
uniform vec3 paletteBarkDark;
uniform vec3 paletteBarkLight;
uniform vec3 paletteBlotch;    // dark blotches on canes
#ifdef PLAIN
// Wood and manufactured objects with one noise for all materials.
void grained(inout Surface s, uint material, vec3 grain, float seed, float height) {
  bool isCane = material == CANE, isBark = material == BARK, isPost = material == POST || material == OLD_BARK;
  bool isWood = isCane || isBark || isPost, isShiny = material == WIRE || material == METAL;
  bool isGlossy = material == PLASTIC || material == PAINT || material == GLASS || material == REFLEX;
  vec3 scale = isCane ? vec3(9.0, 7.0, 1.6) : isBark ? vec3(4.0, 4.0, 0.4) : vec3(1.7, 1.3, 0.5);
  vec4 t = noiseAt(vec2(grain.x * scale.x + grain.y * scale.y + seed, grain.z * scale.z + seed * 3.1));
  float rough = isWood ? 0.5 : material == CLOTH ? 0.6 : 0.0;
  vec3 bark = mix(paletteBarkDark, paletteBarkLight, smoothstep(0.25, 0.80, t.z));
  float dirt = isPost ? 1.0 - 0.45 * (1.0 - smoothstep(0.0, 0.35, height)) * t.x : 1.0;
  float tone = isWood ? 0.55 + 0.9 * t.z : material == CLOTH ? 0.78 + 0.45 * t.x : material == METAL ? 0.55 : 0.85 + 0.3 * t.y * float(isGlossy);
  s.albedo = isBark ? bark : s.albedo * tone * dirt;
  s.albedo = mix(s.albedo, paletteBlotch, isCane ? 0.5 * smoothstep(0.45, 0.7, t.x) : 0.0);
  s.normal = normalize(s.normal + (t.yzw - 0.5) * rough);
  s.wrap = material == SKIN ? vec3(0.35, 0.15, 0.10) : vec3(material == CLOTH ? 0.15 : 0.0);
  s.specular = isShiny ? 0.4 : isGlossy ? 0.05 : isWood || material == CLOTH ? 0.015 : s.specular;
  s.shininess = isShiny ? 35.0 : isGlossy ? 70.0 : s.shininess;
  s.reflectivity = isShiny ? 0.6 : isGlossy ? 0.5 : 0.0;
  s.emission = material == LAMP ? 3.0 : 0.0;
  s.transmission = material == STEM ? s.albedo * 0.3 : material == STRAW ? s.albedo * 0.25 : vec3(0.0);
}
#else
void wood(inout Surface s, uint material, vec3 grain, float seed, float height) {
  if (material == CANE) {
    vec4 t = noiseAt(vec2(grain.x * 9.0 + grain.y * 7.0 + seed, grain.z * 1.6 + seed * 3.1));
    s.albedo = mix(s.albedo * (0.55 + 0.9 * t.z), paletteBlotch, 0.5 * smoothstep(0.45, 0.7, t.x));
    s.normal = normalize(s.normal + (t.yzw - 0.5) * 0.4);
    s.shininess = 14.0;
  } else if (material == BARK) {
    vec4 wide = noiseAt(vec2(grain.x * 2.6 + grain.z * 0.24 + seed, grain.y * 2.6 - grain.z * 0.10 + grain.x * 0.4));
    vec4 fine = noiseAt(vec2(grain.x * 6.0 + grain.z * 0.45, grain.y * 6.0 + grain.z * 0.32 + seed));
    float relief = wide.z * 0.6 + fine.y * 0.4;
    s.albedo = mix(paletteBarkDark, paletteBarkLight, smoothstep(0.25, 0.80, relief));
    s.occlusion = 0.6 + 0.4 * smoothstep(0.3, 0.55, relief);
    s.normal = normalize(s.normal + vec3(wide.z - 0.5, fine.y - 0.5, (wide.w - 0.5) * 0.3));
    s.specular = 0.01;
  } else {
    vec4 wide = noiseAt(vec2(grain.x * 1.7 + grain.y * 1.3 + seed, grain.z * 0.35));
    vec4 fine = noiseAt(vec2(grain.x * 6.0 + grain.y * 5.0, grain.z * 0.9 + seed));
    s.albedo *= (0.55 + 0.55 * wide.y + 0.35 * fine.z) * (1.0 - 0.45 * (1.0 - smoothstep(0.0, 0.35, height)) * wide.x);
    s.normal = normalize(s.normal + vec3(fine.yz - 0.5, 0.0) * 0.5);
    s.specular = 0.02;
  }
}

void made(inout Surface s, uint material, vec3 grain, float seed) {
  if (material == WIRE) { s.specular = 0.35; s.shininess = 30.0; s.reflectivity = 0.5; }
  else if (material == PLASTIC) {
    s.albedo *= 0.85 + 0.3 * noiseAt(grain.xy * 2.0 + grain.z).y;
    s.specular = 0.045; s.shininess = 45.0; s.reflectivity = 0.6;
  } else if (material == CLOTH) {
    vec4 wide = noiseAt(vec2(grain.x * 1.4 + seed, grain.z * 1.1 + grain.y * 0.9));
    s.albedo *= 0.78 + 0.45 * wide.x;
    s.normal = normalize(s.normal + (wide.xyz - 0.5) * vec3(1.0, 1.0, 0.7) * 0.9);
    s.specular = 0.008; s.wrap = vec3(0.15);
  } else if (material == SKIN) { s.wrap = vec3(0.35, 0.15, 0.10); s.shininess = 14.0; }
  else if (material == PAINT) { s.specular = 0.05; s.shininess = 80.0; s.reflectivity = 0.4; }
  else if (material == LAMP) s.emission = 3.0;
  else if (material == RUBBER) s.shininess = 8.0;
  else if (material == METAL) { s.albedo *= 0.55; s.specular = 0.45; s.shininess = 40.0; s.reflectivity = 0.7; }
  else if (material == STRAW) {
    s.transmission = s.albedo * 0.25;
    s.albedo *= 0.70 + 0.5 * noiseAt(grain.xy * 9.0 + vec2(5.0, -5.0) * grain.z).w;
    s.specular = 0.02;
  } else if (material == REFLEX) { s.specular = 0.12; s.shininess = 20.0; s.reflectivity = 0.5; }
  else if (material == GLASS) { s.specular = 0.05; s.shininess = 250.0; s.reflectivity = 1.0; }
  else if (material == STEM) s.transmission = s.albedo * 0.3;
}

#endif

Surface solid(vec3 n, vec3 tint, float sky, uint material, vec3 grain, float seed, float height) {
  Surface s = diffuse(n, tint, sky);
#ifdef PLAIN
  grained(s, material, grain, seed, height);
#else
  if (material == CANE || material == BARK || material == POST || material == OLD_BARK) wood(s, material, grain, seed, height);
  else made(s, material, grain, seed);
#endif
  if (material != WIRE) s.occlusion *= 0.55 + 0.45 * smoothstep(0.0, 0.35, height + max(n.z, 0.0) * 0.35);
  return s;
}
`;

/** Soil and sod: bare under the vines and in the tracks of wheels, green between the rows and outside. */
export const GROUND = /* glsl */ `
uniform sampler2D groundSky;
uniform vec3 ground;   // lowest x and y, side of a cell
uniform vec2 rows;     // y of the first row of vines, distance of rows
uniform vec3 paletteSoilDark;
uniform vec3 paletteSoilLight;
uniform vec3 paletteTurfDark;
uniform vec3 paletteTurfLight;
uniform vec3 paletteField;
uniform vec3 paletteDry;
uniform vec3 paletteStraw;
uniform float paletteCover;
uniform float paletteMostCover;
uniform float paletteFarCover;
uniform float paletteStrip;
uniform float paletteDryShare;
uniform float paletteDryGain;
uniform float paletteStrawShare;
uniform float paletteStrawGain;

Surface soil(vec2 p, vec2 rise) {
  vec2 size = vec2(textureSize(groundSky, 0)), cell = (p - ground.xy) / ground.z, last = size - 1.0;
  float beyond = min(min(cell.x, cell.y), min(last.x - cell.x, last.y - cell.y)) * ground.z;
  float inside = smoothstep(0.0, 3.0, beyond), outside = 1.0 - inside;
  float sky = beyond > 0.0 ? texture(groundSky, (cell + 0.5) / size).x : 0.75;
  // clods and sod by the noise of all materials; far away both appear in steps of 8-bit colours
  vec4 coarse = noiseAt(p * 0.21), near = noiseAt(p * 0.8);
#ifdef PLAIN
  vec4 fields = vec4(0.5);
#else
  vec4 fields = noiseAt(p * 0.011 + vec2(0.0, 0.37));
#endif
  float tone = 0.54 + 0.6 * (near.z - 0.5) + 0.4 * (near.w - 0.5), sod = 0.5 + 0.9 * (near.w - 0.5) + 0.5 * (near.z - 0.5);
  float lane = (p.y - rows.x) / rows.y, away = abs(lane - round(lane)) * rows.y, track = abs(away - 0.5 * rows.y + 0.7);
  float greenness = 0.16 - 0.26 * (1.0 - smoothstep(0.25, 0.65, away)) - 0.14 * (1.0 - smoothstep(0.08, 0.22, track));
  float cover = 0.55 * coarse.x + 0.2 * coarse.z + 0.25 * sod + greenness * inside * paletteStrip + paletteCover;
  float green = paletteMostCover * smoothstep(0.38, 0.60, cover);
  green = min(green + (0.22 + 0.45 * smoothstep(0.35, 0.65, fields.y)) * outside * paletteFarCover, outside > 0.0 ? 0.92 : 1.0);
  vec3 earth = mix(paletteSoilDark, paletteSoilLight, clamp(tone, 0.0, 1.0));
  vec3 turf = mix(paletteTurfDark, paletteTurfLight, clamp(sod, 0.0, 1.0));
  turf = mix(turf, paletteField, outside * smoothstep(0.35, 0.6, fields.z));
  float straw = paletteStrawShare + paletteStrawGain * (0.7 * sod + 0.3 * coarse.y - 0.5);
  float dry = paletteDryShare + paletteDryGain * (0.4 * sod + 0.6 * coarse.z - 0.5);
  earth = mix(earth, paletteStraw * (0.6 + 0.8 * tone), clamp(straw, 0.0, 1.0));
  turf = mix(turf, paletteDry * (0.6 + 0.8 * sod), clamp(dry, 0.0, 1.0));
  vec2 slope = vec2(near.w - near.y, near.z - near.y) - rise;
  Surface s = diffuse(normalize(vec3(slope, 1.0)), mix(earth, turf, green) * (0.8 + 0.4 * coarse.y), sky);
  s.occlusion = 0.6 + 0.8 * min(tone, 0.5);
  s.specular = 0.0;
  return s;
}
`;

/** Sky: clear blue with thin clouds, a halo around the sun, hills in the haze, and trees in front of them. */
export const SKY = /* glsl */ `
uniform float skyDim;
uniform vec3 paletteZenith;
uniform vec3 paletteHorizon;
uniform vec3 paletteCloud;
uniform vec3 paletteLight;
uniform vec3 paletteFarHills;
uniform vec3 paletteHills;
uniform vec3 paletteTrees;
uniform vec3 paletteTreesSpread;
uniform float paletteClouds;
uniform float paletteOvercast;

float layer(vec2 at, int octave) { return textureLod(noises, at + 0.5 / 256.0, 0.0)[octave]; }

vec3 skyLight(vec3 d) {
  float height = max(d.z, 0.0), turns = atan(d.y, d.x) / 6.2831853, far = 0.5 * 0.22 / (height + 0.12);
  vec3 colour = mix(paletteZenith, paletteHorizon, exp(-5.5 * height));
  colour = mix(colour, paletteLight * (0.45 + 0.9 * height), paletteOvercast);
  float away = 1.0 - clamp(dot(d, sun), 0.0, 1.0);
  colour += (0.07 * exp(-6.0 * away) + 0.35 * exp(-60.0 * away) + 6.0 * exp(-4000.0 * away)) * sunColour;
  vec2 at = normalize(d.xy + 1e-9) * sqrt(1.0 - height * height) * far;
  float cloud = smoothstep(0.56, 0.86, layer(at, 0) + 0.25 * (layer(at, 1) - 0.5)) * smoothstep(0.02, 0.2, height);
  colour = mix(colour, paletteCloud, cloud * paletteClouds * (1.0 - paletteOvercast));
  float ridge = 0.045 + 0.085 * (layer(vec2(2.0 * turns, 0.26), 0) - 0.35);
  float nearer = 0.020 + 0.050 * (layer(vec2(3.0 * turns, 0.39), 0) - 0.35);
  float crowns = 0.014 + 0.020 * layer(vec2(16.0 * turns, 0.71), 1);
  vec3 trees = paletteTrees + (layer(vec2(20.0 * turns, 8.0 * height), 2) - 0.5) * paletteTreesSpread;
  colour = mix(colour, paletteFarHills, 1.0 - smoothstep(-0.004, 0.004, height - ridge));
  colour = mix(colour, paletteHills, 1.0 - smoothstep(-0.004, 0.004, height - nearer));
  colour = mix(colour, trees, 1.0 - smoothstep(-0.004, 0.004, height - crowns));
  return colour * skyDim;
}
`;

// The vineyard on the graphics card: primitives and poses in textures, one draw call for each kind and level of detail.

import * as THREE from "./vendor/three.module.js";
import { Batches } from "./batches.js";
import { boxAround, farthest, outermost } from "./extent.js";
import { BALL, ELLIPSOID, LEAF, MESHES, SPHEROID, TRIANGLE } from "./geometry.js";
import {
  VERTEX,
  vertexForSun,
  fragment,
  depthOnly,
  GROUND_FRAGMENT,
  GROUND_VERTEX,
  SKY_FRAGMENT,
  SKY_VERTEX,
} from "./shaders.js";
import { Terrain } from "./terrain.js";

const SHAPE_SHIFT = 10,
  SURFACE_SHIFT = 9,
  POSE_SHIFT = 9;
/** Distances [m] from which the next coarser level is drawn, in units of a cluster's thickness. */
const LEVEL_DISTANCE = [60, 190, 400];
const COARSEST = 1000;
/** If the budget of triangles is short, distant parts are dropped before near parts become angular. Levels are made
 * coarser by at most the first factor, or the second one with budgets below a phone's, where bunches are dropped last. */
const NEAR_COARSER = 1.5,
  MOST_SHORT = 5;
/** If plants are coarser than intended by these factors, rigid bodies are drawn one and two levels coarser, too. */
const RIGID_COARSER = [3, 8];
/** Largest error of the shape of round parts of rigid bodies, in pixels. */
const ROUNDNESS = 0.5;
/** Share of a cluster's bounding sphere that hides objects behind it, and share of a line of sight up to which plants
 * count as hiding; at the end of the line, where an actor works, there must be plants. */
const HALF_FULL = 0.5,
  MOST_BETWEEN = 0.8;
/** The list is rebuilt when the distance of a rigid body changes by this factor, unless it stays below NEAR [m]. */
const COMES_NEARER = 1.3,
  NEAR = 1.5;
/** A cluster is not drawn if its distance is more than this many times the thickness of its parts. */
const VANISHING = 2600;
/** VANISHING for leaves and grass. It is smaller, because missing bunches and posts are more noticeable. */
const VANISHING_LEAVES = 1300;
/** Share of the budget that plants have at least, however many triangles robots and people have. */
const LEAST_PLANTS = 0.5;
/** A body further than this from its rest position is always drawn [m]. */
const STRAY = 0.2;
/** Number of triangles for a phone, and for each eye of a headset. */
export const TRIANGLE_BUDGET = 300_000;
/** Distance of the eye's motion after which the lists of drawn primitives are rebuilt [m]. */
const STRIDE = 0.25;
const SUN_SIZE = 2048,
  PLAIN_SUN_SIZE = 1024, // without a graphics card
  SUN_REACH = 9,
  SUN_NEAR = 1,
  SUN_FAR = 60;
/** Plants are loaded again after the eye has moved by this share of the loading distance of berries. */
const LEFT = 0.5;
/** Initial capacity for rigid primitives. */
const RIGID_ROOM = 16384;

export class World {
  constructor(header) {
    const { arrays } = header;
    this.header = header;
    this.bodies = header.bodies; // number of bodies of plants; segments of wires follow them
    this.plants = header.room; // largest number of primitives of plants and ground
    this.group = new THREE.Group();
    this.group.rotation.x = -Math.PI / 2; // the world's z is up, the browser's y
    this.rows = this.plants + RIGID_ROOM;
    this.carriers = this.bodies + 1 + 1024;
    this.shapes = dataTexture(THREE.RGBAFormat, THREE.FloatType, Float32Array, 4, this.rows * 4, SHAPE_SHIFT);
    this.surfaces = dataTexture(
      THREE.RGBAIntegerFormat,
      THREE.UnsignedIntType,
      Uint32Array,
      4,
      this.rows,
      SURFACE_SHIFT,
    );
    this.poses = dataTexture(THREE.RGBAFormat, THREE.FloatType, Float32Array, 4, this.carriers * 2, POSE_SHIFT);
    for (let k = 0; k < this.carriers; ++k) this.poses.image.data[8 * k + 7] = 1;
    this.strayed = new Set(); // bodies of plants that are far from their rest positions
    this.rest(arrays.poses);
    this.setPlants(header, arrays.start);
    this.rigidClusters = clusters({ first: [], size: [], kind: [], bunch: [], ball: [], shape: [], carrier: [] });
    this.picked = new Set();
    this.names = [];
    this.outermost = new Map(); // outermost points of rigid bodies, by carrier, in the carrier's frame
    this.bounds = new Map(); // bounding boxes of rigid bodies, by carrier
    this.hidden = new Set(); // carriers whose rigid primitives are not drawn
    this.listedAway = new Map(); // distance from the eye to carriers of round parts, in the last list [m]
    this.rigidVersion = 0;
    this.eye = new THREE.Vector3();
    this.coarser = 1;
    this.triangles = 0;
    this.budget = TRIANGLE_BUDGET;
    this.terrain = new Terrain(header);
    this.makeMeshes(arrays);
    this.poses.needsUpdate = this.shapes.needsUpdate = this.surfaces.needsUpdate = true;
  }

  /** Set the fixed things and plants around a place [3]. `reach`: distance up to which all berries are loaded [m]; null:
   * everything is loaded. */
  setPlants({ arrays, reach }, place) {
    this.write(arrays, 0);
    this.plantClusters = clusters(arrays);
    this.reach = reach;
    this.around = new THREE.Vector3(...place.slice(0, 3));
    this.listedAt = null;
    this.surfaces.clearUpdateRanges(); // all rows are uploaded
    this.shapes.needsUpdate = this.surfaces.needsUpdate = true;
  }

  /** Returns whether the eyes have moved so far that the plants around them should be loaded. */
  isLeft(eye) {
    return this.reach !== null && eye.distanceTo(this.around) > LEFT * this.reach;
  }

  /** Move all plants to their poses [7] at rest. */
  rest(poses) {
    this.strayed.clear();
    for (let k = 0; k < this.bodies; ++k) {
      const pose = poses.subarray(7 * k, 7 * k + 7);
      this.poses.image.data.set(pose.subarray(0, 3), 8 * k);
      this.poses.image.data.set(pose.subarray(3), 8 * k + 4);
    }
    this.poses.needsUpdate = true;
  }

  /** Write primitives into the textures, from a row on. */
  write(arrays, row) {
    this.shapes.image.data.set(arrays.shape, row * 16);
    const surface = this.surfaces.image.data,
      colour = new Uint32Array(arrays.surface.slice().buffer);
    for (let k = 0; k < arrays.material.length; ++k) {
      surface[4 * (row + k)] = colour[k];
      surface[4 * (row + k) + 1] = arrays.material[k];
      surface[4 * (row + k) + 2] = arrays.carrier[k];
    }
  }

  makeMeshes(arrays) {
    const { header } = this;
    const outlineCount = arrays.hull.length / 16; // at most 16: leafExtent of the shaders
    const extent = new Float32Array(64);
    for (let k = 0; k < outlineCount; ++k) {
      const hull = arrays.hull.subarray(16 * k, 16 * k + 16);
      const at = (corner, axis) => hull[2 * corner + axis];
      extent.set([Math.max(Math.abs(at(1, 0)), Math.abs(at(5, 0))), at(3, 1), at(7, 1), 0], 4 * k);
    }
    const outlines = new THREE.DataArrayTexture(
      Uint8Array.from(arrays.outline, (x) => x + 128),
      128,
      128,
      outlineCount,
    );
    outlines.format = THREE.RedFormat;
    outlines.minFilter = outlines.magFilter = THREE.LinearFilter;
    outlines.needsUpdate = true;
    this.sunTarget = new THREE.WebGLRenderTarget(SUN_SIZE, SUN_SIZE, {
      depthTexture: new THREE.DepthTexture(SUN_SIZE, SUN_SIZE, THREE.UnsignedIntType),
      minFilter: THREE.NearestFilter,
      magFilter: THREE.NearestFilter,
    });
    this.sunCamera = new THREE.OrthographicCamera(-SUN_REACH, SUN_REACH, SUN_REACH, -SUN_REACH, SUN_NEAR, SUN_FAR);
    const noises = smoothTable(new THREE.DataTexture(arrays.noise, 256, 256, THREE.RGBAFormat));
    noises.wrapS = noises.wrapT = THREE.RepeatWrapping;
    const leaves = smoothTable(new THREE.DataArrayTexture(arrays.leaf, 64, 64, outlineCount));
    const common = {
      eye: { value: this.eye },
      sun: { value: new THREE.Vector3(...header.sun) },
      outlines: { value: outlines },
      noises: { value: noises },
      ...lightOf(header.light),
      ...paletteOf(header.palette),
      sunDepth: { value: this.sunTarget.depthTexture },
      sunMatrix: { value: new THREE.Matrix4() },
      sunTexel: { value: (2 * SUN_REACH) / SUN_SIZE },
      sunDeep: { value: SUN_FAR - SUN_NEAR },
    };
    this.common = common;
    const uniforms = {
      ...common,
      poses: { value: this.poses },
      shapes: { value: this.shapes },
      surfaces: { value: this.surfaces },
      leafExtent: { value: extent },
      leaves: { value: leaves },
    };
    this.shadowGroup = new THREE.Group();
    this.shadowGroup.rotation.x = -Math.PI / 2;
    this.uniforms = uniforms;
    this.draws = MESHES.map((kind) => this.makeDraws(kind));
    this.group.add(this.makeGround(arrays, common), makeSky(common));
  }

  /** Returns the lists of primitives of a kind that are drawn, by level of detail. */
  makeDraws({ name, levels }) {
    return levels.map((level) => {
      const batches = new Batches(level),
        uniforms = { ...this.uniforms, ...batches.uniforms };
      const add = (group, geometry, vertexShader, fragmentShader, side) => {
        const material = new THREE.RawShaderMaterial({
          glslVersion: THREE.GLSL3,
          vertexShader,
          fragmentShader,
          uniforms,
          side,
        });
        const mesh = new THREE.Mesh(geometry, material);
        mesh.frustumCulled = false;
        group.add(mesh);
        return mesh;
      };
      const side = name === "leaf" ? THREE.DoubleSide : THREE.FrontSide;
      batches.mesh = add(this.group, batches.geometry, VERTEX[name], fragment(name), side);
      const { shadowGeometry } = batches;
      batches.shadow = add(this.shadowGroup, shadowGeometry, vertexForSun(name), depthOnly(name), THREE.DoubleSide);
      return batches;
    });
  }

  /**
   * Draw for a browser without a graphics card: spheroids are single triangles with a round outline, and a pixel reads
   * fewer texels.
   */
  simplify() {
    for (const { mesh, shadow } of this.draws[SPHEROID]) {
      mesh.removeFromParent();
      shadow.removeFromParent();
    }
    this.draws[SPHEROID] = this.makeDraws(BALL);
    this.sunTarget.setSize(PLAIN_SUN_SIZE, PLAIN_SUN_SIZE);
    this.common.sunTexel.value = (2 * SUN_REACH) / PLAIN_SUN_SIZE;
    for (const { material } of this.group.children) {
      if (!material?.isRawShaderMaterial) continue;
      material.defines = { PLAIN: "" };
      material.needsUpdate = true;
    }
    for (const table of [this.common.noises.value, this.uniforms.leaves.value]) {
      table.minFilter = THREE.LinearMipmapNearestFilter;
      table.needsUpdate = true;
    }
    this.listedAt = null;
  }

  makeGround(arrays, common) {
    const [x, y, cell] = this.header.ground;
    const columns = this.header.ground_columns,
      share = (s) => 255 * Math.min(Math.max(s, 0), 1);
    const sky = new THREE.DataTexture(
      Uint8Array.from(arrays.ground_sky, share),
      columns,
      arrays.ground_sky.length / columns,
      THREE.RedFormat,
    );
    sky.unpackAlignment = 1;
    sky.minFilter = sky.magFilter = THREE.LinearFilter;
    sky.needsUpdate = true;
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: GROUND_VERTEX,
      fragmentShader: GROUND_FRAGMENT,
      uniforms: {
        ...common,
        groundSky: { value: sky },
        ground: { value: new THREE.Vector3(x, y, cell) },
        rows: { value: new THREE.Vector2(...this.header.rows) },
      },
    });
    const mesh = new THREE.Mesh(this.terrain.geometry(), material);
    mesh.frustumCulled = false;
    return mesh;
  }

  /** Set the shapes of robots, people, boxes and picked bunches. */
  setRigid(header) {
    const { arrays } = header,
      count = arrays.material.length;
    if (this.plants + count > this.rows) throw new Error(`${count} rigid primitives; there is room for ${RIGID_ROOM}`);
    this.write(arrays, this.plants);
    this.drawStumps(arrays);
    this.rigidClusters = clusters(arrays);
    this.names = header.names;
    this.listedAway.clear();
    this.outermost = outermost(arrays);
    this.bounds = new Map([...this.outermost].map(([carrier, points]) => [carrier, boxAround(points)]));
    const own = partsBeforeEyes(this.header);
    this.hidden = new Set();
    this.names.forEach((name, k) => {
      if (own.has(name)) this.hidden.add(this.bodies + 1 + k);
    });
    this.rigidVersion = header.version;
    this.surfaces.clearUpdateRanges(); // all of it
    this.shapes.needsUpdate = this.surfaces.needsUpdate = true;
    this.listedAt = null;
  }

  /**
   * Set the primitives of wood that was cut, or is whole again, and of its leaves. A key is a carrier and a first point
   * that a primitive has had.
   */
  drawStumps({ stump_shape, stump_surface, stump_material, stump_carrier, stump_key }) {
    if (stump_carrier.length === 0) return;
    const carriers = new Set();
    const number = new Map();
    stump_carrier.forEach((_, k) => {
      const key = stump_key.subarray(4 * k, 4 * k + 4);
      carriers.add(key[0]);
      number.set(key.join(), k);
    });
    const shapes = this.shapes.image.data,
      surface = this.surfaces.image.data,
      colour = new Uint32Array(stump_surface.slice().buffer);
    for (let row = 0; row < this.plants; ++row) {
      if (!carriers.has(surface[4 * row + 2])) continue;
      const point = shapes.subarray(16 * row, 16 * row + 3);
      const k = number.get(`${surface[4 * row + 2]},${point.join()}`);
      if (k === undefined) continue;
      shapes.set(stump_shape.subarray(16 * k, 16 * k + 16), 16 * row);
      surface.set([colour[k], stump_material[k], stump_carrier[k]], 4 * row);
    }
  }

  /** Set the poses of moved trees, and the picked bunches. */
  apply(state) {
    const { body, place, turn, picked } = state.arrays;
    const rest = this.header.arrays.poses;
    for (let k = 0; k < body.length; ++k) {
      this.pose(body[k], place, turn, k);
      const at = 7 * body[k];
      const away = Math.hypot(
        place[3 * k] - rest[at],
        place[3 * k + 1] - rest[at + 1],
        place[3 * k + 2] - rest[at + 2],
      );
      const isAway = away > STRAY;
      if (isAway === this.strayed.has(body[k])) continue;
      if (isAway) this.strayed.add(body[k]);
      else this.strayed.delete(body[k]);
      this.listedAt = null;
    }
    this.poses.needsUpdate = true;
    if (picked.length !== this.picked.size || picked.some((bunch) => !this.picked.has(bunch))) {
      this.picked = new Set(picked);
      this.listedAt = null;
    }
  }

  /** Set poses and lights of robots, people, boxes and picked bunches, numbered as in `setRigid`. */
  applyRigid({ rigid_place, rigid_turn, ...arrays }) {
    for (let k = 0; k < rigid_place.length / 3; ++k) this.pose(this.bodies + 1 + k, rigid_place, rigid_turn, k);
    this.poses.needsUpdate = true;
    for (const [carrier, before] of this.listedAway) {
      const now = this.away(carrier);
      if (Math.max(now, before) > COMES_NEARER * Math.min(now, before)) this.listedAt = null;
    }
    this.light(arrays);
  }

  /** Set colours of indicator lights; only changed rows are sent to the graphics card. */
  light({ lamp, lamp_surface, lamp_material }) {
    const surface = this.surfaces.image.data,
      colour = new Uint32Array(lamp_surface.slice().buffer);
    for (let k = 0; k < lamp.length; ++k) {
      const at = 4 * (this.plants + lamp[k]);
      if (surface[at] === colour[k] && surface[at + 1] === lamp_material[k]) continue;
      surface[at] = colour[k];
      surface[at + 1] = lamp_material[k];
      this.surfaces.addUpdateRange(at, 4);
      this.surfaces.needsUpdate = true;
    }
  }

  pose(carrier, place, turn, k) {
    const data = this.poses.image.data;
    for (let axis = 0; axis < 3; ++axis) data[8 * carrier + axis] = place[3 * k + axis];
    for (let axis = 0; axis < 4; ++axis) data[8 * carrier + 4 + axis] = turn[4 * k + axis] / 32767;
  }

  /** Position [3] of a carrier in the world. */
  place(carrier) {
    return new THREE.Vector3().fromArray(this.poses.image.data, 8 * carrier);
  }

  /** Returns the name of a carrier's rigid body, "" for plants. A body's carrier changes when other bodies are added or removed. */
  nameOf(carrier) {
    return this.names[carrier - this.bodies - 1] ?? "";
  }

  /** Quaternion of a carrier. */
  turn(carrier) {
    return new THREE.Quaternion().fromArray(this.poses.image.data, 8 * carrier + 4).normalize();
  }

  /** A point of the world (Vector3) in the frame of a carrier. */
  within(carrier, point) {
    return point.clone().sub(this.place(carrier)).applyQuaternion(this.turn(carrier).conjugate());
  }

  /** World position of a point (Vector3) in the frame of a carrier. */
  beyond(carrier, point) {
    return point.clone().applyQuaternion(this.turn(carrier)).add(this.place(carrier));
  }

  /** Height of the highest point of several carriers [m]. */
  top(carriers) {
    return Math.max(
      ...carriers
        .filter((carrier) => this.outermost.has(carrier))
        .map((carrier) => {
          const up = new THREE.Vector3(0, 0, 1).applyQuaternion(this.turn(carrier).conjugate());
          return this.place(carrier).z + farthest(this.outermost.get(carrier), up);
        }),
    );
  }

  /** Heading of a carrier about the vertical [rad]. */
  heading(carrier) {
    const [x, y, z, w] = this.poses.image.data.subarray(8 * carrier + 4, 8 * carrier + 8);
    return Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
  }

  /** Set the largest number of triangles, from the next list on. */
  setBudget(triangles) {
    if (triangles > this.budget) this.coarser = 1; // `list` then increases it as needed
    this.budget = triangles;
    this.listedAt = null;
  }

  /**
   * Choose what is drawn and at which level of detail, for an eye [3] in the world that looks along `ahead` with half
   * the field of view `field` and pixels of the angle `pixel`. The list is valid until the eyes have turned by `turn` or
   * their field of view changes; objects that cannot become visible until then only cast shadows.
   */
  list(eye, ahead, { field, turn, pixel }) {
    this.eye.copy(eye);
    const isNear =
      this.listedAt !== null && this.listedAt.distanceTo(eye) < STRIDE && this.listedAhead.angleTo(ahead) < turn;
    if (isNear && this.listedField === field && this.pixel === pixel) return;
    this.listedAt = eye.clone();
    this.listedField = field;
    this.pixel = pixel;
    this.listedAhead = ahead.clone();
    for (;;) {
      for (const level of this.draws.flat()) level.clear();
      this.chooseRigid();
      const rigid = this.countTriangles();
      this.choosePlants(field + turn);
      this.triangles = this.countTriangles();
      if (this.triangles <= Math.max(this.budget, rigid + LEAST_PLANTS * this.budget) || this.coarser > COARSEST) break;
      this.coarser *= 1.3;
    }
    if (this.triangles < 0.6 * this.budget) this.coarser = Math.max(1, this.coarser / 1.3);
    for (const level of this.draws.flat()) level.update();
  }

  countTriangles() {
    return this.draws.flat().reduce((sum, level) => sum + level.triangles, 0);
  }

  chooseRigid() {
    const { first, size, kind, carrier, widest } = this.rigidClusters,
      coarser = RIGID_COARSER.filter((most) => this.coarser > most).length;
    for (let k = 0; k < first.length; ++k) {
      if (this.hidden.has(carrier[k])) continue;
      const levels = this.draws[kind[k]],
        { inside } = MESHES[kind[k]];
      let level = Math.min(coarser, levels.length - 1);
      if (inside) {
        this.listedAway.set(carrier[k], this.away(carrier[k]));
        const seen = (widest[k] * COMES_NEARER) / this.listedAway.get(carrier[k]) / this.pixel;
        level = Math.max(0, inside.filter((share) => share * seen < ROUNDNESS).length - 1);
      }
      levels[level].seen.add(this.plants + first[k], size[k]);
    }
  }

  /** Returns the number of clusters of plants on the line from an eye [3] to a point [3] in the world, or around the eye. */
  countBetween(eye, point) {
    const { first, ball } = this.plantClusters,
      way = point.map((value, axis) => value - eye[axis]);
    const square = way[0] ** 2 + way[1] ** 2 + way[2] ** 2;
    let count = 0;
    for (let k = 0; k < first.length; ++k) {
      const x = ball[4 * k] - eye[0],
        y = ball[4 * k + 1] - eye[1],
        z = ball[4 * k + 2] - eye[2];
      const along = Math.min(Math.max((x * way[0] + y * way[1] + z * way[2]) / square, 0), MOST_BETWEEN);
      const away = Math.hypot(x - along * way[0], y - along * way[1], z - along * way[2]);
      count += away < HALF_FULL * ball[4 * k + 3];
    }
    return count;
  }

  /** Returns a lower bound of the distance from the eye to the surface of a rigid body [m]. */
  away(carrier) {
    const { min, max } = this.bounds.get(carrier),
      { x, y, z } = this.eye,
      data = this.poses.image.data,
      at = 8 * carrier;
    const away = Math.hypot(data[at] - x, data[at + 1] - y, data[at + 2] - z);
    return Math.max(away - Math.max(min.length(), max.length()), NEAR);
  }

  choosePlants(angle) {
    const { first, size, kind, bunch, ball, thickness, carrier } = this.plantClusters,
      { x, y, z } = this.eye;
    const ahead = this.listedAhead,
      short = Math.min(Math.max(TRIANGLE_BUDGET / this.budget, 1), MOST_SHORT);
    const vanishing = { [LEAF]: VANISHING_LEAVES, [SPHEROID]: VANISHING * short };
    for (let k = 0; k < first.length; ++k) {
      if (bunch[k] >= 0 && this.picked.has(bunch[k])) continue;
      const dx = ball[4 * k] - x,
        dy = ball[4 * k + 1] - y,
        dz = ball[4 * k + 2] - z,
        radius = ball[4 * k + 3];
      const away = Math.hypot(dx, dy, dz),
        sizes = Math.max(away - radius, 0.05) / thickness[k];
      if (sizes * this.coarser > (vanishing[kind[k]] ?? VANISHING)) continue;
      const ratio = sizes * Math.min(this.coarser, NEAR_COARSER * short),
        levels = this.draws[kind[k]];
      let level = 0;
      while (level < levels.length - 1 && ratio > LEVEL_DISTANCE[level] * (kind[k] === LEAF ? 0.35 : 1)) ++level;
      const around = (radius + STRIDE) / away;
      const cosine = (dx * ahead.x + dy * ahead.y + dz * ahead.z) / away; // beyond 1 by rounding
      const isSeen =
        around >= 1 ||
        this.strayed.has(carrier[k]) ||
        Math.acos(Math.max(-1, Math.min(1, cosine))) < angle + Math.asin(around);
      if (isSeen) levels[level].seen.add(first[k], size[k]);
      else if (away - radius < SUN_REACH * Math.SQRT2) levels[level].unseen.add(first[k], size[k]);
    }
  }

  /** Render the sun's depth map around the eye. */
  renderShadow(renderer) {
    const sun = this.common.sun.value,
      camera = this.sunCamera;
    if (sun.z < 0.03) return;
    const step = 64 * this.common.sunTexel.value; // whole texels, so that edges of shadows do not crawl
    const centre = new THREE.Vector3(Math.round(this.eye.x / step) * step, Math.round(this.eye.y / step) * step, 1);
    camera.position.copy(centre).addScaledVector(sun, 30).applyMatrix4(this.shadowGroup.matrixWorld);
    camera.up.set(0, 1, 0);
    camera.lookAt(centre.clone().applyMatrix4(this.shadowGroup.matrixWorld));
    camera.updateMatrixWorld();
    this.shadowGroup.updateMatrixWorld();
    const vr = renderer.xr.enabled;
    renderer.xr.enabled = false;
    renderer.setRenderTarget(this.sunTarget);
    renderer.clear();
    renderer.render(this.shadowGroup, camera);
    renderer.setRenderTarget(null);
    renderer.xr.enabled = vr;
    this.common.sunMatrix.value
      .copy(camera.projectionMatrix)
      .multiply(camera.matrixWorldInverse)
      .multiply(this.shadowGroup.matrixWorld);
  }
}

/** Returns the parts of the page's own person that would hide the person's view. */
function partsBeforeEyes({ person }) {
  return new Set(person === null ? [] : ["head", "neck"].map((part) => `${person}/${part}`));
}

/** Uniforms of the cameras' light. */
function lightOf({ balance, exposure, dim, ...colours }) {
  const uniforms = { gain: { value: new THREE.Vector3(...balance).multiplyScalar(exposure) }, skyDim: { value: dim } };
  for (const [name, colour] of Object.entries(colours))
    uniforms[`${name}Colour`] = { value: new THREE.Vector3(...colour) };
  return uniforms;
}

/** Uniforms of the vineyard's colours (three numbers) and shares (one number): soil_dark becomes paletteSoilDark. */
function paletteOf(palette) {
  const uniforms = {};
  for (const [name, value] of Object.entries(palette)) {
    const words = name.split("_").map((word) => word[0].toUpperCase() + word.slice(1));
    uniforms[`palette${words.join("")}`] = { value: Array.isArray(value) ? new THREE.Vector3(...value) : value };
  }
  return uniforms;
}

/** Returns a texture of a table, with mipmaps. */
function smoothTable(texture) {
  texture.minFilter = THREE.LinearMipmapLinearFilter;
  texture.magFilter = THREE.LinearFilter;
  texture.generateMipmaps = texture.needsUpdate = true;
  return texture;
}

function makeSky(common) {
  const material = new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader: SKY_VERTEX,
    fragmentShader: SKY_FRAGMENT,
    uniforms: common,
    side: THREE.BackSide,
    depthWrite: false,
    depthFunc: THREE.LessEqualDepth,
  });
  const mesh = new THREE.Mesh(new THREE.SphereGeometry(1, 24, 12), material);
  mesh.frustumCulled = false;
  mesh.renderOrder = 1;
  return mesh;
}

function dataTexture(format, type, Kind, channels, texels, shift) {
  const width = 1 << shift,
    height = Math.max(Math.ceil(texels / width), 1);
  const texture = new THREE.DataTexture(new Kind(width * height * channels), width, height, format, type);
  if (format === THREE.RGBAIntegerFormat) texture.internalFormat = "RGBA32UI";
  texture.minFilter = texture.magFilter = THREE.NearestFilter;
  return texture;
}

/** Returns runs of primitives with the mean thickness of their parts and their largest radius [m]. */
function clusters(arrays) {
  const { first, size, kind, bunch, ball, shape } = arrays,
    count = first.length;
  const thickness = new Float32Array(count),
    widest = new Float32Array(count);
  for (let k = 0; k < count; ++k) {
    let sum = 0;
    for (let at = 16 * first[k]; at < 16 * (first[k] + size[k]); at += 16) {
      sum += Math.abs(shape[at + 3]);
      widest[k] = Math.max(
        widest[k],
        shape[at + 3],
        kind[k] === ELLIPSOID ? Math.max(shape[at + 8], shape[at + 9]) : 0,
      );
    }
    thickness[k] =
      kind[k] === TRIANGLE
        ? 1
        : Math.max(sum / size[k], 1e-4) * (kind[k] === LEAF ? 0.6 : kind[k] === SPHEROID ? 0.8 : 1);
  }
  const carrier = Array.from(first, (row) => arrays.carrier[row]);
  return { first, size, kind, bunch, ball, thickness, widest, carrier };
}

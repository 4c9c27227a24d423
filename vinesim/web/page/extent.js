// Extents of rigid bodies: outermost points in many directions, for all kinds of primitives.

import * as THREE from "./vendor/three.module.js";
import { BOX, ELLIPSOID, SPHEROID, TRIANGLE } from "./geometry.js";

/** Directions, x y z each, beginning with both directions of each axis; enough to find a head's top within 2 mm. */
const AROUND = directions(122);

/** Outermost points [3] of the primitives of each carrier in the directions `AROUND`, in the carrier's frame. */
export function outermost({ shape, first, size, kind, carrier }) {
  const hulls = new Map(),
    u = new THREE.Vector3();
  first.forEach((start, k) => {
    const of = carrier[start];
    if (!hulls.has(of)) hulls.set(of, new Hull());
    const hull = hulls.get(of);
    for (let row = start; row < start + size[k]; ++row)
      for (let direction = 0; direction < AROUND.length; direction += 3)
        if (kind[k] === TRIANGLE)
          for (let at = 16 * row; at < 16 * row + 12; at += 4)
            hull.add(direction, shape[at], shape[at + 1], shape[at + 2]);
        else hull.add(direction, ...support(shape, 16 * row, kind[k], u.fromArray(AROUND, direction)));
  });
  return new Map([...hulls].map(([of, { points }]) => [of, points]));
}

/** Returns the largest coordinate of `points` along a direction [m]. */
export function farthest(points, { x, y, z }) {
  let along = -Infinity;
  for (let at = 0; at < points.length; at += 3)
    along = Math.max(along, x * points[at] + y * points[at + 1] + z * points[at + 2]);
  return along;
}

/** Bounding box of `points` from `outermost`. */
export function boxAround(points) {
  return new THREE.Box3().setFromArray(points.subarray(0, 18)); // the points in the directions of the axes
}

class Hull {
  constructor() {
    this.points = new Float32Array(AROUND.length);
    this.along = new Float64Array(AROUND.length / 3).fill(-Infinity);
  }

  add(direction, x, y, z) {
    const along = AROUND[direction] * x + AROUND[direction + 1] * y + AROUND[direction + 2] * z;
    if (along <= this.along[direction / 3]) return;
    this.along[direction / 3] = along;
    this.points[direction] = x;
    this.points[direction + 1] = y;
    this.points[direction + 2] = z;
  }
}

/** Returns the outermost point of a primitive (not a triangle) in the direction `u`. */
function support(shape, at, kind, u) {
  const [a, b, c] = [0, 4, 8].map((from) => new THREE.Vector3().fromArray(shape, at + from)),
    radius = shape[at + 3];
  if (kind === SPHEROID) {
    const w = u.clone().addScaledVector(b, u.dot(b) * (shape[at + 7] ** 2 - 1));
    return a.addScaledVector(w, radius / Math.sqrt(u.dot(w)));
  }
  if (kind === BOX || kind === ELLIPSOID) {
    const turn = new THREE.Quaternion().fromArray(shape, at + 4),
      half = new THREE.Vector3(radius, c.x, c.y);
    const local = u.clone().applyQuaternion(turn.clone().conjugate());
    if (kind === BOX) local.set(...local.toArray().map(Math.sign));
    else local.divideScalar(local.multiply(half).length());
    return a.add(local.multiply(half).applyQuaternion(turn));
  }
  return (u.dot(a) > u.dot(b) ? a : b).addScaledVector(u, radius);
}

/** Both directions of each axis, then `count` other directions distributed evenly. */
function directions(count) {
  const axes = [1, 0, 0, -1, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 1, 0, 0, -1];
  return Float64Array.from(
    axes.concat(
      Array.from({ length: count }, (_, k) => {
        const z = 1 - (2 * k + 1) / count,
          turned = k * Math.PI * (3 - Math.sqrt(5)),
          flat = Math.sqrt(1 - z * z);
        return [flat * Math.cos(turned), flat * Math.sin(turned), z];
      }).flat(),
    ),
  );
}

// Finds the object that is pointed at: wood, bunches and rigid bodies along a ray from the eyes.

import * as THREE from "./vendor/three.module.js";

const NEAREST = 0.05; // m from the eyes
/** Angle between an object and the ray that counts as much as a metre of distance from the eye [rad]. */
const FARNESS = 0.01;
/** Depth to which hands go into a bunch, as a share of its radius, and into a rigid body [m]. */
const INTO_BUNCH = 0.3,
  INTO_RIGID = 0.02;

/**
 * Returns the object that a ray from the `eye` in the direction `ray` (both Vector3, world) hits, or misses by less than
 * `spread` [rad]; null: there is no such object within `farthest` [m]. The result has `carrier` and its `name`, a point
 * `at` in the carrier's frame, the `distance` of this point from the eye [m], and `what` the object is. Objects within
 * `reach` [m] of an arm have priority, then objects near the ray. With shears only wood counts; for a bunch it is the
 * last segment of the peduncle. Leaves are ignored.
 */
export function pointAt(world, eye, ray, { spread, reach, farthest, withShears }) {
  const { wood, wood_length, bunch_body, bunch_length, bunch_radius, bunch_stalk, stalk_length } = world.header.arrays;
  let best = null;
  const offer = (missed, depth, carrier, point, what) => {
    const distance = point.distanceTo(eye);
    if (missed > spread || depth < NEAREST || distance > farthest) return;
    const cost = missed + FARNESS * depth + (distance > reach ? 1e3 : 0);
    if (best === null || cost < best.cost)
      best = { cost, carrier, name: world.nameOf(carrier), at: world.within(carrier, point), distance, what };
  };
  const offerAxis = (carrier, length, radius, accept) => {
    const start = world.place(carrier);
    if (start.distanceTo(eye) > farthest + length) return;
    const axis = new THREE.Vector3(1, 0, 0).applyQuaternion(world.turn(carrier));
    const { along, depth, gap } = nearest(eye, ray, start, axis, length);
    accept(Math.max(gap - radius, 0) / depth, depth, start.addScaledVector(axis, along));
  };
  wood.forEach((carrier, k) => {
    offerAxis(carrier, wood_length[k], 0, (missed, depth, point) => offer(missed, depth, carrier, point, "cane"));
  });
  bunch_body.forEach((carrier, k) => {
    if (world.picked.has(k)) return;
    offerAxis(carrier, bunch_length[k], bunch_radius[k], (missed, depth, point) => {
      if (!withShears)
        return offer(missed, depth, carrier, point.addScaledVector(ray, (INTO_BUNCH - 1) * bunch_radius[k]), "bunch");
      const stalk = bunch_stalk[k],
        middle = new THREE.Vector3(0.5 * stalk_length[k], 0, 0);
      return offer(missed, depth, stalk, middle.applyQuaternion(world.turn(stalk)).add(world.place(stalk)), "bunch");
    });
  });
  if (!withShears)
    for (const [carrier, box] of world.bounds) {
      const [owner] = world.nameOf(carrier).split("/");
      if (owner === world.header.person) continue;
      const from = world.within(carrier, eye),
        way = ray.clone().applyQuaternion(world.turn(carrier).conjugate());
      const hit = new THREE.Ray(from, way).intersectBox(box, new THREE.Vector3());
      if (hit === null) continue;
      const depth = hit.distanceTo(from);
      const at = owner === "bunch" ? box.getCenter(new THREE.Vector3()) : hit.addScaledVector(way, INTO_RIGID);
      offer(0, depth, carrier, world.beyond(carrier, at), owner);
    }
  return best;
}

/** Nearest points of a ray and of a piece of an axis [m]: position along the piece, depth along the ray, and the gap. */
function nearest(eye, ray, start, axis, length) {
  const apart = eye.clone().sub(start),
    b = ray.dot(axis),
    d = ray.dot(apart),
    e = axis.dot(apart);
  const along = Math.min(Math.max((e - b * d) / Math.max(1 - b * b, 1e-9), 0), length);
  const way = start.clone().addScaledVector(axis, along).sub(eye),
    depth = way.dot(ray);
  return { along, depth: Math.max(depth, 1e-3), gap: way.addScaledVector(ray, -depth).length() };
}

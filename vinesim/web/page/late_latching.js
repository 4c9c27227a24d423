// Late latching: the person's own hands are drawn at their present poses, not at their poses in the newest state.

import * as THREE from "./vendor/three.module.js";

const SIDES = ["left", "right"];
const PART = /\/(left|right)_(hand|thumb|index|middle|ring|little|shears)/;

export class LateHands {
  constructor(world) {
    this.world = world;
    this.parts = []; // [side, carrier, pose in the state]
    this.held = null; // by side: offset of the simulated hand from the controller, in the newest state
  }

  /** Called when a state was applied, with the simulated hands and the controllers that they followed. */
  take({ arrays }) {
    const { world } = this,
      { hand_proxy: proxy, hand_controller: controller } = arrays;
    if (!proxy) return;
    this.parts = [];
    world.names.forEach((name, k) => {
      const found = name.startsWith(`${world.header.person}/`) && PART.exec(name);
      if (!found) return;
      const carrier = world.bodies + 1 + k,
        data = world.poses.image.data;
      this.parts.push([
        SIDES.indexOf(found[1]),
        carrier,
        matrix([...data.subarray(8 * carrier, 8 * carrier + 3), ...data.subarray(8 * carrier + 4, 8 * carrier + 8)]),
      ]);
    });
    this.held = SIDES.map((_, k) => {
      const hand = matrix(proxy.subarray(7 * k, 7 * k + 7)),
        held = matrix(controller.subarray(7 * k, 7 * k + 7));
      return { back: hand.clone().invert(), offset: held.invert().multiply(hand) };
    });
  }

  /** Returns the present pose (Matrix4, world) of the palm of a side, 0 left and 1 right; null: not known. */
  palm(person, k) {
    const seen = person[SIDES[k]];
    return seen === null || this.held === null ? null : matrix(seen.pose).multiply(this.held[k].offset);
  }

  /** Move the hands with their present tracked poses. A free hand has no delay; a hand that a contact holds back keeps its
   * offset. */
  draw(person) {
    if (this.held === null) return;
    const moved = SIDES.map((_, k) => this.palm(person, k)?.multiply(this.held[k].back) ?? null);
    const place = new THREE.Vector3(),
      turn = new THREE.Quaternion(),
      scale = new THREE.Vector3();
    const data = this.world.poses.image.data;
    for (const [side, carrier, pose] of this.parts) {
      if (moved[side] === null) continue;
      moved[side].clone().multiply(pose).decompose(place, turn, scale);
      data.set([place.x, place.y, place.z], 8 * carrier);
      data.set([turn.x, turn.y, turn.z, turn.w], 8 * carrier + 4);
    }
    this.world.poses.needsUpdate = true;
  }
}

function matrix([x, y, z, ...turn]) {
  return new THREE.Matrix4().compose(
    new THREE.Vector3(x, y, z),
    new THREE.Quaternion(...turn),
    new THREE.Vector3(1, 1, 1),
  );
}

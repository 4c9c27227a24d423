// Late latching: the person's own body is drawn at the present poses of head and hands, not at the poses in the newest
// state, whose age is one or two pictures. Hands, arms and body have the same age, so that they are joined.

import * as THREE from "./vendor/three.module.js";

const SIDES = ["left", "right"];
const HAND = /^(left|right)_(hand|thumb|index|middle|ring|little|shears)/,
  LEG = /^(hips|(left|right)_(thigh|shank|foot))$/;

export class LateHands {
  /** Draws into the `world`, whose header has the limbs of its person. */
  constructor(world) {
    this.world = world;
    this.parts = []; // of the person: name, carrier, pose in the state
    this.held = null; // by side: offset of the simulated hand from the controller, in the newest state
    this.head = null; // upright pose of the head in the newest state
  }

  /** Called when a state was applied, with the simulated hands and the controllers that they followed. */
  take({ arrays }) {
    const { world } = this,
      { hand_proxy: proxy, hand_controller: controller } = arrays,
      own = `${world.header.person}/`;
    if (!proxy) return;
    this.parts = [];
    world.names.forEach((name, k) => {
      if (!name.startsWith(own)) return;
      const carrier = world.bodies + 1 + k,
        data = world.poses.image.data;
      const pose = [...data.subarray(8 * carrier, 8 * carrier + 3), ...data.subarray(8 * carrier + 4, 8 * carrier + 8)];
      this.parts.push({ name: name.slice(own.length), carrier, pose: matrix(pose) });
      if (name === `${own}head`) this.head = upright(pose);
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

  /** Move the body with the present head, and the hands with their present tracked poses; arms join them. A free hand has
   * no delay; a hand that a contact holds back keeps its offset. */
  draw(person) {
    if (this.held === null || this.head === null) return;
    const moved = upright(person.head).multiply(this.head.clone().invert()),
      walked = moved.clone();
    walked.elements[14] = 0; // feet stay on the ground; this.head is upright, so this is the change of height
    const hands = SIDES.map((_, k) => this.palm(person, k)?.multiply(this.held[k].back) ?? moved);
    const now = new Map();
    for (const { name, carrier, pose } of this.parts) {
      const side = HAND.exec(name)?.[1],
        change = side ? hands[SIDES.indexOf(side)] : LEG.test(name) ? walked : moved;
      now.set(name, { carrier, pose: change.clone().multiply(pose) });
    }
    const { limbs } = this.world.header;
    if (now.has("chest"))
      for (const side of SIDES) {
        const hand = now.get(`${side}_hand`),
          [upper, fore] = [now.get(`${side}_upper_arm`), now.get(`${side}_forearm`)];
        if (!hand || !upper || !fore) continue;
        [upper.pose, fore.pose] = armBetween(now.get("chest").pose, hand.pose, limbs, side === "left" ? 1 : -1);
      }
    const place = new THREE.Vector3(),
      turn = new THREE.Quaternion(),
      scale = new THREE.Vector3();
    const data = this.world.poses.image.data;
    for (const { carrier, pose } of now.values()) {
      pose.decompose(place, turn, scale);
      data.set([place.x, place.y, place.z], 8 * carrier);
      data.set([turn.x, turn.y, turn.z, turn.w], 8 * carrier + 4);
    }
    this.world.poses.needsUpdate = true;
  }
}

/**
 * Returns the poses (Matrix4) of upper arm and forearm between the poses of chest and hand, as the client computes them
 * (vinesim/kernels/rigid/human_kinematics.py). If the hand is out of the arm's reach, shoulder and elbow make the missing
 * way. `mirror`: 1 for the left side, -1 for the right one.
 */
function armBetween(chest, hand, { shoulder, upper_arm: upper, forearm: lower, wrist, elbow }, mirror) {
  const point = ([x, y, z], pose) => new THREE.Vector3(x, mirror * y, z).applyMatrix4(pose);
  const turned = ([x, y, z], pose) => new THREE.Vector3(x, y, z).transformDirection(pose);
  const joint = point(shoulder, chest),
    target = point(wrist, hand),
    most = upper + lower - 1e-6;
  const away = target.distanceTo(joint),
    way = target.clone().sub(joint).normalize();
  const stretch = Math.max(away - most, 0) / 3;
  joint.addScaledVector(way, 2 * stretch);
  const reach = Math.min(Math.max(target.distanceTo(joint), Math.abs(upper - lower) + 1e-3), most);
  const along = (upper * upper - lower * lower + reach * reach) / (2 * reach);
  const out = across(turned([elbow[0], mirror * elbow[1], elbow[2]], chest), way);
  const bend = joint
    .clone()
    .addScaledVector(way, along)
    .addScaledVector(out, Math.sqrt(Math.max(upper * upper - along * along, 0)));
  const arm = bend.clone().sub(joint).normalize(),
    fore = joint.clone().addScaledVector(way, reach).sub(bend).normalize();
  bend.addScaledVector(way, stretch);
  const back = turned([0, 0, 1], hand).addScaledVector(turned([1, 0, 0], hand), 1e-3);
  return [poseOf(joint, arm, across(out.negate(), arm)), poseOf(bend, fore, across(back, fore))];
}

/** Returns the component of a vector that is perpendicular to the unit vector `axis`, normalised. */
function across(vector, axis) {
  return vector.clone().addScaledVector(axis, -vector.dot(axis)).normalize();
}

/** Returns a pose (Matrix4) from its position and its x and z axes. */
function poseOf(place, x, z) {
  return new THREE.Matrix4().makeBasis(x, z.clone().cross(x), z).setPosition(place);
}

/** Returns the pose (Matrix4) of a head [7] without its pitch and roll. */
function upright([x, y, z, ...turn]) {
  const ahead = new THREE.Vector3(1, 0, 0).applyQuaternion(new THREE.Quaternion(...turn));
  return new THREE.Matrix4().makeRotationZ(Math.atan2(ahead.y, ahead.x)).setPosition(x, y, z);
}

function matrix([x, y, z, ...turn]) {
  return new THREE.Matrix4().compose(
    new THREE.Vector3(x, y, z),
    new THREE.Quaternion(...turn).normalize(),
    new THREE.Vector3(1, 1, 1),
  );
}

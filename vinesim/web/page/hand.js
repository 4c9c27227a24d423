// The right hand of a person without a headset. It reaches to the point under the mouse, or for a tapped object.

import * as THREE from "./vendor/three.module.js";

/** Largest distance of a hand from the eyes [m]; then the hand's speed [m/s] and rate of turning [rad/s]. */
export const ARM = 0.75;
const REACH = 0.9,
  TURN = 3;
const NEAREST = 0.25; // m from the eyes
/** The hand approaches a tapped object from a point at most this far before it [m]; from below it would lift it. */
const APPROACH = 0.2;
/** Position of the hanging hand relative to the eyes: ahead, to the left, up [m]. */
const HANGING = [0.3, -0.2, -0.7];
/**
 * Direction from which a hand approaches its target, relative to the line of sight: to the left, up and about its own
 * axis [rad], and the share of that line's steepness. An empty hand approaches along the line. Blades approach from the
 * right and from below, or the hand would hide what they cut. GUESSED from pictures.
 */
const EMPTY = { left: 0, up: 0, roll: 0, steep: 1 },
  WITH_SHEARS = { left: 0.9, up: 0.35, roll: -0.8, steep: 0.5 };
/** Point between palm and fingers, in the palm's frame [m]. */
const GRASP = [0.06, 0, 0];
const FIST = [1, 1, 1, 1, 1],
  OPEN = [0, 0, 0, 0, 0];
/** A touch that moves less than this counts as a tap [px]. */
const STILL = 10;

export class Hand {
  /**
   * `gestures`: finger poses by name, which the digit keys select in this order. `mouth` [3]: point where shears cut, in
   * the palm's frame [m]. `tap(cursor)` is called for taps and clicks at a point of the picture.
   */
  constructor(element, gestures, mouth, tap) {
    this.mouth = mouth;
    this.withShears = false;
    this.held = "";
    this.fingers = null;
    this.reaching = this.closed = false;
    this.opensAfterCut = false;
    this.distance = 0.5; // m from the eyes, of the point under the cursor to which the hand reaches
    this.cursor = [0, 0]; // -1 to 1, right and up
    this.target = null; // the tapped object, as `pointAt` returns it
    this.kept = null; // Vector3 in the head's frame: the target at the time when the hand closed
    this.angles = { left: 0, up: 0, roll: 0 };
    this.listenToMouse(element);
    this.listenToTaps(element, tap);
    this.listenToKeys(Object.values(gestures));
    this.buttons = Object.fromEntries(["reach", "hold"].map((name) => [name, document.getElementById(name)]));
    this.buttons.reach.addEventListener("click", () => {
      this.toggleReach();
      this.buttons.reach.blur();
    });
    this.buttons.hold.addEventListener("click", () => {
      this.toggleHold();
      this.buttons.hold.blur();
    });
  }

  listenToMouse(element) {
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    const follow = (event) => {
      if (event.pointerType !== "mouse") return;
      this.cursor = cursorOf(event);
      if (event.buttons & 2) Object.assign(this, { reaching: true, target: null, closed: Boolean(event.buttons & 1) });
      else if (this.byMouse) this.reaching = this.closed = false;
      this.byMouse = Boolean(event.buttons & 2);
    };
    for (const name of ["pointerdown", "pointermove", "pointerup"]) element.addEventListener(name, follow);
    element.addEventListener("wheel", (event) => {
      if (this.reaching) this.distance = Math.min(Math.max(this.distance - event.deltaY / 2000, NEAREST), ARM);
    });
  }

  /** A tap with one finger, or a click with the left button. */
  listenToTaps(element, tap) {
    const down = new Map();
    let isTap = false;
    element.addEventListener("pointerdown", (event) => {
      isTap = down.size === 0 && event.button === 0;
      down.set(event.pointerId, [event.clientX, event.clientY]);
    });
    element.addEventListener("pointermove", (event) => {
      const from = down.get(event.pointerId);
      if (from && Math.hypot(event.clientX - from[0], event.clientY - from[1]) > STILL) isTap = false;
    });
    element.addEventListener("pointercancel", (event) => {
      down.delete(event.pointerId);
      isTap = false;
    });
    element.addEventListener("pointerup", (event) => {
      down.delete(event.pointerId);
      if (isTap && event.button === 0) tap(cursorOf(event));
      isTap = false;
    });
  }

  listenToKeys(poses) {
    addEventListener("keydown", (event) => {
      if (event.repeat) return;
      const pose = event.code.startsWith("Digit") ? poses[event.code.slice(5) - 1] : undefined;
      if (pose) this.fingers = this.fingers === pose ? null : pose;
      if (event.code === "KeyR") this.toggleReach();
      if (event.code === "Space" && event.target === document.body) this.toggleHold();
    });
  }

  /** Reach to the cursor, or let the arm hang. A hand that holds something keeps it. */
  toggleReach() {
    this.reaching = !this.reaching;
    this.target = null;
  }

  /** Grasp or release; with shears: cut and open again. */
  toggleHold() {
    this.closed = !this.closed;
    this.opensAfterCut = this.closed && this.withShears;
  }

  /** Reach for a point in the frame of its carrier, and follow the point until the hand closes. */
  reachFor(target) {
    Object.assign(this, { target, kept: null, reaching: true });
  }

  /** Called when a state reports that the shears have closed. */
  cut() {
    if (this.opensAfterCut) this.closed = this.opensAfterCut = false;
  }

  /** Show on the buttons the state of the hand, what it has `held` in the newest state, and with shears the wood that is
   * `between` the blades. */
  show(between, held) {
    this.held = held;
    const { reach, hold } = this.buttons;
    reach.setAttribute("aria-pressed", String(this.reaching));
    hold.setAttribute("aria-pressed", String(this.closed));
    const says = this.withShears
      ? `cut${between ? ` ${between}` : ""}`
      : this.closed
        ? held
          ? "let go"
          : "open"
        : "grasp";
    if (hold.lastElementChild.textContent !== says) hold.lastElementChild.textContent = says;
  }

  /** Target of the hand relative to the `eye` (Vector3), at most an arm's length away [m]. */
  aim(eye, head, ray, world) {
    if (this.target === null) return ray.clone().multiplyScalar(this.distance);
    const { carrier, at, name } = this.target;
    if (this.kept === null || (!this.closed && world.nameOf(carrier) === name))
      this.kept = world.beyond(carrier, at).sub(eye).clampLength(0, ARM).applyQuaternion(head.clone().conjugate());
    return this.kept.clone().applyQuaternion(head);
  }

  /** Move `place` back along `ahead`; the nearer the hand is to the line of its approach, the less. */
  stopBefore(place, ahead) {
    if (!this.offset) return;
    const way = place.clone().sub(this.offset),
      beside = way.addScaledVector(ahead, -way.dot(ahead)).length();
    place.addScaledVector(ahead, -Math.min(APPROACH, 2 * beside));
  }

  /**
   * The tracked hand for the page's message, a time [s] after the last one. It moves at the speed of an arm. `pose` [7]
   * and `yaw`: of the head; `ray` (Vector3): direction of the cursor from the eyes.
   */
  tracked(pose, yaw, ray, world, seconds) {
    const eye = new THREE.Vector3(...pose.slice(0, 3)),
      head = new THREE.Quaternion(...pose.slice(3));
    const goal = { left: 0, up: 0, roll: 0 },
      place = new THREE.Vector3();
    if (this.reaching) {
      const aim = this.aim(eye, head, ray, world),
        hold = this.withShears ? WITH_SHEARS : EMPTY;
      goal.left = wrapped(Math.atan2(aim.y, aim.x) - yaw + hold.left);
      goal.up = hold.up + hold.steep * Math.atan2(aim.z, Math.hypot(aim.x, aim.y));
      goal.roll = hold.roll;
      const turn = turnOf(goal, yaw);
      place
        .set(...(this.withShears ? this.mouth : GRASP))
        .applyQuaternion(turn)
        .negate()
        .add(aim);
      if (this.target !== null && !this.closed)
        this.stopBefore(place, new THREE.Vector3(1, 0, 0).applyQuaternion(turn));
    } else place.set(...HANGING).applyAxisAngle(new THREE.Vector3(0, 0, 1), yaw);
    for (const [name, angle] of Object.entries(goal)) {
      const way = name === "left" ? wrapped(angle - this.angles.left) : angle - this.angles[name];
      this.angles[name] += Math.min(Math.max(way, -TURN * seconds), TURN * seconds);
    }
    this.offset ??= place.clone();
    const way = place.sub(this.offset);
    this.offset.addScaledVector(way, Math.min(1, (REACH * seconds) / Math.max(way.length(), 1e-6)));
    return {
      pose: [...this.offset.clone().add(eye), ...turnOf(this.angles, yaw)],
      closed: this.closed,
      fingers: this.fingers ?? (this.closed ? FIST : OPEN),
    };
  }
}

/** Quaternion from angles to the left of a `yaw`, up, and about the hand's own axis. */
function turnOf({ left, up, roll }, yaw) {
  return new THREE.Quaternion().setFromEuler(new THREE.Euler(roll, -up, yaw + left, "ZYX"));
}

/** An angle wrapped to -pi to pi. */
const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

/** Position in the picture: -1 to 1, right and up. */
const cursorOf = (event) => [(2 * event.clientX) / innerWidth - 1, 1 - (2 * event.clientY) / innerHeight];

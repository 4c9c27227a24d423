// A person without a headset: walks by keys, looks and reaches by the mouse.

import { FlyingEyes } from "./fly.js";

const WALK = 1.4, CROUCH = 0.55, ARM = 0.75, REACH = 0.9; // m/s, m, m, m/s
/** Where the hand hangs, from the eyes: ahead, to the left, up [m]. */
const HANGING = [0.3, -0.2, -0.7];
const FIST = [1, 1, 1, 1, 1], OPEN = [0, 0, 0, 0, 0];

/**
 * A person walks and reaches in the world's time: where the client is slower than real time, or pauses, so is the person,
 * and hands stay as fast in the world as an arm is.
 */
export class Pace {
  /** `most` [s]: of the world's time that may be made up for. */
  constructor(most) {
    this.most = this.left = most;
    this.time = null;
  }

  /** A state of a time of the world [s] has come. */
  earn(time) {
    const passed = this.time === null ? 0 : time - this.time;
    this.time = time;
    this.left = passed < 0 ? this.most : Math.min(this.left + passed, this.most);
  }

  /** Of the time [s] since the last picture, that in which the person moves. */
  spend(passed) {
    const seconds = Math.min(passed, this.left);
    this.left -= seconds;
    return seconds;
  }
}

/** Eyes at the height of a person who walks. */
export class WalkingEyes extends FlyingEyes {
  constructor(element, pose) {
    super(element, pose);
    this.height = pose[2];
    this.speed = WALK;
    this.crouch = 0;
  }

  move(ahead, left) {
    const c = Math.cos(this.yaw), s = Math.sin(this.yaw);
    this.place[0] += ahead * c - left * s;
    this.place[1] += ahead * s + left * c;
  }

  update(seconds) {
    const goal = this.held.has("KeyQ") ? CROUCH : 0;
    this.crouch += Math.min(Math.max(goal - this.crouch, -1.5 * seconds), 1.5 * seconds);
    this.place[2] = this.height - this.crouch;
    this.speed = WALK;
    return super.update(seconds);
  }
}

/** The right hand of a person at a desk: it reaches to where the cursor points. */
export class DeskHand {
  /** `gestures`: finger poses by name; the digits make them, in their order. */
  constructor(element, gestures) {
    this.fingers = null;
    const poses = Object.values(gestures);
    addEventListener("keydown", (event) => {
      const pose = event.code.startsWith("Digit") ? poses[event.code.slice(5) - 1] : undefined;
      if (pose) this.fingers = this.fingers === pose ? null : pose;
    });
    this.reaching = this.closed = false;
    this.distance = 0.5; // m from the eyes
    this.cursor = [0, 0]; // -1 to 1, right and up
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    const buttons = (event) => {
      this.cursor = [2 * event.clientX / innerWidth - 1, 1 - 2 * event.clientY / innerHeight];
      if (event.pointerType !== "mouse") return;
      if (event.buttons & 2) { this.reaching = true; this.closed = Boolean(event.buttons & 1); }
      else if (this.byMouse) this.reaching = this.closed = false;
      this.byMouse = Boolean(event.buttons & 2);
    };
    for (const name of ["pointerdown", "pointermove", "pointerup"]) element.addEventListener(name, buttons);
    element.addEventListener("wheel", (event) => {
      if (this.reaching) this.distance = Math.min(Math.max(this.distance - event.deltaY / 2000, 0.25), ARM);
    });
    addEventListener("keydown", (event) => {
      if (event.code === "KeyR" && !event.repeat) { this.reaching = !this.reaching; this.closed = false; }
      if (event.code === "Space" && !event.repeat && this.reaching) this.closed = !this.closed;
    });
  }

  /**
   * The tracked hand for the page's message, a time [s] after the last one: it moves at the speed of an arm.
   * `ray` is the direction [3] of the cursor from the `eye` [3], `yaw` that of the head.
   */
  tracked(eye, ray, yaw, seconds) {
    const c = Math.cos(yaw), s = Math.sin(yaw), [x, y, z] = HANGING;
    const goal = this.reaching ? ray.map((value) => this.distance * value) : [c * x - s * y, s * x + c * y, z];
    this.offset ??= goal;
    const way = goal.map((value, axis) => value - this.offset[axis]), length = Math.hypot(...way);
    const share = Math.min(1, REACH * seconds / Math.max(length, 1e-6));
    this.offset = this.offset.map((value, axis) => value + share * way[axis]);
    const pitch = this.reaching ? Math.asin(Math.min(Math.max(ray[2], -1), 1)) : 0;
    const heading = this.reaching ? Math.atan2(ray[1], ray[0]) : yaw;
    const [cy, sy, cp, sp] = [Math.cos(heading / 2), Math.sin(heading / 2), Math.cos(pitch / 2), Math.sin(-pitch / 2)];
    const place = this.offset.map((value, axis) => eye[axis] + value);
    return { pose: [...place, -sy * sp, cy * sp, sy * cp, cy * cp], closed: this.closed,
      fingers: this.fingers ?? (this.closed ? FIST : OPEN) };
  }
}

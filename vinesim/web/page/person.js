// A person without a headset walks in the world's time, by keys or by two fingers.

import { FlyingEyes } from "./fly.js";

const WALK = 1.4,
  CROUCH = 0.55; // m/s, m
const LONGEST_WISH = 1; // m that fingers may request in advance

/**
 * A person walks and reaches in the world's time. If the client is slower than real time or pauses, so does the person,
 * so that hands have the speed of an arm in the world.
 */
export class Pace {
  /** `most` [s]: largest world time that the person may catch up. */
  constructor(most) {
    this.most = this.left = most;
    this.time = null;
  }

  /** Called when a state of a world time [s] has arrived. */
  earn(time) {
    const passed = this.time === null ? 0 : time - this.time;
    this.time = time;
    this.left = passed < 0 ? this.most : Math.min(this.left + passed, this.most);
  }

  /** Returns the part of the time since the last picture in which the person moves [s]. */
  spend(passed) {
    const seconds = Math.min(passed, this.left);
    this.left -= seconds;
    return seconds;
  }
}

/** Viewpoint of a walking person. */
export class WalkingEyes extends FlyingEyes {
  /** `floor(x, y)` returns the height of the ground [m]. */
  constructor(element, pose, floor) {
    super(element, pose);
    this.floor = floor;
    this.height = pose[2] - floor(pose[0], pose[1]);
    this.speed = WALK;
    this.crouch = 0;
    this.wish = [0, 0]; // m ahead and to the left that fingers have requested and the person has not walked yet
  }

  /** Limit the motion, because fingers may be faster than a person. */
  push(ahead, left) {
    const wish = [this.wish[0] + ahead, this.wish[1] + left],
      length = Math.hypot(...wish);
    this.wish = wish.map((value) => value * Math.min(1, LONGEST_WISH / Math.max(length, 1e-9)));
  }

  move(ahead, left) {
    const c = Math.cos(this.yaw),
      s = Math.sin(this.yaw);
    this.place[0] += ahead * c - left * s;
    this.place[1] += ahead * s + left * c;
  }

  update(seconds) {
    const goal = this.held.has("KeyQ") ? CROUCH : 0;
    this.crouch += Math.min(Math.max(goal - this.crouch, -1.5 * seconds), 1.5 * seconds);
    this.place[2] = this.floor(this.place[0], this.place[1]) + this.height - this.crouch;
    this.speed = WALK;
    const share = Math.min(1, (WALK * seconds) / Math.max(Math.hypot(...this.wish), 1e-9));
    const [ahead, left] = this.wish;
    this.wish = [(1 - share) * ahead, (1 - share) * left];
    this.move(share * ahead, share * left);
    return super.update(seconds);
  }
}

// A flying viewpoint, moved by keys, mouse, touch and gamepad. Angles: yaw about the world's z, pitch about the side.

const KEYS = {
  KeyW: [0, 1],
  ArrowUp: [0, 1],
  KeyS: [0, -1],
  ArrowDown: [0, -1],
  KeyA: [1, 1],
  ArrowLeft: [1, 1],
  KeyD: [1, -1],
  ArrowRight: [1, -1],
  KeyE: [2, 1],
  KeyQ: [2, -1],
};
/** Smallest deflection of a stick that counts, as a share of its range. */
const REST = 0.15;
/** Numbers of buttons of a gamepad with the standard mapping. */
const LEFT_TRIGGER = 6,
  RIGHT_TRIGGER = 7;
/** Angles of the eyes to the side of the line behind a followed actor, in order of preference [rad]; height of the point
 * that the eyes look at [m]. */
const SIDES = [0.6, -0.6, 0.4, -0.4, 0.2, -0.2],
  AIM = 1.1;
/** A chosen angle is kept until the target has moved this far [m] or turned by twice the angle with this sine. */
const FAR = 1,
  HALF_TURN = 0.25,
  NOTHING = { at: [NaN, NaN], turned: 0, side: SIDES[0] };
const TURN = 1.8,
  NOD = 1.4; // rad/s of a stick that is pushed all the way

export class FlyingEyes {
  constructor(element, pose) {
    this.place = [pose[0], pose[1], pose[2]];
    const [x, y, z, w] = pose.slice(3);
    this.yaw = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    this.pitch = 0;
    this.speed = 1.5; // m/s
    this.followed = NOTHING;
    this.held = new Set();
    this.fingers = new Map();
    addEventListener("keydown", (event) => {
      if (event.code in KEYS) this.held.add(event.code);
    });
    addEventListener("keyup", (event) => this.held.delete(event.code));
    addEventListener("blur", () => this.held.clear());
    element.addEventListener("pointerdown", (event) => {
      this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
      element.setPointerCapture(event.pointerId);
    });
    const up = (event) => this.fingers.delete(event.pointerId);
    element.addEventListener("pointerup", up);
    element.addEventListener("pointercancel", up);
    element.addEventListener("pointermove", (event) => this.drag(event));
    element.addEventListener(
      "wheel",
      (event) => {
        this.speed = Math.min(Math.max(this.speed * Math.exp(-event.deltaY / 600), 0.1), 30);
        event.preventDefault();
      },
      { passive: false },
    );
  }

  /** One finger looks, two fingers fly. */
  drag(event) {
    const last = this.fingers.get(event.pointerId);
    if (!last) return;
    const dx = event.clientX - last[0],
      dy = event.clientY - last[1];
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.fingers.size > 1) this.push(-0.004 * dy * this.speed, 0.004 * dx * this.speed);
    else this.look(0.0035 * dx, 0.0035 * dy);
  }

  /** Move by a gesture of two fingers [m]. */
  push(ahead, left) {
    this.move(ahead, left, 0);
  }

  look(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(Math.max(this.pitch + pitch, -1.5), 1.5);
  }

  /** Move [m] along where the eyes look, to their left, and up. */
  move(ahead, left, up) {
    const c = Math.cos(this.yaw),
      s = Math.sin(this.yaw),
      level = Math.cos(this.pitch);
    this.place[0] += ahead * c * level - left * s;
    this.place[1] += ahead * s * level + left * c;
    this.place[2] = Math.min(Math.max(this.place[2] + ahead * Math.sin(this.pitch) + up, 0.1), 200);
  }

  /** Apply keys and gamepad for a time [s]. Returns whether the viewpoint has moved. */
  update(seconds) {
    const way = [0, 0, 0];
    for (const code of this.held) way[KEYS[code][0]] += KEYS[code][1];
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad?.connected) continue; // some browsers keep a disconnected gamepad, with its last axes
      const { ahead, left, up, turn, nod } = wishOf(pad);
      [ahead, left, up].forEach((value, axis) => {
        way[axis] += value;
      });
      this.look(turn * TURN * seconds, nod * NOD * seconds);
    }
    if (!way.some((value) => value !== 0)) return false;
    this.move(...way.map((value) => value * this.speed * seconds));
    return true;
  }

  /**
   * Look at a point from a distance, over the shoulder. Of several sides the one with the fewest objects in between is
   * chosen, which `between(eye, point)` counts. The side is chosen again when the point has moved far or turned.
   */
  follow(point, heading, between, distance = 3.2) {
    const behind = (side) => [
      point[0] - distance * Math.cos(heading + side),
      point[1] - distance * Math.sin(heading + side),
      1.6,
    ];
    const { at, turned } = this.followed;
    const way = Math.hypot(point[0] - at[0], point[1] - at[1]),
      turn = Math.abs(Math.sin((heading - turned) / 2));
    if (!(way < FAR) || turn > HALF_TURN) {
      const target = [point[0], point[1], AIM],
        counts = SIDES.map((angle) => between(behind(angle), target));
      this.followed = { at: [...point], turned: heading, side: SIDES[counts.indexOf(Math.min(...counts))] };
    }
    const goal = behind(this.followed.side);
    for (let axis = 0; axis < 3; ++axis) this.place[axis] += 0.06 * (goal[axis] - this.place[axis]);
    const ahead = [point[0] - this.place[0], point[1] - this.place[1], AIM - this.place[2]];
    this.yaw = Math.atan2(ahead[1], ahead[0]);
    this.pitch = Math.atan2(ahead[2], Math.hypot(ahead[0], ahead[1]));
  }

  /** Pose [7] m, 1 in the world: x forward, z up. */
  get pose() {
    const [cy, sy] = [Math.cos(this.yaw / 2), Math.sin(this.yaw / 2)];
    const [cp, sp] = [Math.cos(-this.pitch / 2), Math.sin(-this.pitch / 2)];
    return [...this.place, -sy * sp, cy * sp, sy * cp, cy * cp];
  }
}

/**
 * Commands of a gamepad from -1 to 1: sticks move and turn, triggers sink and rise. The meaning of axes is known only for
 * the standard mapping. Of other pads only the first two axes are used, because a trigger at rest may be an axis at -1.
 */
function wishOf({ axes, buttons, mapping }) {
  const isStandard = mapping === "standard",
    axis = (k) => (isStandard || k < 2 ? beyondRest(axes[k] ?? 0) : 0);
  const trigger = (k) => (isStandard ? beyondRest(buttons[k]?.value ?? 0) : 0);
  return {
    ahead: -axis(1),
    left: -axis(0),
    up: trigger(RIGHT_TRIGGER) - trigger(LEFT_TRIGGER),
    turn: -axis(2),
    nod: -axis(3),
  };
}

/** Deflection of a stick or trigger beyond its rest zone, as a share; it increases slowly at first. */
function beyondRest(value) {
  return (Math.sign(value) * Math.max(Math.abs(value) - REST, 0)) / (1 - REST);
}

// Eyes that fly: keys, mouse, touch and gamepad. Angles about the world's z (yaw) and to the side (pitch).

const KEYS = { KeyW: [0, 1], ArrowUp: [0, 1], KeyS: [0, -1], ArrowDown: [0, -1], KeyA: [1, 1], ArrowLeft: [1, 1],
  KeyD: [1, -1], ArrowRight: [1, -1], KeyE: [2, 1], KeyQ: [2, -1] };

export class FlyingEyes {
  constructor(element, pose) {
    this.place = [pose[0], pose[1], pose[2]];
    const [x, y, z, w] = pose.slice(3);
    this.yaw = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    this.pitch = 0;
    this.speed = 1.5; // m/s
    this.held = new Set();
    this.fingers = new Map();
    addEventListener("keydown", (event) => { if (event.code in KEYS) this.held.add(event.code); });
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
    element.addEventListener("wheel", (event) => {
      this.speed = Math.min(Math.max(this.speed * Math.exp(-event.deltaY / 600), 0.1), 30);
      event.preventDefault();
    }, { passive: false });
  }

  /** One finger looks, two fingers fly. */
  drag(event) {
    const last = this.fingers.get(event.pointerId);
    if (!last) return;
    const dx = event.clientX - last[0], dy = event.clientY - last[1];
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.fingers.size > 1) this.push(-0.004 * dy * this.speed, 0.004 * dx * this.speed);
    else this.look(0.0035 * dx, 0.0035 * dy);
  }

  /** Two fingers ask to move [m]. */
  push(ahead, left) { this.move(ahead, left, 0); }

  look(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(Math.max(this.pitch + pitch, -1.5), 1.5);
  }

  /** Move [m] along where the eyes look, to their left, and up. */
  move(ahead, left, up) {
    const c = Math.cos(this.yaw), s = Math.sin(this.yaw), level = Math.cos(this.pitch);
    this.place[0] += ahead * c * level - left * s;
    this.place[1] += ahead * s * level + left * c;
    this.place[2] = Math.min(Math.max(this.place[2] + ahead * Math.sin(this.pitch) + up, 0.1), 200);
  }

  /** Apply keys and gamepad for a time [s]; whether the user has moved. */
  update(seconds) {
    const way = [0, 0, 0];
    for (const code of this.held) way[KEYS[code][0]] += KEYS[code][1];
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad) continue;
      const [x, y, turn, nod] = pad.axes.map((value) => Math.abs(value) < 0.15 ? 0 : value);
      way[0] -= y ?? 0;
      way[1] -= x ?? 0;
      this.look(-(turn ?? 0) * 1.8 * seconds, -(nod ?? 0) * 1.4 * seconds);
    }
    if (!way.some((value) => value !== 0)) return false;
    this.move(...way.map((value) => value * this.speed * seconds));
    return true;
  }

  /** Look at a point from a distance, over the shoulder. */
  follow(point, heading, distance = 3.2) {
    const side = heading + 0.6;
    const goal = [point[0] - distance * Math.cos(side), point[1] - distance * Math.sin(side), 1.6];
    for (let axis = 0; axis < 3; ++axis) this.place[axis] += 0.06 * (goal[axis] - this.place[axis]);
    const ahead = [point[0] - this.place[0], point[1] - this.place[1], 1.1 - this.place[2]];
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

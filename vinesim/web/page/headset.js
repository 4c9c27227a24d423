// A person in a headset: WebXR poses of head and controllers, sticks to walk and turn, haptic pulses.

import * as THREE from "./vendor/three.module.js";
import { Detail, PIXELS } from "./rate.js";

const WALK = 1.4,
  TURN = Math.PI / 6,
  DEAD = 0.25; // m/s, rad, share of a stick's way
const HALF = Math.SQRT1_2;
/** From the browser's axes (y up) to the world's (z up). */
const UPRIGHT = new THREE.Quaternion(HALF, 0, 0, HALF);
/** From an eye or a pointing ray of WebXR (along -z, y up) to x forward, z up. */
const FORWARD = new THREE.Quaternion(-0.5, 0.5, 0.5, 0.5);

const FINGERS = ["thumb", "index-finger", "middle-finger", "ring-finger", "pinky-finger"];
/** Angles [rad] between the first and the last bone of a finger that is bent all the way; the thumb has one joint less. */
const FULL_BEND = [1.6, 3.8, 3.8, 3.8, 3.8];
const AIM = 0.7,
  FARTHEST = 8,
  FLATTEST = 0.1; // share of a stick's way; m; how steep a ray to the floor is at least
const CLICK = [0.3, 30]; // amplitude and ms of the pulse for a choice
const RATE = 72; // Hz, for a display that does not report its rate
const STICK = 3; // number of the button under a stick, by the standard mapping of WebXR
const PINCH = 0.025,
  CLOSED = 0.5; // m between the tips, mean bend of the fingers
/** Range of distances below the eyes, and distance beside them, at which a palm is at the hip [m]. GUESSED. */
const HIP = { above: 0.45, below: 0.9, beside: 0.3 };

export class Headset {
  /**
   * `rig` carries camera and controllers: the floor that the person stands on. `poses`: finger poses of the buttons a
   * and b; `press(side)` is called when a stick is pressed, or a hand without a controller closes at the hip;
   * `choose()` when the right stick is pulled back; `floor(x, y)` returns the height of the ground [m].
   */
  constructor(renderer, rig, camera, poses, press, choose, floor) {
    this.poses = poses;
    this.floor = floor;
    this.press = press;
    this.choose = choose;
    this.wrist = new THREE.Group(); // goes with the left hand
    this.pulled = false;
    this.mark = new THREE.Mesh(
      new THREE.RingGeometry(0.18, 0.22, 32).rotateX(-Math.PI / 2), // marks the place to which a jump leads
      new THREE.MeshBasicMaterial({ color: 0x30c060, depthTest: false, transparent: true, toneMapped: false }),
    );
    this.mark.visible = false;
    this.pressed = [false, false];
    this.renderer = renderer;
    this.rig = rig;
    this.turned = false;
    this.viewer = new THREE.Matrix4(); // between the eyes, on the rig
    this.scale = new Detail(PIXELS);
    renderer.xr.enabled = true;
    renderer.xr.addEventListener("sessionend", () => {
      this.mark.visible = false;
    });
    renderer.xr.setReferenceSpaceType("local-floor");
    rig.add(camera);
    this.rays = [0, 1].map((k) => rig.add(renderer.xr.getController(k)) && renderer.xr.getController(k));
    this.sources = [null, null];
    this.tracked = [null, null]; // hands without a controller, on the rig
    this.closed = [false, false]; // in the last frame
    this.closedAtHip = [false, false]; // and not opened since
    this.rays.forEach((ray, k) => {
      ray.addEventListener("connected", (event) => {
        this.sources[k] = event.data;
        if (event.data.handedness === "left") ray.add(this.wrist);
      });
      ray.addEventListener("disconnected", () => {
        this.sources[k] = null;
      });
    });
  }

  get isWorn() {
    return this.renderer.xr.isPresenting;
  }

  /** Ask the browser for the headset; called by a click. */
  async enter(place, yaw) {
    const session = await navigator.xr.requestSession("immersive-vr", {
      requiredFeatures: ["local-floor"],
      optionalFeatures: ["hand-tracking"],
    });
    this.rig.position.set(place[0], this.floor(place[0], place[1]), -place[1]);
    this.rig.rotation.y = yaw - Math.PI / 2;
    await this.renderer.xr.setSession(session);
  }

  /**
   * Handle one XRFrame, a time `passed` after the last one, in which the person may move for `seconds`. It updates the
   * head and the number of pixels of the next picture. Sticks: the left one walks where the head looks. The right one
   * turns by 30 degrees to a side, opens the list when pulled back, and marks a place on the floor when pushed ahead;
   * releasing it jumps there.
   */
  update(frame, seconds, passed) {
    const viewer = frame?.getViewerPose(this.renderer.xr.getReferenceSpace());
    if (viewer) {
      this.viewer.fromArray(viewer.transform.matrix);
      this.scale.add(passed, frame.session.frameRate || RATE);
      for (const view of viewer.views) view.requestViewportScale?.(this.scale.value); // of the next picture
    }
    this.tracked = this.sources.map((source) => this.trackHand(frame, source?.hand));
    this.tracked.forEach((seen, k) => {
      if (seen !== null) this.takeFromHip(seen, k);
    });
    this.sources.forEach((source, k) => {
      const pressed = source?.gamepad?.buttons?.[STICK]?.pressed ?? false;
      if (pressed && !this.pressed[k]) this.press(source.handedness);
      this.pressed[k] = pressed;
    });
    this.sources.forEach((source, k) => {
      const [x, y] = source?.gamepad?.axes?.slice(-2) ?? [0, 0];
      if (source?.handedness === "left" && Math.hypot(x, y) > DEAD) {
        const [c, s] = this.heading();
        this.rig.position.x += WALK * seconds * (-y * c + x * s);
        this.rig.position.z -= WALK * seconds * (-y * s - x * c);
        this.stand();
      }
      if (source?.handedness === "right") {
        if (y < -AIM || (this.mark.visible && y < -DEAD)) this.aim(this.rays[k]);
        else if (this.mark.visible) this.jump();
        if (Math.abs(x) > AIM && !this.turned) this.turn(-Math.sign(x) * TURN);
        this.turned = Math.abs(x) > AIM || (this.turned && Math.abs(x) > DEAD);
        if (y > AIM && !this.pulled) {
          this.choose();
          source.gamepad.hapticActuators?.[0]?.pulse(...CLICK);
        }
        this.pulled = y > AIM || (this.pulled && y > DEAD);
      }
    });
  }

  /** Mark where the `ray` of a controller meets the floor, if that is near enough to jump there. */
  aim(ray) {
    const from = new THREE.Vector3().setFromMatrixPosition(ray.matrixWorld);
    const way = new THREE.Vector3(0, 0, -1).transformDirection(ray.matrixWorld);
    const distance = way.y < -FLATTEST ? (this.rig.position.y - from.y) / way.y : Infinity;
    this.mark.visible = distance < FARTHEST;
    if (this.mark.visible) this.mark.position.copy(from).addScaledVector(way, distance);
  }

  /** Move the floor so that the head is above the mark. */
  jump() {
    const head = new THREE.Vector3().setFromMatrixPosition(this.viewer).applyMatrix4(this.rig.matrixWorld);
    this.rig.position.add(this.mark.position).sub(head);
    this.stand();
    this.mark.visible = false;
  }

  /** Put the floor at the height of the ground below the head. */
  stand() {
    const [x, y] = this.head();
    this.rig.position.y = this.floor(x, y);
  }

  /** Returns a hand that the headset tracks: palm on the rig, bend of each finger, whether it is closed; null: not tracked. */
  trackHand(frame, hand) {
    if (!frame?.getJointPose || !hand) return null;
    const space = this.renderer.xr.getReferenceSpace();
    const joint = (name) => hand.get(name) && frame.getJointPose(hand.get(name), space)?.transform;
    const place = (name) => {
      const at = joint(name)?.position;
      return at && new THREE.Vector3(at.x, at.y, at.z);
    };
    const knuckle = place("middle-finger-phalanx-proximal"),
      palm = joint("middle-finger-metacarpal");
    if (!knuckle || !palm) return null;
    const fingers = FINGERS.map((finger, k) => {
      const bones =
        k === 0
          ? ["metacarpal", "phalanx-proximal", "phalanx-distal", "tip"]
          : ["metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip"];
      const points = bones.map((bone) => place(`${finger}-${bone}`));
      if (points.includes(undefined)) return 0;
      const ways = points.slice(1).map((point, i) => point.clone().sub(points[i]).normalize());
      const bend = ways
        .slice(1)
        .reduce((sum, way, i) => sum + Math.acos(Math.min(Math.max(way.dot(ways[i]), -1), 1)), 0);
      return Math.min(bend / FULL_BEND[k], 1);
    });
    const gap = place("thumb-tip")?.distanceTo(place("index-finger-tip") ?? knuckle) ?? 1;
    const closed = gap < PINCH || fingers.slice(1).reduce((sum, bend) => sum + bend, 0) / 4 > CLOSED;
    const matrix = new THREE.Matrix4().fromArray(palm.matrix);
    matrix.setPosition(new THREE.Vector3().setFromMatrixPosition(matrix).lerp(knuckle, 0.5));
    return { matrix, fingers, closed };
  }

  /** Handle a hand without a controller that closes at the hip: it presses, and holds nothing until it opens again. */
  takeFromHip(seen, k) {
    const way = new THREE.Vector3()
      .setFromMatrixPosition(seen.matrix)
      .sub(new THREE.Vector3().setFromMatrixPosition(this.viewer));
    const isAtHip = -way.y > HIP.above && -way.y < HIP.below && Math.hypot(way.x, way.z) < HIP.beside;
    const closes = seen.closed && !this.closed[k];
    this.closed[k] = seen.closed;
    if (closes && isAtHip) this.press(this.sources[k].handedness);
    this.closedAtHip[k] = seen.closed && (this.closedAtHip[k] || (closes && isAtHip));
    if (this.closedAtHip[k]) seen.closed = false;
  }

  /** Cosine and sine of the head's yaw about the world's z. */
  heading() {
    const [, , , x, y, z, w] = this.head();
    const yaw = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    return [Math.cos(yaw), Math.sin(yaw)];
  }

  /** Turn the floor about the head. */
  turn(angle) {
    const head = new THREE.Vector3().setFromMatrixPosition(this.viewer).applyMatrix4(this.rig.matrixWorld);
    this.rig.position
      .sub(head)
      .applyAxisAngle(new THREE.Vector3(0, 1, 0), angle)
      .add(head);
    this.rig.rotation.y += angle;
  }

  /** Pose [7] m, 1 of the head in the world. */
  head() {
    this.rig.updateMatrixWorld();
    return worldPose(new THREE.Matrix4().multiplyMatrices(this.rig.matrixWorld, this.viewer));
  }

  /** Tracked hands by side, for the page's message. */
  hands() {
    const hands = { left: null, right: null };
    this.sources.forEach((source, k) => {
      if (!source || !(source.handedness in hands)) return;
      const seen = this.tracked[k];
      if (seen !== null) {
        const pose = worldPose(new THREE.Matrix4().multiplyMatrices(this.rig.matrixWorld, seen.matrix));
        hands[source.handedness] = { pose, closed: seen.closed, fingers: seen.fingers };
        return;
      }
      if (source.hand) return; // not tracked now: the hand hangs down
      const buttons = source.gamepad?.buttons ?? [],
        trigger = buttons[0]?.value ?? 0,
        grip = buttons[1]?.value ?? 0;
      const own = buttons[4]?.pressed ? this.poses.a : buttons[5]?.pressed ? this.poses.b : undefined;
      const thumb = buttons.slice(3).some((button) => button.touched) || grip > 0.8 ? 1 : 0;
      hands[source.handedness] = {
        pose: worldPose(this.rays[k].matrixWorld),
        closed: grip > 0.5 || trigger > 0.5,
        fingers: own ?? [thumb, trigger, grip, grip, grip],
      };
    });
    return hands;
  }

  /** Let controllers vibrate: amplitude 0 to 1 and duration [s] by side. */
  pulse(haptics) {
    for (const source of this.sources) {
      const [amplitude, duration] = haptics[source?.handedness] ?? [0, 0];
      if (amplitude > 0) source.gamepad?.hapticActuators?.[0]?.pulse(amplitude, 1000 * duration);
    }
  }
}

/** Returns the pose [7] in the world of an object that looks along -z with y up in the browser's axes. */
function worldPose(matrix) {
  const place = new THREE.Vector3(),
    turn = new THREE.Quaternion(),
    scale = new THREE.Vector3();
  matrix.decompose(place, turn, scale);
  turn.premultiply(UPRIGHT).multiply(FORWARD);
  return [place.x, -place.z, place.y, turn.x, turn.y, turn.z, turn.w];
}

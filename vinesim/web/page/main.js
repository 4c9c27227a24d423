// The page: loads the vineyard and follows its states. A spectator flies; a person walks, reaches and may wear a headset.

import * as THREE from "./vendor/three.module.js";
import { pointAt } from "./aim.js";
import { decode, load, socketAddress } from "./arrays.js";
import { FlyingEyes } from "./fly.js";
import { Guide } from "./guide.js";
import { ARM, Hand } from "./hand.js";
import { Handwork } from "./handwork.js";
import { Headset } from "./headset.js";
import { Absence, isUnusual, say } from "./notices.js";
import { Overlays } from "./overlays.js";
import { LateHands } from "./late_latching.js";
import { Pace, WalkingEyes } from "./person.js";
import { Detail, FirstPictures, SLOW_PIXELS, TRIANGLES } from "./rate.js";
import { Shears } from "./shears.js";
import { Timeline } from "./timeline.js";
import { Voice } from "./voice.js";
import { TRIANGLE_BUDGET, World } from "./world.js";
import { Wrist } from "./wrist.js";

const RETRY = 1000; // ms
const SILENCE = 3; // s
const SHADOW_PERIOD = 250,
  SHADOW_PICTURES = 4; // the shadow map is drawn again after this time [ms] and this number of pictures
const LONGEST = 0.1; // s: longest time by which the keys move the viewpoint in one picture
const FINGER = 22; // px: a tap within this distance of a thing selects it
/** Rotation of the view after which the list of visible plants is rebuilt [rad]. For a headset: half the diagonal field
 * of view, this rotation, and the angle of one pixel of the finest displays [rad]. */
const TURN = 0.35,
  IN_HEADSET = { field: 1.2, turn: 0.7, pixel: 7e-4 };
const FARTHEST = 3; // m: the hand ignores tapped objects that are further away
// sizes of the names of distant and near actors [px], distance of near ones and gap above heads [m]
const NAME = { far: 11, near: 16, from: 2, gap: 0.04 };
/** A browser whose first pictures have a median rate below SLOW [Hz] then draws less: FEW triangles (as a share
 * of a phone's) and at most FEW_PIXELS; their number is adapted, so that pictures seldom take more than 1.4 periods of
 * FEW_RATE [Hz]. A browser without a graphics card does so from the start. */
const SLOW = 5,
  FIRST_PICTURES = 12,
  FEW = 0.2,
  FEW_PIXELS = 250_000,
  FEW_RATE = 14;
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
/** Rate of pictures on a screen to which the number of triangles is adapted [Hz]. */
const RATE = 60;
const TOO_SLOW = "This browser draws slowly, perhaps without its graphics card: pictures are coarser.";
const NOBODY =
  "Nobody else is here yet: a client sees the people and robots of the server that it joined by --connect.";
const WATCHES = "Another page controls the person; this one watches.";
const RELEASED =
  "The page that controlled the person was closed: the person stands still until you load this page again.";
const element = (id) => document.getElementById(id);

/** Returns a number in the page's address (triangles, rate or shadows), null if it is missing. */
const asked = (name) => {
  const given = new URLSearchParams(location.search).get(name);
  return given === null ? null : Number(given);
};

/** Counters of the page for tests and tools. */
const page = {
  states: 0,
  drawn: 0,
  tick: -1,
  frames: 0,
  calls: 0,
  triangles: 0,
  haptics: {},
  failure: null,
};
window.vinesim = page;

class Viewer {
  constructor(world, start) {
    this.world = world;
    this.detail = asked("triangles") === null && asked("rate") === null ? new Detail(TRIANGLES) : null; // null: fixed
    this.isSlow = this.detail !== null && SOFTWARE.test(graphicsCard());
    this.renderer = new THREE.WebGLRenderer({
      canvas: element("view"),
      antialias: !this.isSlow,
      powerPreference: "high-performance",
    });
    this.renderer.info.autoReset = false;
    this.scene = new THREE.Scene();
    this.scene.add(world.group);
    this.camera = new THREE.PerspectiveCamera(60, 1, 0.03, 500);
    this.isPerson = world.header.person !== null;
    const floor = (x, y) => world.terrain.height(x, y);
    this.eyes = new (this.isPerson ? WalkingEyes : FlyingEyes)(this.renderer.domElement, start, floor);
    const { mouth, gestures } = world.header;
    this.hand = this.isPerson
      ? new Hand(this.renderer.domElement, gestures, mouth, (cursor) => this.reach(cursor))
      : null;
    this.rig = new THREE.Group();
    this.scene.add(this.rig);
    this.shears = new Shears(mouth, world.group);
    this.handwork = new Handwork(this.isPerson);
    this.headset = new Headset(
      this.renderer,
      this.rig,
      this.camera,
      world.header.buttons,
      (side) => this.shears.toggle(side),
      () => this.indicate(this.wrist.after(this.intention)),
      floor,
    );
    this.scene.add(this.headset.mark);
    this.wrist = new Wrist(this.headset.wrist, world.header.intentions);
    this.offerHeadset();
    this.absence = new Absence();
    this.overlays = new Overlays(world);
    this.lateHands = new LateHands(world);
    this.control = null; // of a page that watches a person: which page controls the person, as in the last state
    if (world.header.watched !== null) say(WATCHES, { stays: true });
    this.help = document.querySelector(this.isPerson ? ".person" : ".spectator");
    this.guide = new Guide(world, this.isPerson, ARM, () => {
      this.help.hidden = true;
    });
    this.help.hidden = this.guide.isOpen;
    element("steps").addEventListener("click", () => {
      this.help.hidden = true;
      this.guide.open();
      element("steps").blur();
    });
    this.intention = "";
    this.offerIntentions(world.header.intentions);
    element("follow").hidden = this.isPerson;
    for (const [name, code] of [
      ["follow", "KeyF"],
      ["label", "KeyN"],
      ["keys", "KeyH"],
    ])
      element(name).addEventListener("click", () => {
        this.press(code);
        element(name).blur();
      });
    const isRoomy = innerWidth > 640 && innerHeight > 560; // as in the style sheet
    for (const panel of document.querySelectorAll("details")) panel.open = isRoomy;
    for (const help of document.querySelectorAll("#bottom .help"))
      help.addEventListener("click", () => {
        help.hidden = true;
      });
    const { replay } = world.header;
    this.timeline = replay === null ? null : new Timeline(replay, (wish) => this.ask(wish));
    this.newest = null;
    this.shapes = null; // loaded shapes of rigid bodies, until a state comes with the same bodies
    this.heardAt = performance.now();
    this.pace = new Pace(LONGEST);
    this.followed = -1;
    this.isLoadingPlants = false;
    this.isAdvised = false;
    this.shadowAt = asked("shadows") === 0 ? Infinity : -1e9;
    this.lastFrame = performance.now();
    this.shortest = 0; // smallest time between two pictures on a screen [s]
    this.frame = 1 / 60; // time of a frame, smoothed [s]
    this.first = new FirstPictures(FIRST_PICTURES);
    this.pixels = null; // of a slow browser: share of the rows and columns that are drawn
    if (this.isSlow) this.drawLess();
    this.labels = new Map();
    addEventListener("resize", () => this.resize());
    addEventListener("keydown", (event) => {
      if (!event.repeat) this.press(event.code);
    });
    this.resize();
    this.connect();
    this.renderer.setAnimationLoop((_, frame) => this.draw(frame));
  }

  /** One button for each intention; a second click ends it. */
  offerIntentions(intentions) {
    const panel = element("intentions");
    this.asks = panel.querySelector("summary").textContent;
    panel.hidden = intentions.length === 0;
    for (const intention of intentions) {
      const button = panel.appendChild(document.createElement("button"));
      button.textContent = intention;
      button.setAttribute("aria-pressed", "false");
      button.addEventListener("click", () => {
        this.indicate(this.intention === intention ? "" : intention);
        button.blur(); // so that keys move the viewpoint again
      });
    }
  }

  /** Set the person's intention; empty: none. */
  indicate(intention) {
    if (!this.isPerson) return;
    this.intention = intention;
    const panel = element("intentions");
    for (const button of panel.querySelectorAll("button"))
      button.setAttribute("aria-pressed", String(button.textContent === intention));
    panel.querySelector("summary").textContent = `${this.asks} ${intention}`;
  }

  async offerHeadset() {
    const button = element("enter");
    if (!isSecureContext)
      say("Headset and microphone need https: start the client with --page-lan, and open the address that it prints.", {
        stays: true,
      });
    button.hidden = !(await navigator.xr?.isSessionSupported("immersive-vr"));
    button.addEventListener("click", () => this.headset.enter(this.eyes.place, this.eyes.yaw).catch(fail));
    for (const change of ["sessionstart", "sessionend"])
      this.renderer.xr.addEventListener(change, () => {
        if (this.detail) this.setBudget(Math.min(this.detail.value, this.headset.isWorn ? 1 : Infinity));
      });
  }

  connect() {
    this.socket = new WebSocket(socketAddress("state"));
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => {
      ++page.states;
      this.take(decode(event.data));
    };
    this.socket.onclose = () => setTimeout(() => this.reconnect(), RETRY);
  }

  /** Reconnect; the client may have been restarted with another vineyard or with this one at rest. */
  async reconnect() {
    element("state").textContent = "the client is gone; waiting for it ...";
    try {
      const header = await load("scene");
      watchIfControlled(header, this.world.header.watched !== null);
      const { scene, seed, person } = this.world.header;
      if (header.scene !== scene || header.seed !== seed || header.person !== person) location.reload();
      this.world.rest(header.arrays.poses);
      this.world.rigidVersion = 0;
      this.shapes = null;
      this.connect();
    } catch (failure) {
      if (failure.status === 403)
        fail("This address is no longer valid: open the one that the client has printed now.");
      setTimeout(() => this.reconnect(), RETRY);
    }
  }

  async take(state) {
    // poses of trees are sent once, so poses in a state that is replaced before it is drawn must be used, too
    if (this.hasLostControl(state.control)) return location.reload();
    this.world.apply(state);
    this.newest = state;
    if (this.timeline?.show(state.replay)) this.absence.expect();
    this.takeRigid(state);
    this.overlays.take(state);
    this.pace.earn(state.time);
    this.heardAt = performance.now();
    for (const [hand, pulse] of Object.entries(state.haptics)) page.haptics[hand] = pulse;
    this.headset.pulse(state.haptics);
    if (this.shears.take(state)) this.hand?.cut();
    this.handwork.take(state);
    if (state.rigid > Math.max(this.world.rigidVersion, this.shapes?.version ?? 0) && !this.loading) {
      this.loading = true;
      this.shapes = await load("rigid").catch(() => null); // if the client has ended meanwhile, the socket waits for it
      this.loading = false;
      this.takeRigid(this.latest);
    }
  }

  /** Called with the page that controls the person: "this", "other", or "" for none. Returns whether this page has to be
   * loaded again, because it was made for the other role. */
  hasLostControl(control) {
    if (this.isPerson) return control === "other"; // two pages were opened at the same time
    if (this.world.header.watched === null) return false;
    const before = this.control;
    this.control = control;
    if (before === "other" && control === "") say(RELEASED, { stays: true });
    return before === null && control === ""; // this page was loaded while the other one was about to close
  }

  /** Update rigid bodies from a state. Shapes and poses change together, because a row may belong to another body. */
  takeRigid(state) {
    this.latest = state;
    if (this.shapes !== null && this.shapes.version === state.rigid) {
      this.world.setRigid(this.shapes);
      this.shapes = null;
    }
    if (state.rigid !== this.world.rigidVersion) return;
    this.world.applyRigid(state.arrays);
    this.lateHands.take(state);
  }

  /** Send the user's command to the recording at once, because no state may follow while it pauses. */
  ask(replay) {
    if (this.socket.readyState === WebSocket.OPEN)
      this.socket.send(JSON.stringify({ ...this.message(this.eyes.pose), replay }));
  }

  press(code) {
    this.overlays.press(code);
    if (code === "KeyF" && !this.isPerson) {
      const actors = this.actors();
      this.followed = actors.length ? ((this.followed + 2) % (actors.length + 1)) - 1 : -1;
      if (!actors.length) say(NOBODY);
    }
    if (code === "KeyT") this.shears.toggle("right");
    this.handwork.press(code);
    if (code === "KeyN") {
      element("names").hidden = !element("names").hidden;
      element("label").setAttribute("aria-pressed", String(!element("names").hidden));
    }
    if (code === "KeyH" && this.guide.isOpen) this.guide.close();
    else if (code === "KeyH") this.help.hidden = !this.help.hidden;
  }

  /** Returns robots and people: name, and the first body of each. */
  actors() {
    const first = new Map();
    this.world.names.forEach((name, k) => {
      const owner = name.split("/")[0];
      if (name.includes("/") && owner !== "box" && owner !== "bunch" && !first.has(owner)) first.set(owner, k);
    });
    return [...first].map(([name, k]) => ({ name, carrier: this.world.bodies + 1 + k }));
  }

  draw(frame) {
    const now = performance.now(),
      passed = (now - this.lastFrame) / 1000;
    if (passed < this.shortest && !this.headset.isWorn) return;
    const seconds = this.isPerson ? this.pace.spend(passed) : Math.min(passed, LONGEST);
    const wasHidden = isUnusual(passed, this.frame);
    this.lastFrame = now;
    this.frame += Math.min(1, 0.05 + passed) * (passed - this.frame);
    if (page.drawn > 0) this.first.add(passed);
    if (this.isAdvised && !this.headset.isWorn) {
      if (this.detail?.add(passed, RATE)) this.setBudget(this.detail.value);
      if (this.pixels?.add(passed, FEW_RATE)) this.resize();
    }
    const actors = this.actors();
    if (this.eyes.update(seconds)) this.followed = -1;
    element("follow").setAttribute("aria-pressed", String(this.followed >= 0));
    if (this.followed >= 0 && this.followed < actors.length) {
      const { carrier } = actors[this.followed];
      this.eyes.follow(this.world.place(carrier).toArray(), this.world.heading(carrier), (eye, point) =>
        this.world.countBetween(eye, point),
      );
    }
    if (this.headset.isWorn) {
      this.headset.update(frame, seconds, passed);
      this.wrist.show(this.intention, element("notices").lastElementChild?.textContent ?? "");
    } else this.look(this.eyes.pose);
    const pose = this.headset.isWorn ? this.headset.head() : this.eyes.pose;
    const eye = new THREE.Vector3(...pose.slice(0, 3));
    page.voice.listen(pose);
    if (this.world.isLeft(eye)) this.loadPlants(eye);
    this.world.list(
      eye,
      ahead(pose),
      this.headset.isWorn ? IN_HEADSET : { field: this.diagonal, turn: TURN, pixel: this.pixel },
    );
    this.overlays.draw(actors, this.camera);
    if (this.isPerson) {
      this.person = this.track(pose, seconds);
      this.lateHands.draw(this.person);
      this.shears.draw(
        [0, 1].map((k) => this.lateHands.palm(this.person, k)),
        facing(pose),
      );
    }
    if (!this.headset.isWorn)
      this.guide.update({ eyes: this.eyes, hand: this.hand, actors, isFollowing: this.followed >= 0 });
    this.renderer.info.reset();
    const rarer = this.isSlow ? 2 : 1;
    if (now - this.shadowAt > rarer * Math.max(SHADOW_PERIOD, 1000 * SHADOW_PICTURES * this.frame)) {
      this.shadowAt = now;
      this.world.renderShadow(this.renderer);
      this.renderer.info.reset();
    }
    this.renderer.render(this.scene, this.camera);
    Object.assign(page, {
      frames: page.frames + 1,
      calls: this.renderer.info.render.calls,
      triangles: this.renderer.info.render.triangles,
    });
    this.label(actors);
    const silence = (now - this.heardAt) / 1000;
    if (this.socket.readyState === WebSocket.OPEN && silence > SILENCE && !this.timeline?.status.paused)
      element("state").textContent = `no news for ${silence.toFixed(0)} s: the client pauses, or does not answer`;
    if (this.newest !== null) {
      page.drawn += 1;
      page.tick = this.newest.tick;
      const rate = 1 / this.frame;
      const said = `${this.world.header.scene}  ${this.newest.time.toFixed(1)} s  ${rate.toFixed(rate < 10 ? 1 : 0)} frames/s`;
      element("state").textContent = this.newest.pace ? `${said}  ${this.newest.pace}` : said;
      // the first picture after a hidden tab shows a state from when it was hidden
      const isKnown = this.newest.rigid === this.world.rigidVersion && !wasHidden;
      this.absence.drawn(this.newest.time, this.world.picked, isKnown ? actors.map(({ name }) => name) : null);
      this.adviseOnce(actors);
      this.newest = null;
      if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(this.message(pose)));
    }
  }

  /** For a vineyard that is too large for a page: load the plants around the eye in place of distant ones. */
  async loadPlants({ x, y, z }) {
    if (this.isLoadingPlants) return;
    this.isLoadingPlants = true;
    // if the client has ended, the socket waits for it
    const plants = await load(`plants?x=${x}&y=${y}&z=${z}`).catch(() => null);
    if (plants === null) await new Promise((tryAgain) => setTimeout(tryAgain, RETRY));
    else this.world.setPlants(plants, plants.place);
    this.isLoadingPlants = false;
  }

  /** Set the number of triangles to draw, as a multiple of a phone's. */
  setBudget(multiple) {
    this.world.setBudget(multiple * TRIANGLE_BUDGET);
  }

  /** After the first pictures: show hints for new users. */
  adviseOnce(actors) {
    if (this.isAdvised || this.first.median === null) return;
    this.isAdvised = true;
    if (actors.length === 0 && this.timeline === null) say(NOBODY);
    if (!this.isSlow) {
      if (this.first.median < 1 / SLOW || this.headset.isWorn || this.detail === null) return;
      this.drawLess();
      this.resize();
    }
    say(TOO_SLOW);
  }

  /** Reduce the numbers of triangles and pixels to draw. */
  drawLess() {
    this.isSlow = true;
    this.detail = null;
    this.pixels = new Detail(SLOW_PIXELS);
    this.world.simplify();
    this.setBudget(FEW);
  }

  /** Send the client the drawn state, the viewpoint, and the person's head and hands. */
  message(pose) {
    const message = { drawn: page.tick, view: pose, overlays: this.overlays.areShown };
    if (!this.isPerson) return message;
    const wishes = { intention: this.intention, shears: this.shears.inHands, work: this.handwork.asked };
    return { ...message, person: { ...this.person, ...wishes } };
  }

  /** The person's tracked head and hands in this frame, a time [s] after the last one. */
  track(pose, seconds) {
    if (this.headset.isWorn) return { head: pose, ...this.headset.hands() };
    this.hand.withShears = this.shears.taken.right;
    const right = this.hand.tracked(pose, this.eyes.yaw, this.ray(this.hand.cursor), this.world, seconds);
    this.hand.show(this.shears.between[1], this.shears.held[1]);
    return { head: pose, left: null, right };
  }

  /** Direction (Vector3, world) from the eyes through a place of the picture, -1 to 1. */
  ray(cursor) {
    const { x, y, z } = new THREE.Vector3(...cursor, 0.5).unproject(this.camera).sub(this.camera.position).normalize();
    return new THREE.Vector3(x, -z, y);
  }

  /** Reach for a tapped object, or say that it is too far away. */
  reach(cursor) {
    if (this.headset.isWorn) return;
    const spread = (FINGER / (innerHeight / 2)) * Math.tan(((this.camera.fov / 2) * Math.PI) / 180);
    const found = pointAt(this.world, new THREE.Vector3(...this.eyes.place), this.ray(cursor), {
      spread,
      reach: ARM,
      farthest: FARTHEST,
      withShears: this.shears.taken.right,
    });
    if (found === null) return;
    if (found.distance <= ARM) this.hand.reachFor(found);
    else say(`This ${found.what} is ${found.distance.toFixed(1)} m away, an arm reaches ${ARM} m: walk nearer.`);
  }

  /** Half of the camera's diagonal field of view [rad]. */
  get diagonal() {
    return Math.atan(Math.tan(((this.camera.fov / 2) * Math.PI) / 180) * Math.hypot(1, this.camera.aspect));
  }

  /** Angle of a pixel in the middle of the picture [rad]. */
  get pixel() {
    return (2 * Math.tan(((this.camera.fov / 2) * Math.PI) / 180)) / this.renderer.domElement.height;
  }

  /** Move the camera to a pose with x forward and z up, in the world, which is rotated by 90 degrees. */
  look(pose) {
    const target = ahead(pose).applyEuler(this.world.group.rotation);
    this.rig.position.set(0, 0, 0);
    this.rig.rotation.y = 0;
    this.camera.position.set(pose[0], pose[1], pose[2]).applyEuler(this.world.group.rotation);
    this.camera.lookAt(target.add(this.camera.position));
    this.rig.updateMatrixWorld();
  }

  /** Draw names above the other actors. */
  label(actors) {
    const names = element("names"),
      there = new Set(),
      eye = new THREE.Vector3(...this.eyes.place);
    const lowest = element("top").getBoundingClientRect().bottom;
    if (!names.hidden)
      for (const { name, carrier } of actors) {
        if (name === this.world.header.person) continue;
        const head = this.world.names.indexOf(`${name}/head`),
          parts = head < 0 ? this.parts(name) : [this.world.bodies + 1 + head];
        const point = this.world.place(head < 0 ? carrier : parts[0]),
          top = this.world.top(parts);
        const distance = point.distanceTo(eye);
        const below = this.project(point);
        if (below.z > 1 || Math.abs(below.x) > 1 || Math.abs(below.y) > 1.2 || !Number.isFinite(top)) continue;
        const above = this.project(point.setZ(top + NAME.gap));
        there.add(name);
        if (!this.labels.has(name)) {
          this.labels.set(name, names.appendChild(document.createElement("div")));
          this.labels.get(name).textContent = name;
        }
        const label = this.labels.get(name),
          size = NAME.far + (NAME.near - NAME.far) * Math.min(1, NAME.from / distance);
        label.style.fontSize = `${size.toFixed(1)}px`;
        const x = ((above.x + 1) / 2) * innerWidth,
          y = Math.max(((1 - above.y) / 2) * innerHeight, lowest + 2 * size);
        label.style.transform = `translate(${x}px, ${y}px) translate(-50%, -100%)`;
      }
    for (const [name, label] of this.labels)
      if (!there.has(name)) {
        label.remove();
        this.labels.delete(name);
      }
  }

  /** Carriers that belong to an actor. */
  parts(actor) {
    return this.world.names.flatMap((name, k) => (name.startsWith(`${actor}/`) ? [this.world.bodies + 1 + k] : []));
  }

  /** Returns the position of a point (Vector3, world) in the picture: -1 to 1, right and up; z above 1 means behind the eyes. */
  project(point) {
    return point.clone().applyEuler(this.world.group.rotation).project(this.camera);
  }

  resize() {
    const few = Math.min(1, Math.sqrt(FEW_PIXELS / (innerWidth * innerHeight)));
    this.renderer.setPixelRatio(this.isSlow ? few * (this.pixels?.value ?? 1) : Math.min(devicePixelRatio, 2));
    this.renderer.setSize(innerWidth, innerHeight, false);
    this.camera.aspect = innerWidth / innerHeight;
    this.camera.updateProjectionMatrix();
  }
}

/** Direction in the world of eyes at a pose [7]. */
function ahead(pose) {
  return new THREE.Vector3(1, 0, 0).applyQuaternion(new THREE.Quaternion(...pose.slice(3)));
}

/** Orientation in the world of a plane that faces eyes at a pose [7]. */
function facing(pose) {
  return new THREE.Quaternion(...pose.slice(3)).multiply(new THREE.Quaternion(0, -Math.SQRT1_2, 0, Math.SQRT1_2));
}

/** Name of the browser's renderer; empty if unknown. */
function graphicsCard() {
  const gl = document.createElement("canvas").getContext("webgl2"),
    names = gl?.getExtension("WEBGL_debug_renderer_info");
  const card = gl?.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER) ?? "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return card;
}

/** Let a page watch whose person another page controls, or that watches already: its header becomes that of a spectator,
 * with the name of the person as `watched`. */
function watchIfControlled(header, watches = false) {
  header.watched = null;
  if (header.person === null || !(header.is_controlled || watches)) return;
  Object.assign(header, { watched: header.person, person: null, mouth: null, intentions: [] });
}

function fail(failure) {
  page.failure = String(failure?.message ?? failure);
  element("failure").textContent = page.failure;
  element("failure").hidden = false;
}

addEventListener("unhandledrejection", (event) => fail(event.reason));
addEventListener("error", (event) => {
  if (event.message) fail(event.message);
});

if (window.pageMisses) throw new Error(window.pageMisses);
page.voice = new Voice();
const header = await load("scene");
watchIfControlled(header);
const world = new World(header);
if (asked("triangles") > 0) world.setBudget(asked("triangles"));
page.viewer = new Viewer(world, [...header.arrays.start]);
if (asked("rate") > 0) page.viewer.shortest = 1 / asked("rate") - 0.002; // displays tick a little early
window.pageStarted();

// First steps for new users: what to do next, and where bunches and robots are. A step is checked off when it was done.

import * as THREE from "./vendor/three.module.js";
import { say } from "./notices.js";

/** A browser remembers that its user has finished or closed the guide, by a cookie: addresses of pages differ in the port,
 * for which other storage would be separate. */
const DONE = "vinesim-first-steps=done";
const YEAR = 31_536_000; // s
const PERIOD = 250; // ms between two updates of the text
const LOOKED = 0.35,
  MOVED = 0.5; // rad, m: motions that count as done
const ALL_DONE = "Well done, those were the first steps. H, or 'keys' under 'show', lists everything else.";

const LOOK = "Drag with the mouse to look around: the picture follows the mouse, so dragging down looks up.";

/** Steps of a person and of a spectator: name, text for keys and mouse, text for touch. */
const STEPS = {
  person: [
    ["look", LOOK, "Drag with one finger to look around: the picture follows the finger."],
    [
      "walk",
      "Walk to a bunch of grapes with <kbd>W</kbd> <kbd>A</kbd> <kbd>S</kbd> <kbd>D</kbd>.",
      "Walk to a bunch of grapes: drag with two fingers.",
    ],
    [
      "reach",
      "Click on the bunch: your right hand reaches for it.",
      "Tap on the bunch: your right hand reaches for it.",
    ],
    ["hold", "Press <kbd>Space</kbd> when the hand is there: it holds the bunch.", "Press 'grasp': the hand holds it."],
    [
      "pick",
      "Walk back with <kbd>S</kbd> until the bunch comes off. (Or let go, take shears with <kbd>T</kbd>, click the bunch, " +
        "cut with <kbd>Space</kbd>.)",
      "Walk back with two fingers until it comes off. (Or let go, take 'shears', tap the bunch, 'cut'.)",
    ],
  ],
  spectator: [
    ["look", LOOK, "Drag with one finger to look around: the picture follows the finger."],
    [
      "move",
      "Fly with <kbd>W</kbd> <kbd>A</kbd> <kbd>S</kbd> <kbd>D</kbd>, down and up with <kbd>Q</kbd> <kbd>E</kbd>.",
      "Fly: drag with two fingers.",
    ],
    ["follow", "Follow a robot or person: <kbd>F</kbd>.", "Follow a robot or person: 'next actor' under 'show'."],
  ],
};

export class Guide {
  /** `reach` [m]: length of an arm; `ended()` is called when the user closes the guide. */
  constructor(world, isPerson, reach, ended) {
    this.world = world;
    this.isPerson = isPerson;
    this.reach = reach;
    this.ended = ended;
    this.panel = document.getElementById("guide");
    this.list = this.panel.querySelector("ol");
    this.where = this.panel.querySelector("p");
    this.panel.querySelector("button").addEventListener("click", () => this.close());
    this.updatedAt = -PERIOD;
    if (!document.cookie.includes(DONE)) this.open();
  }

  get isOpen() {
    return !this.panel.hidden;
  }

  /** Begin with the first step. */
  open() {
    this.hasWalked = false;
    this.start = null; // eyes and number of picked bunches at the beginning
    this.list.replaceChildren(
      ...STEPS[this.isPerson ? "person" : "spectator"].map(([name, keys, touch], k) => {
        const step = document.createElement("li");
        step.value = k + 1; // also where the others are not shown
        step.dataset.name = name;
        step.innerHTML = `<span class="keys">${keys}</span><span class="touch">${touch}</span>`;
        return step;
      }),
    );
    this.panel.hidden = false;
    this.mark();
  }

  /** Close the guide; this browser does not open it again by itself. */
  close() {
    this.panel.hidden = true;
    // biome-ignore lint/suspicious/noDocumentCookie: the Cookie Store API is missing in browsers of 2022
    document.cookie = `${DONE}; max-age=${YEAR}; path=/; SameSite=Strict`;
    this.ended();
  }

  /** Called with every picture: `eyes` of the viewer, the `hand` of a person or null, `actors`, and whether one is followed. */
  update({ eyes, hand, actors, isFollowing }) {
    const now = performance.now();
    if (!this.isOpen || now - this.updatedAt < PERIOD) return;
    this.updatedAt = now;
    const { place, yaw, pitch } = eyes,
      picked = this.world.picked.size;
    this.start ??= { place: [...place], yaw, pitch, picked };
    const { start } = this,
      bunch = this.nearestBunch(place);
    const moved = Math.hypot(...place.map((value, axis) => value - start.place[axis]));
    this.hasWalked ||= moved > MOVED; // the person may stand before a bunch from the start
    const turned = Math.abs(Math.sin((yaw - start.yaw) / 2)) * 2 + Math.abs(pitch - start.pitch);
    const isReaching = hand?.reaching && hand.target?.what === "bunch";
    const done = {
      look: turned > LOOKED,
      move: moved > MOVED,
      follow: isFollowing,
      walk: this.hasWalked && bunch !== null && bunch.away < this.reach,
      reach: isReaching,
      hold: isReaching && hand.held === "the bunch",
      pick: picked > start.picked,
    };
    // steps are done in this order, so that nothing is checked off by chance; a pick is the aim, however it was done
    const { current } = this;
    if (current !== null && done[current.dataset.name]) current.classList.add("done");
    if (done.pick && this.isPerson) for (const step of this.list.children) step.classList.add("done");
    this.mark();
    if (this.current === null) {
      this.close();
      say(ALL_DONE);
      return;
    }
    const robots = actors.filter(({ name }) => name !== this.world.header.person);
    this.show(
      [
        ...(["walk", "reach"].includes(this.current.dataset.name) && bunch !== null
          ? [["nearest bunch", this.world.place(bunch.carrier)]]
          : []),
        ...robots.slice(0, 3).map(({ name, carrier }) => [name, this.world.place(carrier)]),
      ],
      place,
      yaw,
    );
  }

  /** The first step that was not done, or null. */
  get current() {
    return [...this.list.children].find((step) => !step.classList.contains("done")) ?? null;
  }

  mark() {
    for (const step of this.list.children) {
      if (step === this.current) step.setAttribute("aria-current", "step");
      else step.removeAttribute("aria-current");
    }
  }

  /** Show distance and direction of places, relative to eyes at a `place` [3] with a `yaw` [rad]. */
  show(things, place, yaw) {
    this.where.hidden = things.length === 0;
    this.where.replaceChildren(
      ...things.map(([name, { x, y }]) => {
        const line = document.createElement("span"),
          arrow = document.createElement("b");
        const way = Math.atan2(y - place[1], x - place[0]) - yaw;
        arrow.textContent = "\u2191";
        arrow.style.transform = `rotate(${-way}rad)`;
        line.append(arrow, ` ${name} ${Math.hypot(x - place[0], y - place[1]).toFixed(1)} m`);
        line.title = sideOf(way);
        arrow.setAttribute("aria-label", sideOf(way));
        arrow.setAttribute("role", "img");
        return line;
      }),
    );
  }

  /** Returns the `carrier` of the bunch that is nearest to a place [3], and how far `away` it is [m]; null: none. */
  nearestBunch(place) {
    const { bunch_body: bodies } = this.world.header.arrays,
      eye = new THREE.Vector3(...place);
    let best = null;
    bodies?.forEach((carrier, k) => {
      if (this.world.picked.has(k)) return;
      const away = this.world.place(carrier).distanceTo(eye);
      if (best === null || away < best.away) best = { carrier, away };
    });
    return best;
  }
}

/** Direction in words of an angle to the left of straight ahead [rad]. */
function sideOf(angle) {
  const eighths = Math.round((4 * Math.atan2(Math.sin(angle), Math.cos(angle))) / Math.PI);
  return ["ahead", "ahead left", "left", "behind left", "behind", "behind right", "right", "ahead right"].at(
    eighths % 8,
  );
}

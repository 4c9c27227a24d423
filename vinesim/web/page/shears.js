// Shears in the hands of the page's person: taken and put away by a key, a button of the page or of a controller.

import { say } from "./notices.js";

const SIDES = ["left", "right"];

export class Shears {
  /** `isOffered`: whether the page has a person who can take them. */
  constructor(isOffered) {
    this.isOffered = isOffered;
    this.taken = { left: false, right: false };
    this.closures = null; // how often they have closed, as far as the page knows
    this.told = []; // sentences so far
    const panel = document.getElementById("tools");
    panel.hidden = !isOffered;
    this.button = panel.querySelector("button");
    this.button.addEventListener("click", () => { this.toggle("right"); this.button.blur(); });
  }

  /** Take the shears into a hand, or put them away. */
  toggle(side) {
    if (!this.isOffered || !(side in this.taken)) return;
    this.taken[side] = !this.taken[side];
    this.button.setAttribute("aria-pressed", String(this.taken.right));
  }

  /** Whether the left and the right hand have them, for the page's message. */
  get inHands() { return SIDES.map((side) => this.taken[side]); }

  /** A state has come: say what the shears have cut each time that they have closed since the last one. */
  take({ shears }) {
    if (!shears) return;
    const since = this.closures === null ? 0 : Math.max(shears.closures - this.closures, 0);
    for (const said of since ? shears.said.slice(-since) : []) {
      this.told.push(said);
      say(said);
    }
    this.closures = shears.closures;
  }
}

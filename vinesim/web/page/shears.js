// Shears in the hands of the page's person: taken and put away by a key, a button of the page or of a controller; marks
// show where they cut.

import * as THREE from "./vendor/three.module.js";
import { say } from "./notices.js";

const SIDES = ["left", "right"];
const MARK = { inner: 0.017, outer: 0.021, dot: 0.005 }; // radii of a ring around the cut, and of a dot in it [m]
/** Colours of the mark: with nothing between the blades, with something they would cut, with wood that is too strong. */
const NOTHING = 0xffffff,
  CUTS = 0x3dff6e,
  TOO_STRONG = 0xff4d3d;

export class Shears {
  /** `mouth` [3]: point where the shears cut, in the palm's frame [m]; null: the page controls no person. */
  constructor(mouth, group) {
    this.mouth = mouth;
    this.taken = { left: false, right: false };
    this.between = ["", ""]; // the kind of wood that the blades of both hands would cut
    this.held = ["", ""]; // what both hands hold
    this.closures = null; // number of closings that the page has reported
    this.told = []; // sentences shown so far
    document.getElementById("tools").hidden = mouth === null;
    this.button = document.getElementById("shears");
    this.button.addEventListener("click", () => {
      this.toggle("right");
      this.button.blur();
    });
    this.marks = SIDES.map(() => {
      const mark = makeMark();
      group.add(mark);
      return mark;
    });
  }

  /** Take the shears into a hand, or put them away. */
  toggle(side) {
    if (this.mouth === null || !(side in this.taken)) return;
    this.taken[side] = !this.taken[side];
    const held = this.held[SIDES.indexOf(side)];
    if (this.taken[side] && held) say(`The ${side} hand let go of ${held} to take the shears.`);
    this.button.setAttribute("aria-pressed", String(this.taken.right));
  }

  /** Whether the left and the right hand have shears, for the page's message. */
  get inHands() {
    return SIDES.map((side) => this.taken[side]);
  }

  /** Called when a state has arrived: report the result of each closing of the shears since the last state. Returns
   * whether they have closed. */
  take({ shears, held }) {
    if (!shears) return false;
    this.held = held;
    const since = this.closures === null ? 0 : Math.max(shears.closures - this.closures, 0);
    for (const said of since ? shears.said.slice(-since) : []) {
      this.told.push(said);
      say(said);
    }
    this.closures = shears.closures;
    this.between = shears.between;
    return since > 0;
  }

  /** Mark where the blades cut now, for palms (Matrix4 or null) and eyes (Quaternion) in the world. */
  draw(palms, turn) {
    this.marks.forEach((mark, k) => {
      mark.visible = this.taken[SIDES[k]] && palms[k] !== null;
      if (!mark.visible) return;
      mark.position.set(...this.mouth).applyMatrix4(palms[k]);
      mark.quaternion.copy(turn);
      const found = this.between[k],
        [ring, dot] = mark.children;
      dot.visible = found !== "";
      ring.material.color.set(found === "" ? NOTHING : found === "strong wood" ? TOO_STRONG : CUTS);
      dot.material.color.copy(ring.material.color);
    });
  }
}

/** A ring with a dot, drawn in front of everything. */
function makeMark() {
  const mark = new THREE.Group();
  for (const shape of [new THREE.RingGeometry(MARK.inner, MARK.outer, 40), new THREE.CircleGeometry(MARK.dot, 20)]) {
    const part = new THREE.Mesh(
      shape,
      new THREE.MeshBasicMaterial({ depthTest: false, transparent: true, toneMapped: false }),
    );
    part.renderOrder = 3;
    part.frustumCulled = false;
    mark.add(part);
  }
  mark.visible = false;
  return mark;
}

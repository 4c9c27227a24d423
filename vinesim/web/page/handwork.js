// Work on plants by the page's person: the right hand ties the cane next to it to the nearest wire, opens the nearest
// tie, or takes the leaves off. A key or a button asks for it; the client does it and answers with a sentence.

import { say } from "./notices.js";

const KEYS = { KeyB: "tie", KeyU: "untie", KeyL: "take_leaves" };

export class Handwork {
  /** `isPerson`: whether this page controls a person. */
  constructor(isPerson) {
    this.isPerson = isPerson;
    this.asked = null; // the newest wish and its number, which each message to the client repeats
    this.count = null; // number of answers that the page has reported
    this.told = []; // sentences shown so far
    const panel = document.getElementById("handwork");
    panel.hidden = !isPerson;
    for (const button of panel.querySelectorAll("button"))
      button.addEventListener("click", () => {
        this.ask(button.dataset.work);
        button.blur();
      });
  }

  press(code) {
    if (code in KEYS) this.ask(KEYS[code]);
  }

  ask(what) {
    if (this.isPerson) this.asked = { what, number: (this.asked?.number ?? 0) + 1 };
  }

  /** Called when a state has arrived: say what was done since the last state. */
  take({ work }) {
    if (!work) return;
    const since = this.count === null ? 0 : Math.max(work.count - this.count, 0);
    for (const said of since ? work.said.slice(-since) : []) {
      this.told.push(said);
      say(said);
    }
    this.count = work.count;
  }
}

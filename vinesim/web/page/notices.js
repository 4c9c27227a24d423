// Messages for the user: changes while nothing was drawn, and features that this address cannot offer.

const SHOWN_FOR = 12_000; // ms
const FIRST = 5; // number of first pictures, which may be slow because the browser compiles shaders
const TIMES = 5;

/** Returns whether a time between two pictures is much longer than usual on this machine, so that the user missed something. */
export function isUnusual(passed, usual) {
  return passed > TIMES * usual;
}

/** Show a sentence for a while or until it is clicked; a sentence already shown starts again. */
export function say(text, { stays = false } = {}) {
  const notices = document.getElementById("notices");
  for (const shown of [...notices.children]) if (shown.textContent === text) shown.remove();
  const notice = document.createElement("div");
  notice.className = "panel";
  notice.textContent = text;
  notices.append(notice);
  notice.addEventListener("click", () => notice.remove());
  if (!stays) setTimeout(() => notice.remove(), SHOWN_FOR);
}

/** Compares the world before and after a gap, and reports the changes. */
export class Absence {
  constructor() {
    this.known = null; // the world in the newest picture: time, picked bunches, actors
    this.before = null; // the world before a gap that was not reported yet
    this.told = []; // sentences shown so far
    this.long = 3; // a longer world time between two pictures is reported unless it is usual on this machine [s]
    this.usual = 0; // time of the world between two pictures, smoothed [s]
    this.pictures = 0;
  }

  /** The user has requested the next jump of time. */
  expect() {
    this.known = null;
  }

  /** Called when a picture was drawn at a world time [s], with the number of `picked` bunches and the names of `actors`;
   * null: not known before the next picture. */
  drawn(time, picked, actors) {
    const { known } = this,
      passed = known === null ? 0 : time - known.time;
    const isAbsence = passed < 0 || (++this.pictures > FIRST && passed > this.long && isUnusual(passed, this.usual));
    if (isAbsence && this.before === null) this.before = { ...known };
    if (!isAbsence) this.usual += 0.2 * (passed - this.usual);
    if (actors === null) {
      if (known !== null) known.time = time;
      return;
    }
    this.known = { time, picked: new Set(picked), actors };
    if (this.before === null) return;
    const { before } = this,
      was = new Set(before.actors),
      is = new Set(actors);
    this.before = null;
    const found = [];
    const count = [...picked].filter((bunch) => !before.picked.has(bunch)).length;
    if (count) found.push(count === 1 ? "1 bunch was picked" : `${count} bunches were picked`);
    found.push(...actors.filter((name) => !was.has(name)).map((name) => `${name} came`));
    found.push(...before.actors.filter((name) => !is.has(name)).map((name) => `${name} left`));
    const length = time - before.time;
    const what = length < 0 ? "The client was started again" : `${length.toFixed(1)} s of the vineyard passed unseen`;
    this.told.push(`${what}${found.length ? `: ${found.join(", ")}` : ""}.`);
    say(this.told.at(-1));
  }
}

// How fast pictures come, and what is done where that is too slow. Times in seconds.

/** The first pictures of a page: one of them waits for the graphics card's compilers, which says nothing of the others. */
export class FirstPictures {
  constructor(count) {
    this.count = count;
    this.times = [];
  }

  add(seconds) {
    if (this.times.length < this.count) this.times.push(seconds);
  }

  /** Median time from one to the next; null until all have come. */
  get median() {
    return this.times.length < this.count ? null : [...this.times].sort((a, b) => a - b)[this.count >> 1];
  }
}

const WINDOW = 36; // pictures by which the detail is judged
const LATE = 1.4; // periods: a picture that takes longer has missed one
const MOST_LATE = 0.25; // share of a window
const STRAY = 1; // late pictures of a window that mean nothing: a collector ran, a list was made anew
const LONGEST_CALM = 16; // times the calm at first

/**
 * How much is drawn, 1 at first, so that pictures come at a rate: `less` times as much after a window with many late
 * ones, `more` after `calm` windows without, between `least` and `most`. More that proves too much is tried again
 * after twice as long.
 */
export class Detail {
  constructor({ least, most, less, more, calm }) {
    this.value = 1;
    this.limits = [least, most];
    this.steps = [less, more];
    this.late = this.seen = this.calm = 0;
    this.patience = calm;
    this.longest = LONGEST_CALM * calm;
    this.isTrial = false;
  }

  /** A picture came `seconds` after the last one, where `rate` [Hz] are wanted. Whether the value has changed. */
  add(seconds, rate) {
    this.late += seconds > LATE / rate;
    if (++this.seen < WINDOW) return false;
    const before = this.value,
      [least, most] = this.limits,
      [less, more] = this.steps;
    if (this.late > MOST_LATE * WINDOW) {
      if (this.isTrial) this.patience = Math.min(2 * this.patience, this.longest);
      this.value = Math.max(least, this.value * less);
    }
    this.calm = this.late > STRAY ? 0 : this.calm + 1;
    this.isTrial = this.calm >= this.patience && this.value < most;
    if (this.isTrial) {
      this.value = Math.min(most, this.value * more);
      this.calm = 0;
    }
    this.late = this.seen = 0;
    return this.value !== before;
  }
}

/** Of a headset: share of the pixels' rows and columns. */
export const PIXELS = { least: 0.5, most: 1, less: 0.85, more: 1.06, calm: 20 };
/** On a screen: triangles, as a multiple of those that a phone draws. */
export const TRIANGLES = { least: 0.4, most: 4, less: 0.7, more: 1.4, calm: 3 };

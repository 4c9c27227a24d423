// Measures the rate of pictures and adapts the detail to it. Times in seconds.

/** Measures the rate of the first pictures of a page; one of them waits for the compilers of the graphics card. */
export class FirstPictures {
  constructor(count) {
    this.count = count;
    this.times = [];
  }

  add(seconds) {
    if (this.times.length < this.count) this.times.push(seconds);
  }

  /** Median time from one picture to the next; null until all of them were drawn. */
  get median() {
    return this.times.length < this.count ? null : [...this.times].sort((a, b) => a - b)[this.count >> 1];
  }
}

const WINDOW = 36; // number of pictures after which the detail is judged
const LATE = 1.4; // a picture that takes longer than this number of periods is late
const MOST_LATE = 0.25; // largest share of late pictures in a window
const STRAY = 1; // late pictures of a window that are ignored: a garbage collector ran, or a list was rebuilt
const LONGEST_CALM = 16; // largest value of `calm`, as a multiple of its first value

/**
 * Amount that is drawn, 1 at first, adapted so that pictures keep a rate. It is multiplied by `less` after a window with
 * many late pictures, and by `more` after `calm` windows without, between `least` and `most`. If an increase was too
 * much, the next one follows after twice the time.
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

  /** Called when a picture was drawn `seconds` after the last one; `rate` [Hz] is the aim. Returns whether the value has
   * changed. */
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

/** Amount for a headset: share of the rows and columns of pixels. */
export const PIXELS = { least: 0.5, most: 1, less: 0.85, more: 1.06, calm: 20 };
/** Amount for a screen without a graphics card: share of the rows and columns of the pixels that it may draw. */
export const SLOW_PIXELS = { least: 0.7, most: 1, less: 0.85, more: 1.06, calm: 20 };
/** Amount for a screen: number of triangles relative to a phone. */
export const TRIANGLES = { least: 0.4, most: 4, less: 0.7, more: 1.4, calm: 3 };

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

const WINDOW = 36; // pictures by which a scale is judged
const LATE = 1.4; // periods of the display: a picture that takes longer has missed one
const MOST_LATE = 0.25; // share of a window
const COARSER = 0.85, FINER = 1.06, COARSEST = 0.5;
const CALM = 20, LONGEST_CALM = 320; // windows without a late picture before a finer scale is tried

/**
 * Of a headset's pictures: how many of the pixels' rows and columns are drawn, from COARSEST to 1, so that pictures come
 * with the display. A finer scale that proves too fine is tried again after twice as long.
 */
export class ViewportScale {
  constructor() {
    this.value = 1;
    this.late = this.seen = this.calm = 0;
    this.patience = CALM;
    this.isTrial = false;
  }

  /** A picture came `seconds` after the last one, on a display with `rate` [Hz]. */
  add(seconds, rate) {
    this.late += seconds > LATE / rate;
    if (++this.seen < WINDOW) return;
    if (this.late > MOST_LATE * WINDOW) {
      if (this.isTrial) this.patience = Math.min(2 * this.patience, LONGEST_CALM);
      this.value = Math.max(COARSEST, this.value * COARSER);
    }
    this.calm = this.late > 0 ? 0 : this.calm + 1;
    this.isTrial = this.calm >= this.patience && this.value < 1;
    if (this.isTrial) {
      this.value = Math.min(1, this.value * FINER);
      this.calm = 0;
    }
    this.late = this.seen = 0;
  }
}

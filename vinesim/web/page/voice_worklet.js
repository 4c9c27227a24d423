// In the thread of sound: cuts the microphone into frames, and plays the frames of one speaker at an even pace.

const FRAME = 960; // samples of 20 ms at 48 kHz
/** Delay of a voice behind the beginning of its first frame, at first and at most: a frame, and a reserve. */
const START = 1.5 * FRAME,
  LARGEST = 12 * FRAME; // samples
const RESERVE = FRAME / 2; // samples by which frames may come too early
const EASE = 8; // of what was too early, the share 1/so much is waited for no more
const SPARE = 4 * FRAME; // samples that may wait beyond these
const SILENT = 0.01; // amplitude below which a frame may be the last one of a while: nothing is sent for silence
const RAMP = 96; // samples of a fade, 2 ms

class Capture extends AudioWorkletProcessor {
  constructor() {
    super();
    this.frame = new Float32Array(FRAME);
    this.filled = 0;
  }

  process(inputs) {
    const samples = inputs[0][0];
    if (!samples) return true;
    let taken = 0;
    while (taken < samples.length) {
      const count = Math.min(FRAME - this.filled, samples.length - taken);
      this.frame.set(samples.subarray(taken, taken + count), this.filled);
      taken += count;
      this.filled += count;
      if (this.filled === FRAME) {
        this.port.postMessage(this.frame, [this.frame.buffer]);
        this.frame = new Float32Array(FRAME);
        this.filled = 0;
      }
    }
    return true;
  }
}

/**
 * Plays a voice half a frame after its first frame has come. A queue that is empty amid a voice makes it wait for
 * longer from then on. What every frame of a sentence came too early by is waited for less from the next one on, and one
 * that goes on for a second is cut by a frame, so that a voice is soon no later than its network makes it.
 */
class Player extends AudioWorkletProcessor {
  constructor() {
    super();
    this.frames = [];
    this.waiting = 0; // samples
    this.at = 0; // in the first frame
    this.target = START;
    this.plays = false;
    this.waited = 0; // samples since the first frame of those that wait has come
    this.level = 0; // of the fade, 0 to 1
    this.last = 0;
    this.counts = { stalls: 0, cut: 0 };
    this.peak = 0; // of the last frame
    this.least = Infinity; // samples that still waited when a frame came, since the voice began or was cut
    this.passed = 0; // samples since then
    this.hasStalled = false; // in this sentence
    this.port.onmessage = ({ data }) => {
      if (this.plays) this.least = Math.min(this.least, this.waiting);
      this.frames.push(data);
      this.peak = data.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
      this.waiting += data.length;
      while (this.waiting > this.target + SPARE) this.cut();
    };
  }

  cut() {
    this.waiting -= this.frames.shift().length - this.at;
    this.at = 0;
    this.counts.cut += 1;
    this.port.postMessage(this.counts);
  }

  /** After some samples of a voice that goes on: cut what has waited for nothing. */
  follow(count) {
    if (!this.plays) return;
    this.passed += count;
    if (this.passed < 50 * FRAME) return;
    if (this.least < Infinity && Math.min(this.least, this.waiting) > FRAME) {
      this.target = Math.max(START, this.target - FRAME);
      this.cut();
    }
    this.begin();
  }

  begin() {
    this.passed = 0;
    this.least = Infinity;
  }

  /** The queue is empty: the voice has stalled, or a sentence is over. */
  end() {
    this.plays = false;
    const isStall = this.peak > SILENT;
    if (isStall) {
      this.target = Math.min(this.target + FRAME / 2, LARGEST);
      this.counts.stalls += 1;
      this.port.postMessage(this.counts);
    } else if (!this.hasStalled && this.least < Infinity)
      this.target = Math.max(START, this.target - Math.max(this.least - RESERVE, 0) / EASE);
    this.hasStalled = isStall;
    this.begin();
  }

  process(_, outputs) {
    const out = outputs[0][0];
    if (!this.plays) {
      this.waited = this.frames.length ? this.waited + out.length : 0;
      this.plays = this.frames.length > 0 && Math.max(this.waiting, FRAME + this.waited) >= this.target;
    }
    for (let i = 0; i < out.length; ++i) {
      if (this.plays && this.frames.length) {
        this.last = this.frames[0][this.at++];
        this.waiting -= 1;
        if (this.at === this.frames[0].length) {
          this.frames.shift();
          this.at = 0;
        }
        this.level = Math.min(1, this.level + 1 / RAMP);
      } else {
        if (this.plays) this.end();
        this.level = Math.max(0, this.level - 1 / RAMP);
      }
      out[i] = this.level * this.last;
    }
    this.follow(out.length);
    return true;
  }
}

registerProcessor("capture", Capture);
registerProcessor("player", Player);

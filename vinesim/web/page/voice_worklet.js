// Audio worklet: splits the microphone's sound into frames, and plays the frames of one speaker at a steady pace.

const FRAME = 960; // samples of 20 ms at 48 kHz
/** Initial and largest delay of a voice after the beginning of its first frame: one frame and a reserve. */
const START = 1.5 * FRAME,
  LARGEST = 12 * FRAME; // samples
const RESERVE = FRAME / 2; // samples by which frames may come too early
const EASE = 8; // the delay is reduced by 1 / EASE of the time by which frames were early
const SPARE = 4 * FRAME; // samples that may wait in addition to the delay
const SILENT = 0.01; // amplitude below which a frame may be the last before silence, which is not sent
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
 * Plays a voice half a frame after its first frame has arrived. If the queue runs empty within a voice, the delay is
 * increased. If all frames of a sentence arrived early, the delay of the next sentence is reduced by this time, and a
 * sentence longer than a second is shortened by a frame. So the delay of a voice soon approaches the delay of its network.
 */
class Player extends AudioWorkletProcessor {
  constructor() {
    super();
    this.frames = [];
    this.waiting = 0; // samples
    this.at = 0; // index in the first frame of the next sample to play
    this.target = START;
    this.plays = false;
    this.waited = 0; // samples since the first of the waiting frames has arrived
    this.level = 0; // gain of the fade, 0 to 1
    this.last = 0;
    this.counts = { stalls: 0, cut: 0 };
    this.peak = 0; // largest amplitude of the last frame
    this.least = Infinity; // smallest number of samples that still waited when a frame arrived, since the voice began or was shortened
    this.passed = 0; // samples played since the voice began or was shortened
    this.hasStalled = false; // whether the voice has stalled in this sentence
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

  /** While a voice continues: drop samples that waited longer than necessary. */
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

  /** Called when the queue is empty: the voice has stalled, or a sentence has ended. */
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

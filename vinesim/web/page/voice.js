// Sound of the page: its own socket, Opus by WebCodecs or PCM16, voices at the speakers' positions, tones of lights.

import { socketAddress } from "./arrays.js";

const RATE = 48000,
  FRAME = 960,
  PCM_FACTOR = 3; // Hz, samples, to 16 kHz
const OPUS = 1,
  PCM16 = 2,
  EXTRA = 128; // codes of the codecs on the socket
const BITRATE = 24000,
  RETRY = 1000,
  SILENCE = 10000; // bit/s, ms, ms without a frame until a speaker is forgotten
const TAPS = 48;

/** Low pass before taking every third sample. */
const LOW_PASS = Float32Array.from({ length: TAPS }, (_, k) => {
  const t = (0.9 * (k - (TAPS - 1) / 2)) / PCM_FACTOR;
  const window = 0.54 - 0.46 * Math.cos((2 * Math.PI * k) / (TAPS - 1));
  return (0.9 / PCM_FACTOR) * (t === 0 ? 1 : Math.sin(Math.PI * t) / (Math.PI * t)) * window;
});

/** Converts the frames of one microphone to PCM16 at 16 kHz. */
class Downsampler {
  constructor() {
    this.before = new Float32Array(TAPS - 1);
  }

  take(samples) {
    const all = new Float32Array(this.before.length + samples.length);
    all.set(this.before);
    all.set(samples, this.before.length);
    this.before = all.slice(samples.length);
    const pcm = new Int16Array(samples.length / PCM_FACTOR);
    for (let i = 0; i < pcm.length; ++i) {
      let sum = 0;
      for (let k = 0; k < TAPS; ++k) sum += LOW_PASS[k] * all[PCM_FACTOR * i + k];
      pcm[i] = Math.max(-32768, Math.min(32767, Math.round(32767 * sum)));
    }
    return new Uint8Array(pcm.buffer);
  }
}

/** Returns samples at 48 kHz from PCM16 at 16 kHz by linear interpolation, beginning at the last sample of the frame before. */
function upsample(pcm, last) {
  const samples = new Float32Array(pcm.length * PCM_FACTOR);
  for (let i = 0; i < pcm.length; ++i) {
    const from = i ? pcm[i - 1] / 32768 : last,
      to = pcm[i] / 32768;
    for (let k = 0; k < PCM_FACTOR; ++k) samples[PCM_FACTOR * i + k] = from + ((to - from) * (k + 1)) / PCM_FACTOR;
  }
  return samples;
}

/** A source of sound. The panner makes loudness fall with 1/d; a gain fades it to zero at the end of hearing reach. */
class Source {
  constructor(context, law) {
    [this.reference, this.reach, this.fade] = law;
    this.panner = new PannerNode(context, {
      panningModel: "equalpower",
      distanceModel: "inverse",
      refDistance: this.reference,
      rolloffFactor: 1,
      maxDistance: 1e6,
    });
    this.end = new GainNode(context, { gain: 0 });
    this.panner.connect(this.end).connect(context.destination);
    this.place = [0, 0, 0];
  }

  put(place) {
    this.place = place;
    [this.panner.positionX.value, this.panner.positionY.value, this.panner.positionZ.value] = place;
  }

  /** `ear`: position [3] of the listener. */
  update(ear) {
    const distance = Math.hypot(...this.place.map((value, axis) => value - ear[axis]));
    this.end.gain.value = Math.min(1, Math.max(0, (this.reach - distance) / this.fade));
  }

  close() {
    this.end.disconnect();
  }
}

/** The voice of one speaker: decodes its frames and plays them at the speaker's position. */
class Speaker extends Source {
  constructor(context, law) {
    super(context, law);
    this.player = new AudioWorkletNode(context, "player", { numberOfInputs: 0, outputChannelCount: [1] });
    this.player.connect(this.panner);
    this.counts = { stalls: 0, cut: 0 };
    this.player.port.onmessage = ({ data }) => {
      this.counts = data;
    };
    this.last = 0;
    this.received = this.lost = 0;
    this.heardAt = performance.now();
  }

  take(codec, number, bytes) {
    this.heardAt = performance.now();
    if (this.number !== undefined) this.lost += Math.min((number - this.number + 65535) % 65536, 1000);
    this.number = number;
    this.received += 1;
    if (codec === PCM16) {
      const pcm = new Int16Array(bytes.slice().buffer);
      this.play(upsample(pcm, this.last));
      this.last = pcm[pcm.length - 1] / 32768;
    } else this.decode(bytes);
  }

  decode(bytes) {
    if (!this.decoder || this.decoder.state === "closed") {
      this.decoder = new AudioDecoder({
        error: () => {},
        output: (data) => {
          const samples = new Float32Array(data.numberOfFrames);
          data.copyTo(samples, { planeIndex: 0, format: "f32-planar" });
          data.close();
          this.play(samples);
        },
      });
      this.decoder.configure({ codec: "opus", sampleRate: RATE, numberOfChannels: 1 });
    }
    this.decoder.decode(new EncodedAudioChunk({ type: "key", timestamp: 20000 * this.received, data: bytes }));
  }

  play(samples) {
    this.player.port.postMessage(samples, [samples.buffer]);
  }

  close() {
    super.close();
    this.player.disconnect();
    if (this.decoder && this.decoder.state !== "closed") this.decoder.close();
  }
}

/** The tone of a robot's lights. */
class Tone extends Source {
  constructor(context, law) {
    super(context, law);
    this.oscillator = new OscillatorNode(context);
    this.level = new GainNode(context, { gain: 0 });
    this.oscillator.connect(this.level).connect(this.panner);
    this.oscillator.start();
  }

  sound(frequency, level) {
    if (frequency) this.oscillator.frequency.value = frequency;
    this.level.gain.setTargetAtTime(frequency ? level : 0, this.level.context.currentTime, 0.003);
  }

  close() {
    super.close();
    this.oscillator.stop();
  }
}

export class Voice {
  constructor() {
    this.speakers = new Map();
    this.tones = new Map();
    this.status = { objection: "", send: [], law: [1, 25, 5], tones: {} };
    this.counts = { sent: 0, received: 0 };
    this.context = this.socket = this.microphone = null;
    this.opus = false;
    const panel = document.getElementById("sound");
    [this.hearing, this.speaking] = panel.querySelectorAll("button");
    this.text = panel.querySelector("span");
    this.hearing.addEventListener("click", () => {
      this.toggleHearing();
      this.hearing.blur();
    });
    this.speaking.addEventListener("click", () => {
      this.toggleSpeaking();
      this.speaking.blur();
    });
    addEventListener("keydown", (event) => {
      if (event.code === "KeyM" && !event.repeat) this.toggleSpeaking();
    });
  }

  press(button, isOn) {
    button.setAttribute("aria-pressed", String(isOn));
  }

  say(text) {
    this.text.textContent = text;
  }

  async toggleHearing() {
    if (!this.context) return this.hear();
    if (this.context.state === "running") await this.context.suspend();
    else await this.context.resume();
    this.press(this.hearing, this.context.state === "running");
  }

  /** Begin to hear, which browsers allow only after a click or a key. Returns whether it works. */
  async hear() {
    if (this.context) {
      await this.context.resume();
      return true;
    }
    if (!isSecureContext || !window.AudioWorkletNode) {
      this.say("sound needs https or this machine itself: start the client with --page-lan and open its address");
      return false;
    }
    // the shortest buffers: 11 ms to the ear in Chromium 156, 42 ms with "interactive"
    const context = new AudioContext({ sampleRate: RATE, latencyHint: 0 });
    await context.audioWorklet.addModule("voice_worklet.js");
    this.opus = await hasOpus();
    this.context = context;
    await context.resume();
    this.press(this.hearing, true);
    this.connect();
    return true;
  }

  connect() {
    this.socket = new WebSocket(socketAddress("voice"));
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.socket.send(JSON.stringify({ opus: this.opus }));
    this.socket.onmessage = ({ data }) => (typeof data === "string" ? this.obey(JSON.parse(data)) : this.take(data));
    this.socket.onclose = () => setTimeout(() => this.connect(), RETRY);
  }

  /** Handle a text from the client: whether this page may speak, which kinds of frames it must send, which lights sound. */
  obey(status) {
    this.status = status;
    if (this.microphone) this.say(status.objection);
    for (const [name, tone] of this.tones)
      if (!(name in status.tones)) {
        tone.close();
        this.tones.delete(name);
      }
    for (const [name, [frequency, level, ...place]] of Object.entries(status.tones)) {
      if (!this.tones.has(name)) this.tones.set(name, new Tone(this.context, status.law));
      this.tones.get(name).put(place);
      this.tones.get(name).sound(frequency, level);
    }
  }

  /** Handle a frame of a speaker. */
  take(message) {
    const view = new DataView(message),
      length = view.getUint8(1);
    const place = [4, 8, 12].map((at) => view.getFloat32(at, true));
    const name = new TextDecoder().decode(new Uint8Array(message, 16, length));
    if (!this.speakers.has(name)) this.speakers.set(name, new Speaker(this.context, this.status.law));
    const speaker = this.speakers.get(name);
    speaker.put(place);
    speaker.take(view.getUint8(0), view.getUint16(2, true), new Uint8Array(message, 16 + length));
    this.counts.received += 1;
  }

  /** Called for every picture: set the pose [7] of the ears, x forward and z up. */
  listen(pose) {
    if (!this.context) return;
    const listener = this.context.listener,
      [x, y, z, w] = pose.slice(3);
    const ahead = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)];
    const up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
    ["X", "Y", "Z"].forEach((axis, k) => {
      listener[`position${axis}`].value = pose[k];
      listener[`forward${axis}`].value = ahead[k];
      listener[`up${axis}`].value = up[k];
    });
    const now = performance.now();
    for (const [name, speaker] of this.speakers)
      if (now - speaker.heardAt > SILENCE) {
        speaker.close();
        this.speakers.delete(name);
      }
    for (const source of [...this.speakers.values(), ...this.tones.values()]) source.update(pose.slice(0, 3));
  }

  async toggleSpeaking() {
    if (this.microphone) {
      this.microphone.stream.getTracks().forEach((track) => {
        track.stop();
      });
      this.microphone.source.disconnect();
      this.microphone = null;
      this.press(this.speaking, false);
      this.say("");
      return;
    }
    if (!(await this.hear())) return;
    try {
      await this.open();
    } catch (failure) {
      this.say(explain(failure));
      return;
    }
    this.press(this.speaking, true);
    this.say(this.status.objection);
  }

  async open() {
    const stream = await navigator.mediaDevices.getUserMedia({
      audio: {
        channelCount: 1,
        echoCancellation: true,
        noiseSuppression: true,
        autoGainControl: true,
      },
    });
    const source = new MediaStreamAudioSourceNode(this.context, { mediaStream: stream });
    const capture = new AudioWorkletNode(this.context, "capture", { numberOfOutputs: 0 });
    source.connect(capture);
    const downsampler = new Downsampler();
    let number = 0;
    if (this.opus && !this.encoder) {
      this.encoder = new AudioEncoder({
        error: () => {
          this.opus = false;
        },
        output: (chunk) => {
          const data = new Uint8Array(chunk.byteLength);
          chunk.copyTo(data);
          this.send(OPUS, data);
        },
      });
      this.encoder.configure(encoderConfig());
    }
    capture.port.onmessage = ({ data }) => {
      const { send } = this.status,
        wantsMain = send.includes("main"),
        wantsPcm = send.includes("pcm");
      if (wantsMain && this.opus) {
        const sound = new AudioData({
          format: "f32-planar",
          sampleRate: RATE,
          numberOfFrames: FRAME,
          numberOfChannels: 1,
          timestamp: 20000 * number++,
          data,
        });
        this.encoder.encode(sound);
        sound.close();
      }
      if (wantsPcm || (wantsMain && !this.opus)) this.send(PCM16 + (this.opus ? EXTRA : 0), downsampler.take(data));
    };
    stream.getTracks()[0].onended = () => {
      if (this.microphone) this.toggleSpeaking();
      this.say("the microphone is gone");
    };
    this.microphone = { stream, source };
  }

  send(codec, data) {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    const message = new Uint8Array(1 + data.length);
    message[0] = codec;
    message.set(data, 1);
    this.socket.send(message);
    this.counts.sent += 1;
  }
}

const encoderConfig = () => ({
  codec: "opus",
  sampleRate: RATE,
  numberOfChannels: 1,
  bitrate: BITRATE,
  opus: { frameDuration: 20000, usedtx: true },
});

async function hasOpus() {
  try {
    const able = await Promise.all([
      AudioEncoder.isConfigSupported(encoderConfig()),
      AudioDecoder.isConfigSupported({ codec: "opus", sampleRate: RATE, numberOfChannels: 1 }),
    ]);
    return able.every((one) => one.supported);
  } catch {
    return false;
  }
}

/** Return a sentence that explains to the user why the microphone does not work. */
function explain(failure) {
  const sentences = {
    NotFoundError: "no microphone was found: connect one, then press speak again",
    NotAllowedError: "the browser does not let this page use the microphone: allow it at the address bar",
    NotReadableError: "the microphone is in use by another program, or switched off",
  };
  return sentences[failure?.name] ?? `the microphone does not work: ${failure?.message ?? failure}`;
}

// Text at the left wrist of a person in a headset: intentions to choose from, and the newest sentence of the page.

import * as THREE from "./vendor/three.module.js";

const WIDTH = 0.16,
  PIXELS = 512,
  LINE = 38; // m; px wide and of a line
const LETTERS = 28; // letters in a line
const NOTHING = "nothing";

export class Wrist {
  /** `carrier`: group that moves with the left hand; `intentions`: intentions that a person may indicate. */
  constructor(carrier, intentions) {
    this.intentions = ["", ...intentions];
    this.lines = []; // the shown lines: text, and whether the line is the chosen intention
    this.canvas = document.createElement("canvas");
    this.canvas.width = PIXELS;
    this.canvas.height = LINE * (this.intentions.length + 5);
    this.texture = new THREE.CanvasTexture(this.canvas);
    const height = (WIDTH * this.canvas.height) / PIXELS;
    this.panel = new THREE.Mesh(
      new THREE.PlaneGeometry(WIDTH, height),
      new THREE.MeshBasicMaterial({ map: this.texture, transparent: true, toneMapped: false }),
    );
    this.panel.position.set(0, 0.03 + height / 2, 0);
    carrier.rotation.x = -0.6; // tilted towards the eyes
    carrier.add(this.panel);
    this.panel.visible = false;
  }

  /** Returns the intention that follows another one in the list; after the last one, an empty string. */
  after(intention) {
    return this.intentions[(this.intentions.indexOf(intention) + 1) % this.intentions.length];
  }

  /** Show the `chosen` intention and the sentence that was `said`; hide the text if both are empty. */
  show(chosen, said) {
    this.panel.visible = Boolean(chosen || said);
    const choice = chosen ? this.intentions.map((one) => [one || NOTHING, one === chosen]) : [];
    const lines = [...choice, ...wrapped(said).map((line) => [line, false])];
    if (JSON.stringify(lines) === JSON.stringify(this.lines)) return;
    this.lines = lines;
    const context = this.canvas.getContext("2d");
    context.clearRect(0, 0, PIXELS, this.canvas.height);
    context.fillStyle = "#000b";
    context.fillRect(0, this.canvas.height - LINE * (lines.length + 0.5), PIXELS, this.canvas.height);
    context.font = `${Math.round(0.75 * LINE)}px system-ui, sans-serif`;
    lines.forEach(([text, isChosen], k) => {
      const bottom = this.canvas.height - LINE * (lines.length - 1 - k + 0.4);
      if (isChosen) {
        context.fillStyle = "#b85c00";
        context.fillRect(0, bottom - 0.8 * LINE, PIXELS, LINE);
      }
      context.fillStyle = "#fff";
      context.fillText(text, 0.4 * LINE, bottom);
    });
    this.texture.needsUpdate = true;
  }
}

/** Returns the lines of a sentence, at most four. */
function wrapped(sentence) {
  const lines = [];
  for (const word of sentence.split(" ")) {
    if (!word) continue;
    if (lines.length && lines.at(-1).length + word.length < LETTERS) lines.push(`${lines.pop()} ${word}`);
    else lines.push(word);
  }
  return lines.length > 4 ? [...lines.slice(0, 3), `${lines[3]} ...`] : lines;
}

// The timeline of a recording: pause, seek to any time, change the speed.

const SPEEDS = [0.25, 0.5, 1, 2, 4];

export class Timeline {
  /** `status` as in every state of a recording; `ask` is called with the user's command. */
  constructor(status, ask) {
    this.ask = ask;
    this.panel = document.getElementById("timeline");
    this.panel.hidden = false;
    this.button = this.panel.querySelector("button");
    this.slider = this.panel.querySelector("input");
    this.speed = this.panel.querySelector("select");
    this.text = this.panel.querySelector("span");
    this.isHeld = false; // whether the user holds the slider
    for (const speed of new Set([...SPEEDS, status.speed].sort((a, b) => a - b)))
      this.speed.append(new Option(`${speed} x`, speed));
    this.button.addEventListener("click", () => {
      this.tell({ paused: !this.status.paused });
      this.button.blur();
    });
    this.speed.addEventListener("change", () => {
      this.tell({ speed: Number(this.speed.value) });
      this.speed.blur();
    });
    this.slider.addEventListener("input", () => {
      this.isHeld = true;
      this.write(Number(this.slider.value));
    });
    this.slider.addEventListener("change", () => {
      this.isHeld = false;
      this.tell({ seek: Number(this.slider.value) });
      this.slider.blur(); // so that keys move the viewpoint again
    });
    this.show(status);
  }

  tell(wish) {
    const { paused, speed } = { ...this.status, ...wish };
    this.ask({ paused, speed, seek: wish.seek ?? null });
  }

  /** Called when a state has arrived. Returns whether the recording has jumped to another time. */
  show(status) {
    const jumped = this.status !== undefined && status.jumps !== this.status.jumps;
    this.status = status;
    this.button.textContent = status.paused ? "play" : "pause";
    this.slider.max = status.length;
    if (!this.isHeld) {
      this.slider.value = status.position;
      this.write(status.position);
    }
    if (document.activeElement !== this.speed) this.speed.value = status.speed;
    return jumped;
  }

  write(position) {
    this.text.textContent = `${position.toFixed(1)} / ${this.status.length.toFixed(1)} s`;
  }
}

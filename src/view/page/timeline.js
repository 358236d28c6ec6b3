// Time: play, pause, loop, speed, scrub.

export class TimeLine {
  // Of a whole clip of so many seconds; on.time(time) is called when it changes.
  constructor(elements, seconds, on) {
    Object.assign(this, elements, { seconds, on, time: 0, playing: false });
    this.slider.addEventListener("input", () => this.set(Number(this.slider.value)));
    this.button.addEventListener("click", () => this.toggle());
  }

  set(time) {
    this.time = Math.min(Math.max(time, 0), 1);
    this.slider.value = this.time;
    this.text.textContent = this.time.toFixed(3);
    this.on.time(this.time);
  }

  step(by) {
    this.pause();
    this.set(this.time + by);
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  play() {
    this.playing = true;
    if (this.time >= 1) this.set(0);
    this.show();
    let last = performance.now();
    const tick = (now) => {
      if (!this.playing) return;
      // A tab that slept goes on where it was.
      const passed = Math.min(now - last, 250) / 1000;
      last = now;
      const time = this.time + (passed * Number(this.speed.value)) / this.seconds;
      if (time >= 1 && !this.loop.checked) this.pause();
      this.set(time >= 1 && this.loop.checked ? time % 1 : time);
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  pause() {
    this.playing = false;
    this.show();
  }

  show() {
    this.button.textContent = this.playing ? "Pause" : "Play";
    this.button.setAttribute("aria-pressed", String(this.playing));
  }
}

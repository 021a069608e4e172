// Controls of the animated road; requires a browser.


class Player {
  constructor(box, run) {
    this.run = run;
    this.t = run.start_s;
    this.follow = null;
    this.playing = false;
    this.pace = 2;
    const canvas = box.querySelector("canvas");
    this.painter = new laneweaveRoad.Painter(canvas, run);
    this.addListeners(box);
    new ResizeObserver(() => this.draw()).observe(canvas);
    this.draw();
  }

  addListeners(box) {
    const part = (name) => box.querySelector(`[data-part=${name}]`);
    this.button = part("play");
    this.slider = part("time");
    this.output = part("now");
    this.slider.max = this.run.end_s;
    this.button.addEventListener("click", () => this.toggle());
    this.slider.addEventListener("input", () => {
      this.t = Number(this.slider.value);
      this.draw();
    });
    part("pace").addEventListener("change", (event) => {
      this.pace = Number(event.target.value);
    });
    this.view = part("view");
    this.choices = [];
    for (const event of ["pointerdown", "focus"]) this.view.addEventListener(event, () => this.listViews());
    this.view.addEventListener("change", () => {
      this.follow = this.choices[this.view.selectedIndex - 1] ?? null;
      this.draw();
    });
    this.listViews();
  }

  /** List what is on the road as options of the view, and what is followed. */
  listViews() {
    const { follow } = this;
    this.choices = laneweave.followable(this.run, this.t);
    let chosen = this.choices.findIndex(({ name }) => name === follow?.name);
    if (follow && chosen < 0) {
      this.choices.unshift(follow);
      chosen = 0;
    }
    const options = this.choices.map(({ name }) => new Option(`follow ${name}`));
    this.view.replaceChildren(new Option("whole road"), ...options);
    this.view.selectedIndex = chosen + 1;
  }

  toggle() {
    this.playing = !this.playing;
    this.button.textContent = this.playing ? "Pause" : "Play";
    if (!this.playing) return;
    if (this.t >= this.run.end_s) this.t = 0;
    let before = performance.now();
    const frame = (now) => {
      if (!this.playing) return;
      this.t = Math.min(this.run.end_s, this.t + (this.pace * (now - before)) / 1000);
      before = now;
      this.draw();
      if (this.t >= this.run.end_s) this.toggle();
      else requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  draw() {
    const { run } = this;
    const present = laneweave.allAt(run, this.t);
    const bodies = present.map(([vehicle, state]) => ({ ...state, name: vehicle.name, lane: vehicle.lane, type: vehicle.type }));
    const width = this.painter.canvas.clientWidth;
    const stretches = laneweave.stretches(run, this.follow, this.t, width);
    const followed = this.follow?.vehicle?.name ?? null;
    this.painter.paint(stretches, bodies, [laneweaveClosed.closedParts], followed);
    this.slider.value = this.t;
    const mean = present.reduce((sum, [, state]) => sum + state.v, 0) / (present.length || 1);
    const speed = present.length ? `, mean ${mean.toFixed(1)} m/s` : "";
    this.output.textContent = `${this.t.toFixed(1)} s: ${present.length} vehicle${present.length === 1 ? "" : "s"}${speed}`;
  }
}

for (const box of document.querySelectorAll(".player")) {
  const data = document.getElementById(box.dataset.animation);
  new Player(box, laneweave.decode(JSON.parse(data.textContent)));
}

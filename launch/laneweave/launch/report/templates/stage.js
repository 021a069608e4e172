// Drawing and controls of the moving road: what needs a browser.

const ACROSS = 1.8; // roads are drawn this much wider than they are
const WINDOW_M = 150; // of road that is shown when something is followed
const MOST_FOLLOWED = 400;
const ABOVE_PX = 13; // for names of vehicles on the left lane
const GAP_PX = 30; // between two stretches, for the numbers of metres

class Stage {
  constructor(box, run) {
    this.run = run;
    this.t = run.start_s;
    this.follow = null;
    this.playing = false;
    this.pace = 2;
    this.canvas = box.querySelector("canvas");
    this.wire(box);
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    this.draw();
  }

  wire(box) {
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
    const choices = laneweave.followable(this.run, MOST_FOLLOWED);
    const view = part("view");
    for (const choice of choices) view.add(new Option(`follow ${choice.name}`));
    view.addEventListener("change", () => {
      this.follow = view.selectedIndex > 0 ? choices[view.selectedIndex - 1] : null;
      if (this.follow) this.t = laneweave.arrivalTime(this.run, this.follow);
      this.draw();
    });
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
    const { run, canvas } = this;
    const width = canvas.clientWidth;
    if (width === 0) return;
    const strips = laneweave.stretches(run, this.follow, this.t, WINDOW_M);
    const scale = width / (strips[0][1] - strips[0][0]);
    const roadPx = run.road.lanes * run.road.lane_width_m * scale * ACROSS;
    const height = Math.ceil(strips.length * (roadPx + GAP_PX) + ABOVE_PX);
    const ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
      canvas.style.height = `${height}px`;
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const everybody = laneweave.allAt(run, this.t);
    strips.forEach((stretch, number) => {
      pen.save();
      pen.translate(0, ABOVE_PX + number * (roadPx + GAP_PX));
      this.drawStretch(pen, stretch, scale, width, roadPx, everybody);
      pen.restore();
    });
    this.slider.value = this.t;
    const mean = everybody.reduce((sum, [, state]) => sum + state.v, 0) / (everybody.length || 1);
    const speed = everybody.length ? `, mean ${mean.toFixed(1)} m/s` : "";
    this.output.textContent = `${this.t.toFixed(1)} s: ${everybody.length} vehicles${speed}`;
  }

  drawStretch(pen, [from, to], scale, width, roadPx, everybody) {
    const { road } = this.run;
    const x = (s) => (s - from) * scale;
    const y = (place) => roadPx - place * scale * ACROSS;
    pen.fillStyle = "#e9eaec";
    pen.fillRect(0, 0, width, roadPx);
    pen.strokeStyle = "#ffffff";
    pen.lineWidth = 2;
    // Dashes belong to the road: they move with it.
    pen.setLineDash([6 * scale, 6 * scale]);
    pen.lineDashOffset = from * scale;
    for (let lane = 1; lane < road.lanes; lane += 1) {
      this.line(pen, 0, y(lane * road.lane_width_m), width, y(lane * road.lane_width_m));
    }
    pen.setLineDash([]);
    pen.strokeStyle = "#9aa0a8";
    this.line(pen, 0, 1, width, 1);
    this.line(pen, 0, roadPx - 1, width, roadPx - 1);
    if (road.sorting_start_m > from && road.sorting_start_m < to) {
      pen.strokeStyle = "#30343a";
      pen.setLineDash([3, 3]);
      pen.lineDashOffset = 0;
      this.line(pen, x(road.sorting_start_m), 0, x(road.sorting_start_m), roadPx);
      pen.setLineDash([]);
    }
    this.drawMetres(pen, from, to, x, roadPx);
    pen.beginPath();
    pen.rect(0, -ABOVE_PX, width, roadPx + ABOVE_PX);
    pen.clip();
    for (const [vehicle, state] of everybody) {
      const rear = state.s - this.run.body_m[0];
      if (state.s >= from && rear <= to) this.drawVehicle(pen, vehicle, state, x, y, scale);
    }
  }

  drawMetres(pen, from, to, x, roadPx) {
    const every = to - from > 400 ? 100 : to - from > 200 ? 50 : 20;
    pen.fillStyle = "#6a7078";
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "top";
    for (let mark = Math.ceil(from / every) * every; mark <= to; mark += every) {
      pen.fillRect(x(mark) - 0.5, roadPx, 1, 4);
      pen.textAlign = mark - from < 10 ? "left" : to - mark < 10 ? "right" : "center";
      pen.fillText(`${mark} m`, x(mark), roadPx + 6);
    }
  }

  drawVehicle(pen, vehicle, state, x, y, scale) {
    const { run } = this;
    const [length, width] = run.body_m;
    const heading = Math.atan(state.slope);
    const [along, across] = [Math.cos(heading), Math.sin(heading)];
    const [centreS, centreY] = [state.s - 0.5 * length * along, state.y];
    const path = (rear, front, half) => {
      pen.beginPath();
      for (const [u, v] of [[rear, -half], [front, -half], [front, half], [rear, half]]) {
        const [a, b] = [u * length, v * width];
        pen.lineTo(x(centreS + a * along - b * across), y(centreY + a * across + b * along));
      }
      pen.closePath();
    };
    const colour = run.colours[vehicle.lane % run.colours.length];
    const { span_mps: span, strength } = run.shade;
    pen.fillStyle = laneweave.shade(colour, state.v - run.lattice.speed_mps, span, strength);
    pen.strokeStyle = "#30343a";
    pen.lineWidth = 0.8;
    path(-0.5, 0.5, 0.5);
    pen.fill();
    pen.stroke();
    pen.fillStyle = "rgba(255,255,255,.7)";
    path(0.12, 0.3, 0.36);
    pen.fill();
    if (scale > 6) {
      pen.fillStyle = "#30343a";
      pen.font = "10px system-ui, sans-serif";
      pen.textAlign = "center";
      pen.textBaseline = "bottom";
      pen.fillText(vehicle.name, x(centreS), y(centreY + 0.5 * width) - 2);
    }
  }

  line(pen, fromX, fromY, toX, toY) {
    pen.beginPath();
    pen.moveTo(fromX, fromY);
    pen.lineTo(toX, toY);
    pen.stroke();
  }
}

for (const box of document.querySelectorAll(".player")) {
  const data = document.getElementById(box.dataset.animation);
  new Stage(box, laneweave.decode(JSON.parse(data.textContent)));
}

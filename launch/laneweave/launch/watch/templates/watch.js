"use strict";
// The page: connection, controls, figures. Tests read its counters in `window.laneweaveWatch`.

const PAINT_MS = 28; // minimum time between two repaints
const NUMBERS_MS = 200; // minimum time between two updates of the figures
const AHEAD = 40; // frames fetched in advance
const NBSP = "\u00a0"; // between a number and its unit
const RETRY_MS = [300, 600, 1200, 2500];
const PACES = [0.5, 1, 2, 5, 10];
const CALM = matchMedia("(prefers-reduced-motion: reduce)");
const NIGHT = matchMedia("(prefers-color-scheme: dark)");

const part = (id) => document.getElementById(id);
const clockTime = (seconds) => new Date(seconds * 1000).toLocaleTimeString([], { hour12: false });

class Watch {
  constructor() {
    this.store = new laneweaveFrames.FrameStore();
    this.painter = null;
    this.follow = null; // {vehicle} or {formation}
    this.place = null; // number of the shown frame, with a fraction; null: the newest
    this.playing = false; // recorded only
    this.pace = 1;
    this.stale = true; // repaint even if the time has not changed
    this.painted = 0;
    this.counted = -Infinity; // the first picture comes with its numbers
    this.tries = 0;
    this.offlineSince = null;
    this.arrived = 0;
    this.stats = { frames: 0, shown: 0, paints: 0, firstFrameMs: null };
    this.lastShown = null;
    this.addListeners();
    this.connect();
    requestAnimationFrame((now) => this.animate(now));
  }

  get live() {
    return this.store.scene !== null && this.store.scene.kind === "live";
  }

  // --- the connection ---------------------------------------------------------------------------

  connect() {
    const socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/stream`);
    this.socket = socket;
    socket.onmessage = (event) => this.take(event.data);
    socket.onclose = () => {
      if (this.store.end !== null) return;
      this.offlineSince ??= Date.now() / 1000;
      this.store.waiting = false;
      this.showStatus();
      const delay = RETRY_MS[Math.min(this.tries, RETRY_MS.length - 1)];
      this.tries += 1;
      setTimeout(() => this.connect(), delay);
    };
  }

  take(text) {
    const what = this.store.take(text);
    if (what === "scene") {
      this.tries = 0;
      this.offlineSince = null;
      this.begin();
    } else if (what === "frame") {
      const now = performance.now();
      this.interval = Math.min(250, Math.max(40, now - this.arrived));
      this.arrived = now;
      this.stats.frames += 1;
    } else if (what === "end") {
      this.showStatus();
    }
    this.stale = true;
  }

  ask(ahead) {
    const missing = this.place === null ? null : this.store.missing(this.place, ahead);
    if (missing && this.socket.readyState === WebSocket.OPEN) {
      this.socket.send(JSON.stringify({ want: missing }));
    } else if (missing) {
      this.store.waiting = false;
    }
  }

  // --- controls ---------------------------------------------------------------------------------

  begin() {
    const { scene } = this.store;
    this.painter = new laneweaveRoad.Painter(part("road"), scene, this.theme());
    document.title = `${scene.title} · laneweave`;
    part("title").textContent = scene.title;
    part("cells-name").textContent = this.live || scene.has_formations ? "cells" : "hold cells";
    part("sorted").parentElement.hidden = !scene.preferences;
    part("paces").hidden = this.live;
    if (!this.live && this.place === null) {
      this.place = this.store.first;
      this.playing = !CALM.matches;
    }
    if (this.live && this.place !== null && this.place > this.store.last) this.place = null;
    this.showLegend();
    this.showButton();
  }

  addListeners() {
    part("pause").addEventListener("click", () => this.toggle());
    part("slider").addEventListener("input", (event) => {
      this.place = Number(event.target.value);
      if (this.live && this.place >= this.store.last) this.place = null;
      this.showButton();
      this.stale = true;
    });
    const pace = part("pace");
    for (const one of PACES) pace.add(new Option(`${one}x`, one, one === 1, one === 1));
    pace.addEventListener("change", () => (this.pace = Number(pace.value)));
    const view = part("view");
    for (const event of ["pointerdown", "focus"]) view.addEventListener(event, () => this.listViews());
    view.addEventListener("change", () => this.setFollowed(view.value));
    for (const box of ["cells", "targets"]) {
      part(box).addEventListener("change", () => (this.stale = true));
    }
    part("road").addEventListener("click", (event) => this.followAt(event));
    document.addEventListener("keydown", (event) => {
      const typing = event.target.closest?.("button, select, input[type=checkbox]");
      if (event.key === " " && !typing) {
        event.preventDefault();
        this.toggle();
      } else if (event.key === "Escape") {
        this.setFollowed("");
      }
    });
    new ResizeObserver(() => (this.stale = true)).observe(part("road"));
    NIGHT.addEventListener("change", () => {
      if (this.painter) this.painter.theme = this.theme();
      this.stale = true;
    });
  }

  theme() {
    return NIGHT.matches ? laneweaveRoad.DARK : laneweaveRoad.LIGHT;
  }

  toggle() {
    if (this.live) {
      this.place = this.place === null ? this.store.last : null;
    } else {
      if (!this.playing && this.place >= this.store.last) this.place = this.store.first;
      this.playing = !this.playing;
    }
    this.stale = true;
    this.showButton();
  }

  showButton() {
    const running = this.live ? this.place === null : this.playing;
    part("pause").textContent = running ? "Pause" : this.live ? "Go live" : "Play";
  }

  /** List the formations and vehicles that can be followed as options of the view. */
  listViews() {
    const { bodies } = this.picture ?? { bodies: [] };
    const shown = laneweaveLayers.groups(this.current?.formations ?? [], []);
    const formations = shown.map(({ numbers }) => `formation ${numbers[0]}`);
    const names = [...formations, ...bodies.map((body) => body.name).sort()];
    const view = part("view");
    const chosen = view.value;
    if (chosen && !names.includes(chosen)) names.unshift(chosen);
    const options = names.map((name) => new Option(`follow ${name}`, name));
    view.replaceChildren(new Option("whole road", ""), ...options);
    view.value = chosen;
  }

  setFollowed(name) {
    const formation = /^formation (\d+)$/.exec(name);
    this.follow = formation ? { formation: Number(formation[1]) } : name ? { vehicle: name } : null;
    this.columns = null; // of the followed formation, once it was seen
    const view = part("view");
    view.value = name;
    if (view.value !== name) {
      this.listViews();
      view.add(new Option(`follow ${name}`, name));
      view.value = name;
    }
    this.stale = true;
  }

  /** Follow the vehicle under the pointer. */
  followAt(event) {
    const place = this.painter?.placeAt(event.offsetX, event.offsetY);
    if (!place || !this.picture) return;
    const hit = this.picture.bodies.find((body) => {
      const [length, width] = laneweaveRoad.sizeOf(this.store.scene, body);
      return Math.abs(place.s - body.s + length / 2) < length && Math.abs(place.y - body.y) < width;
    });
    if (hit) this.setFollowed(hit.name);
  }

  // --- the picture ------------------------------------------------------------------------------

  /** Return what to show: [frame, next frame, fraction between them]; null: nothing yet. */
  moment(now) {
    const { store } = this;
    if (this.place === null) {
      if (!store.newest) return null;
      if (!store.before || CALM.matches) return [store.newest, null, 0];
      const share = Math.min(1, (now - this.arrived) / this.interval);
      return [store.before, store.newest, share];
    }
    const from = Math.floor(this.place);
    const frame = store.get(from) ?? store.get(from - 1);
    return frame ? [frame, store.get(from + 1), this.place - from] : null;
  }

  animate(now) {
    requestAnimationFrame((next) => this.animate(next));
    if (!this.painter || now - this.painted < PAINT_MS) return;
    if (this.playing) this.advance((now - this.painted) / 1000);
    this.painted = now;
    if (this.place !== null) this.place = Math.max(this.place, this.store.first);
    if (this.place !== null) this.ask(this.playing ? AHEAD : 1);
    const moment = this.moment(now);
    if (!moment) return;
    const settled = moment[2] >= 1 || moment[2] === 0;
    if (!this.stale && settled && !this.playing && this.settled) return;
    this.settled = settled;
    this.stale = false;
    this.paint(moment);
    if (now - this.counted > NUMBERS_MS || this.place !== null) {
      this.counted = now;
      this.showNumbers(this.current);
    }
  }

  /** Advance the playback if the next frames have arrived. */
  advance(seconds) {
    const { store } = this;
    const next = this.place + (this.pace * Math.min(seconds, 0.2)) / store.scene.step_s;
    const there = Math.min(store.last, Math.floor(next) + 1);
    if (store.get(there) === null) return;
    this.place = Math.min(store.last, next);
    if (this.place >= store.last) {
      this.playing = false;
      this.showButton();
    }
    this.stale = true;
  }

  paint([frame, next, share]) {
    const { painter } = this;
    const { scene } = this.store;
    this.current = next && share >= 0.5 ? next : frame;
    const picture = laneweaveFrames.between(frame, next, share);
    this.picture = picture;
    const { t, bodies } = picture;
    const { parts, others } = this.current;
    const layers = [laneweaveClosed.closedParts, laneweaveClosed.temporary(parts, others)];
    if (t !== null) {
      const { formations, joined } = this.current;
      layers.push(laneweaveLayers.blocks(formations, joined, t));
      if (part("cells").checked) layers.push(laneweaveLayers.cells(bodies, t));
      if (part("targets").checked) layers.push(laneweaveLayers.targets(bodies, t));
      layers.push(laneweaveLayers.marks(bodies));
    }
    painter.paint(this.strips(scene, picture), bodies, layers, this.follow?.vehicle ?? null);
    this.stats.paints += 1;
    const shown = next ? next.n : frame.n;
    if (shown !== this.lastShown) {
      this.lastShown = shown;
      this.stats.shown += 1;
      this.stats.firstFrameMs ??= Math.round(performance.now());
    }
  }

  strips(scene, { t, bodies }) {
    const length = scene.road.length_m;
    const width = part("road").clientWidth;
    const whole = laneweaveRoad.wholeRoad(length, width);
    if (!this.follow || t === null) return whole;
    if (this.follow.vehicle) {
      const body = bodies.find((one) => one.name === this.follow.vehicle);
      this.centre = body ? body.s : (this.centre ?? length);
    } else {
      const found = this.current.formations.find(([number]) => number === this.follow.formation);
      if (found) this.columns = found.slice(1);
      if (!this.columns) return whole;
      const [rear, front] = laneweaveRoad.columnsAt(scene, ...this.columns, t);
      this.centre = (rear + front) / 2;
    }
    return [laneweaveRoad.windowAround(length, this.centre, width)];
  }

  // --- numbers ----------------------------------------------------------------------------------

  showNumbers(frame) {
    const { store } = this;
    const { scene } = store;
    const { inLane, knownLane, speed } = laneweaveFrames.facts(scene, this.picture.bodies);
    const setText = (id, text) => {
      const element = part(id);
      if (element.textContent !== text) element.textContent = text;
    };
    setText("time", frame.t === null ? "–" : `${frame.t.toFixed(1)} s`);
    setText("run", frame.run > 1 ? `run ${frame.run} since the server started` : "");
    const [demanded, entered, , left] = frame.counts ?? [0, 0, 0, 0];
    setText("count", frame.counts ? `${this.picture.bodies.length}` : "–");
    setText("counts", frame.counts ? `${entered} of ${demanded} entered, ${left}${NBSP}left` : "");
    setText("speed", speed === null ? "" : `mean speed ${speed.toFixed(1)}${NBSP}m/s`);
    setText("sorted", knownLane ? `${Math.round((100 * inLane) / knownLane)} %` : "–");
    setText("sorted-counts", knownLane ? `${inLane} of ${knownLane} vehicles` : "");
    // After the end of a run, nothing is missing.
    const ended = frame === store.newest && (store.end !== null || frame.status === "ended");
    const noLeader = ended ? "–" : "none";
    setText("leader", frame.leader ? `${frame.leader[0]}, term ${frame.leader[1]}` : noLeader);
    part("leader").classList.toggle("bad", !frame.leader && !ended);
    this.showCandidates(ended ? [] : frame.candidates);
    const [plannedAt, planned, took, solver, fallback] = frame.plan ?? [];
    const by = solver ? ` by ${solver}${fallback ? " (fallback)" : ""}` : "";
    setText("plan", frame.plan ? `${took.toFixed(1)} ms` : "–");
    setText("planned", frame.plan ? `${planned} vehicles${by}, at${NBSP}${plannedAt.toFixed(1)}${NBSP}s` : "");
    this.showNews(frame.news);
    this.showTime(frame, setText);
    this.showStatus();
  }

  showCandidates(candidates) {
    const key = JSON.stringify(candidates);
    if (key === this.candidatesKey) return;
    this.candidatesKey = key;
    const chips = candidates.map(([name, term, leading, silent]) => {
      const chip = document.createElement("span");
      chip.className = `chip${leading ? " leading" : ""}${silent ? " silent" : ""}`;
      chip.textContent = name;
      chip.title = `${silent ? "not heard from; " : leading ? "leader; " : "standby; "}term ${term}`;
      return chip;
    });
    part("candidates").replaceChildren(...chips);
  }

  showNews(news) {
    const key = JSON.stringify(news);
    if (key === this.newsKey) return;
    this.newsKey = key;
    const items = [...news].reverse().map(([t, process, kind, details]) => {
      const item = document.createElement("li");
      const when = document.createElement("b");
      when.textContent = `${t.toFixed(1)} s`;
      item.append(when, ` ${process}: ${kind.replaceAll("-", " ")}${details ? ` (${details})` : ""}`);
      return item;
    });
    part("news").replaceChildren(...items);
  }

  showTime(frame, setText) {
    const { store } = this;
    const slider = part("slider");
    slider.min = store.first;
    slider.max = Math.max(store.first, store.last);
    slider.value = this.place ?? store.last;
    const road = frame.t === null ? "no road" : `${frame.t.toFixed(1)} s`;
    let text = road;
    if (this.live && this.place !== null && store.newest) {
      text = `${road}, ${(store.newest.w - frame.w).toFixed(1)} s ago`;
    } else if (!this.live) {
      text = `${road} of ${(store.last * store.scene.step_s).toFixed(1)} s`;
    }
    setText("now", text);
    slider.setAttribute("aria-valuetext", text);
  }

  showStatus() {
    const frame = this.store.newest;
    let [pill, words] = ["connecting", ""];
    if (this.store.end !== null) {
      pill = "ended";
      words = this.store.end;
    } else if (this.offlineSince !== null) {
      pill = "offline";
      words = `Connection to the server lost at ${clockTime(this.offlineSince)}. Reconnecting.`;
    } else if (this.store.scene && !this.live) {
      pill = "recorded";
    } else if (frame) {
      pill = frame.status;
      const since = clockTime(frame.since);
      words = {
        lost: `Connection to the router lost at ${since}. Reconnecting.`,
        waiting: "Connected. No road yet: waiting for a bridge.",
        still: `The road clock stopped at ${since}.`,
        ended: `The run ended at ${since}${this.leftOf(frame)}. Waiting for the next one.`,
        live: "",
      }[pill];
      const findings = frame.findings ?? [];
      if (findings.length > 0 && pill !== "lost" && pill !== "ended") {
        if (pill === "live") pill = "problem";
        words = findings.map(([, what, advice]) => `${what}: ${advice}`).join("; ");
        words = `${words[0].toUpperCase()}${words.slice(1)}.`;
      }
    }
    const paused = this.live && this.place !== null && (pill === "live" || pill === "problem");
    const shown = { waiting: "no road", lost: "connection lost", still: "clock stopped" }[pill];
    part("pill").textContent = paused ? "paused" : (shown ?? pill);
    part("pill").dataset.status = paused ? "paused" : pill;
    const banner = part("banner");
    banner.hidden = !words;
    if (banner.textContent !== words) banner.textContent = words;
    banner.dataset.status = pill;
  }

  leftOf({ counts }) {
    return counts ? `: ${counts[3]} of ${counts[0]} vehicles left` : "";
  }

  showLegend() {
    const { legend, road, lattice, preferences, has_formations: hasFormations } = this.store.scene;
    const entry = (style, words) => {
      const span = document.createElement("span");
      if (style) {
        const sample = document.createElement("i");
        sample.className = style.kind;
        if (style.colour) sample.style.setProperty("--own", style.colour);
        span.append(sample);
      }
      span.append(words);
      return span;
    };
    const own = legend.map(([colour, words]) => entry({ kind: "car", colour }, words));
    const rest = [
      ...(preferences ? [entry(null, "number: preferred lane, 0 is the rightmost")] : []),
      entry(null, `darker: slower than ${lattice.speed_mps} m/s; lighter: faster`),
      entry({ kind: "cell" }, this.live && !hasFormations ? "cells that a vehicle owns; framed: its hold cell" : "hold cell of a vehicle"),
      entry({ kind: "target" }, "target of a vehicle"),
      ...(hasFormations ? [entry({ kind: "block" }, "columns of a formation, with its number")] : []),
    ];
    if (this.live) {
      rest.push(entry({ kind: "ghost" }, "not heard from: expected position"));
      rest.push(entry({ kind: "odd" }, "without agent, or overdue"));
    }
    if (road.sorting_start_m > 0 && road.sorting_start_m < road.length_m) {
      rest.push(entry({ kind: "sorting" }, road.sorting_start));
    }
    if (road.closed.length > 0) {
      rest.push(entry({ kind: "closed" }, "closed"), entry({ kind: "stop-line" }, "stop line"));
    }
    part("legend").replaceChildren(...own, ...rest);
  }
}

window.laneweaveWatch = new Watch();

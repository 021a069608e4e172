"use strict";
// Frames as they come from the server, and what lies between two of them. Nothing here needs a
// browser. What goes over the websocket: laneweave/launch/watch/frames.py.

const laneweaveFilm = (() => {
  const KEPT = 3000; // frames, as text
  const PARSED = 16; // of them, ready to be drawn
  const BATCH = 50; // frames in one answer of the server
  const JUMP_M = 40; // nobody drives so far between two frames
  const UNSURE_M = 0.05; // across the road: no more than errors of measurement
  const [MOVING, UNATTENDED, UNHEARD, OVERDUE] = [1, 2, 4, 8];

  class Film {
    constructor() {
      this.scene = null;
      this.clear();
    }

    clear() {
      this.texts = new Map(); // by number, oldest arrival first
      this.parsed = new Map();
      this.first = 0;
      this.last = -1;
      this.newest = null; // the frame that was pushed last, and the one before
      this.before = null;
      this.waiting = false; // for an answer
    }

    /** Take a message of the server; returns "scene", "frame" or "reel". */
    take(text) {
      const message = JSON.parse(text);
      if (message.scene) {
        const again = this.scene !== null && this.scene.session === message.scene.session;
        if (!again) this.clear();
        this.waiting = false;
        this.scene = message.scene;
        this.bounds(message.scene);
        return "scene";
      }
      if (message.reel) {
        this.waiting = false;
        this.bounds(message);
        for (const frame of message.frames) this.keep(frame.n, JSON.stringify(frame));
        return "reel";
      }
      this.keep(message.n, text);
      this.before = this.newest;
      this.newest = message;
      this.last = Math.max(this.last, message.n);
      this.first = Math.max(this.first, this.last - KEPT + 1);
      return "frame";
    }

    bounds({ first, last }) {
      this.first = Math.max(first, last - (this.scene.kind === "live" ? KEPT : Infinity) + 1);
      this.last = Math.max(last, this.last);
    }

    keep(number, text) {
      this.texts.set(number, text);
      if (this.texts.size > KEPT) this.texts.delete(this.texts.keys().next().value);
    }

    /** The frame of a number, null while it is not here. */
    get(number) {
      let frame = this.parsed.get(number);
      if (frame) return frame;
      const text = this.texts.get(number);
      if (text === undefined) return null;
      frame = JSON.parse(text);
      this.parsed.set(number, frame);
      if (this.parsed.size > PARSED) this.parsed.delete(this.parsed.keys().next().value);
      return frame;
    }

    /** The numbers [from, to] to ask for so that `ahead` frames from a place on are here, or null. */
    wish(place, ahead) {
      if (this.waiting) return null;
      const from = Math.max(this.first, Math.floor(place));
      const to = Math.min(this.last, Math.floor(place) + ahead);
      for (let number = from; number <= to; number += 1) {
        if (!this.texts.has(number)) {
          this.waiting = true;
          return [number, Math.min(this.last, number + BATCH - 1)];
        }
      }
      return null;
    }
  }

  function body([name, s, y, v, lane, formation, hold, target, flags, estate]) {
    const cells = [];
    for (let i = 0; i + 1 < estate.length; i += 2) cells.push([estate[i], estate[i + 1]]);
    return {
      name, s, y, v, lane, formation, flags, slope: 0,
      hold: hold || null,
      target: target || null,
      estate: cells,
      faint: (flags & UNHEARD) !== 0,
    };
  }

  /** Everybody at a share of the way from one frame to the next, which may be null: {t, bodies}. */
  function between(one, next, share) {
    if (!next || next.run !== one.run || one.t === null || next.t === null || next.t < one.t) {
      return { t: one.t, bodies: one.vehicles.map(body) };
    }
    const earlier = new Map(one.vehicles.map((row) => [row[0], row]));
    const mix = (a, b) => a + share * (b - a);
    const bodies = next.vehicles.map((row) => {
      const found = body(row);
      const from = earlier.get(found.name);
      const ds = from ? found.s - from[1] : 0;
      if (!from || Math.abs(ds) > JUMP_M) return found;
      // Errors of measurement would turn those who drive straight on.
      const dy = found.flags & MOVING ? found.y - from[2] : 0;
      const beyond = Math.max(0, Math.abs(dy) - UNSURE_M);
      found.slope = ds > 0.05 ? (Math.sign(dy) * beyond) / ds : 0;
      found.s = mix(from[1], found.s);
      found.y = mix(from[2], found.y);
      found.v = mix(from[3], found.v);
      return found;
    });
    return { t: mix(one.t, next.t), bodies };
  }

  /** What the numbers beside the road say: {onLane, knownLane, speed}. */
  function facts(scene, bodies) {
    const width = scene.road.lane_width_m;
    const known = bodies.filter((one) => one.lane >= 0);
    const there = known.filter((one) => Math.floor(one.y / width) === one.lane);
    const heard = bodies.filter((one) => !one.faint);
    const speed = heard.reduce((sum, one) => sum + one.v, 0) / (heard.length || 1);
    return { onLane: there.length, knownLane: known.length, speed: heard.length ? speed : null };
  }

  return { Film, between, facts, MOVING, UNATTENDED, UNHEARD, OVERDUE };
})();

"use strict";
// Stores frames from the server, and interpolates between them. Does not need a browser.
// Messages of the websocket: laneweave/launch/watch/frames.py.

const laneweaveFrames = (() => {
  const KEPT = 3000; // number of stored frames, as text
  const PARSED = 16; // number of parsed frames
  const BATCH = 50; // frames per response of the server
  const JUMP_M = 40; // no vehicle drives farther between two frames
  const UNSURE_M = 0.05; // lateral measurement error
  const [MOVING, UNATTENDED, UNHEARD, OVERDUE] = [1, 2, 4, 8];

  class FrameStore {
    constructor() {
      this.scene = null;
      this.end = null; // how the run of this page has ended
      this.clear();
    }

    clear() {
      this.texts = new Map(); // by number, oldest arrival first
      this.parsed = new Map();
      this.first = 0;
      this.last = -1;
      this.newest = null; // the last two pushed frames
      this.before = null;
      this.waiting = false; // for a response
    }

    /** Process a message from the server; return "scene", "frame", "reel" or "end". */
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
      if (message.end) {
        this.end = message.end;
        return "end";
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

    /** Return a frame by number; null: not received. */
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

    /** Return the range [from, to] of missing frames among the next `ahead` ones, or null. */
    missing(place, ahead) {
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

  function body([name, s, y, v, lane, formation, hold, target, flags, owned, type]) {
    const cells = [];
    for (let i = 0; i + 1 < owned.length; i += 2) cells.push([owned[i], owned[i + 1]]);
    return {
      name, s, y, v, lane, formation, flags, type, slope: 0,
      hold: hold || null,
      target: target || null,
      owned: cells,
      faint: (flags & UNHEARD) !== 0,
    };
  }

  /** Interpolate between two frames; the second may be null. Return {t, bodies}. */
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
      // Measurement errors would rotate vehicles that drive straight on.
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

  /** Return the figures shown above the road: {inLane, knownLane, speed}. */
  function facts(scene, bodies) {
    const width = scene.road.lane_width_m;
    const known = bodies.filter((one) => one.lane >= 0);
    const there = known.filter((one) => Math.floor(one.y / width) === one.lane);
    const seen = bodies.filter((one) => !one.faint);
    const speed = seen.reduce((sum, one) => sum + one.v, 0) / (seen.length || 1);
    return { inLane: there.length, knownLane: known.length, speed: seen.length ? speed : null };
  }

  return { FrameStore, between, facts, MOVING, UNATTENDED, UNHEARD, OVERDUE };
})();

"use strict";
// Data of the animated road (laneweave/launch/report/animation.py), drawn by
// laneweave/launch/web/road.js. Times in s, lengths in m.

const laneweave = (() => {
  const JUMP_MPS = 2.8; // lateral speed above which a vehicle jumps; as in trajectories.py
  const MAX_SLOPE = 0.35;

  /** Decode little-endian integers of `bytes` bytes from base64. */
  function unpack(text, bytes) {
    const raw = Uint8Array.from(atob(text), (char) => char.charCodeAt(0));
    if (bytes === 1) return raw;
    const view = new DataView(raw.buffer);
    return Uint16Array.from({ length: raw.length / 2 }, (_, i) => view.getUint16(2 * i, true));
  }

  /** Decode a run's data for `stateAt` and `allAt`. */
  function decode(data) {
    let offset = 0;
    const vehicles = data.vehicles.map((vehicle) => {
      const placed = { ...vehicle, offset };
      offset += vehicle.count;
      return placed;
    });
    return {
      ...data,
      vehicles,
      s: unpack(data.columns.s_m, 2),
      y: unpack(data.columns.y_m, 2),
      v: unpack(data.columns.speed_mps, 1),
    };
  }

  /** Return the state {s, y, v, slope} of a vehicle; null: not on the road. */
  function stateAt(run, vehicle, t) {
    const place = t / run.step_s - vehicle.first;
    if (place < -1e-9 || place > vehicle.count - 1 + 1e-9) return null;
    const here = Math.min(Math.max(Math.floor(place), 0), Math.max(vehicle.count - 2, 0));
    const share = vehicle.count > 1 ? place - here : 0;
    const a = vehicle.offset + here;
    const b = vehicle.count > 1 ? a + 1 : a;
    const mix = (column) => column[a] + share * (column[b] - column[a]);
    const ds = (run.s[b] - run.s[a]) * run.units.s_m;
    const dy = (run.y[b] - run.y[a]) * run.units.y_m;
    // An instantaneous lane change is before or after the jump, and never in between.
    const jumps = Math.abs(dy) > JUMP_MPS * run.step_s;
    const slope = ds > 0.05 && !jumps ? dy / ds : 0;
    return {
      s: mix(run.s) * run.units.s_m,
      y: (jumps ? run.y[share < 0.5 ? a : b] : mix(run.y)) * run.units.y_m,
      v: mix(run.v) * run.units.speed_mps,
      slope: Math.min(Math.max(slope, -MAX_SLOPE), MAX_SLOPE),
    };
  }

  /** Return all vehicles on the road: [[vehicle, state], ...]. */
  function allAt(run, t) {
    const found = [];
    for (const vehicle of run.vehicles) {
      if (vehicle.first * run.step_s > t + run.step_s) break; // in order of entry
      const state = stateAt(run, vehicle, t);
      if (state) found.push([vehicle, state]);
    }
    return found;
  }

  /** Return the position of the centre of a formation, which may be off the road. */
  function formationCentre(run, formation, t) {
    const [, rear, front] = run.formations.find(([number]) => number === formation);
    const [from, to] = laneweaveRoad.columnsAt(run, rear, front, t);
    return (from + to) / 2;
  }

  /** Return the stretches [from, to] of the road to draw; `follow` null: the whole road. */
  function stretches(run, follow, t, width) {
    const length = run.road.length_m;
    if (follow === null) return laneweaveRoad.wholeRoad(length, width);
    const state = follow.vehicle ? stateAt(run, follow.vehicle, t) : null;
    const first = follow.vehicle ? follow.vehicle.first * run.step_s : 0;
    let centre = state ? state.s : t < first ? 0 : length;
    if (!follow.vehicle) centre = formationCentre(run, follow.formation, t);
    return [laneweaveRoad.windowAround(length, centre, width)];
  }

  /** Return what can be followed at a time: formations with a vehicle on the road, and vehicles. */
  function followable(run, t) {
    const present = allAt(run, t).map(([vehicle]) => vehicle);
    const shown = new Set(present.map((vehicle) => vehicle.formation));
    const formations = run.formations
      .map(([number]) => number)
      .filter((number) => shown.has(number))
      .map((formation) => ({ name: `formation ${formation}`, formation }));
    return [...formations, ...present.map((vehicle) => ({ name: vehicle.name, vehicle }))];
  }

  return { unpack, decode, stateAt, allAt, formationCentre, stretches, followable };
})();

"use strict";
// Draws a road on a canvas, in reports and on the live page. Lengths in m, speeds in m/s.
//
// A scene has `road` {length_m, lanes, lane_width_m, sorting_start_m}, `body_m` [length, width] of cars,
// `bodies_m`, the same of each type, `lattice` {speed_mps, pitch_m}, `shade` {span_mps, strength}, and
// `colours`, one per lane. A body has `name`, `lane` (index of its colour; -1: unknown), `s`, `y`, `v`,
// `slope`, `faint` (draw an outline), and `type` (undefined: a car).

const laneweaveRoad = (() => {
  const ACROSS = 1.8; // scale across the road relative to the scale along it
  const ABOVE_PX = 14; // for names above the left lane
  const GAP_PX = 42; // below each stretch, for the scale in metres and the names above the next one
  const METRES_PX = 12; // minimum distance between two labels of the scale
  const NAMED_FROM = 6; // minimum scale at which names are drawn, in pixels per metre
  const NUMBERED_PX = 12; // minimum length of a vehicle that shows the number of its lane
  const MIN_SCALE = 3; // of a whole road, in pixels per metre: narrow pages show more stretches
  const MAX_STRETCHES = 16;
  const RING_PX = 5; // between the body that is followed and its ring
  const WINDOW_M = 150; // length of the road around what is followed, on a wide page
  const BRIGHT = 127.5; // brightness above which text on a colour is black
  const UNKNOWN = "#8a8f96";
  const LIGHT = {
    asphalt: "#e9eaec",
    paint: "#ffffff",
    edge: "#9aa0a8",
    ink: "#30343a",
    faint: "#6a7078",
    glass: "rgba(255,255,255,.7)",
  };
  const DARK = {
    asphalt: "#2b3037",
    paint: "#4d545e",
    edge: "#6d747e",
    ink: "#e6e8eb",
    faint: "#a3abb6",
    glass: "rgba(255,255,255,.75)",
  };

  /** Return a colour, darkened for slow vehicles and lightened for fast ones. */
  function shade(colour, over, span, strength) {
    const share = Math.max(-1, Math.min(1, over / span));
    const end = share > 0 ? 255 : 0;
    const part = strength * Math.abs(share);
    const mixed = [1, 3, 5].map((i) => {
      const value = parseInt(colour.slice(i, i + 2), 16);
      return Math.round((1 - part) * value + part * end);
    });
    return `rgb(${mixed.join(",")})`;
  }

  /** Return black or white, whichever is legible on a colour `rgb(...)`. */
  function textColour(colour) {
    const [red, green, blue] = colour.match(/\d+/g).map(Number);
    return 0.3 * red + 0.59 * green + 0.11 * blue > BRIGHT ? "#000000" : "#ffffff";
  }

  /** Split a whole road into stretches [from, to], drawn below each other in a width in pixels. */
  function wholeRoad(length, width) {
    const wide = Math.min(6, Math.round(length / 250));
    const narrow = Math.min(MAX_STRETCHES, Math.ceil((length * MIN_SCALE) / Math.max(1, width)));
    const count = Math.max(1, wide, narrow);
    return Array.from({ length: count }, (_, i) => [(length * i) / count, (length * (i + 1)) / count]);
  }

  /** Return the stretch around a position, shifted into the road at its ends, for a width in px. */
  function windowAround(length, centre, width) {
    const half = Math.min(WINDOW_M, width / MIN_SCALE, length) / 2;
    const middle = Math.max(half, Math.min(length - half, centre));
    return [middle - half, middle + half];
  }

  /** Return [length, width] of a body. */
  function sizeOf(scene, body) {
    return scene.bodies_m?.[body.type] ?? scene.body_m;
  }

  /** Return [rear, front] of a range of columns at a time, with half of the gaps around it. */
  function columnsAt(scene, rear, front, t) {
    const { pitch_m: pitch, speed_mps: speed } = scene.lattice;
    const margin = (pitch - scene.body_m[0]) / 2;
    const place = (column) => speed * t + column * pitch;
    return [place(rear) - scene.body_m[0] - margin, place(front) + margin];
  }

  function line(pen, fromX, fromY, toX, toY) {
    pen.beginPath();
    pen.moveTo(fromX, fromY);
    pen.lineTo(toX, toY);
    pen.stroke();
  }

  class Painter {
    constructor(canvas, scene, theme = LIGHT) {
      this.canvas = canvas;
      this.scene = scene;
      this.theme = theme;
    }

    /** Draw stretches of the road with layers, and bodies on top; the body `followed` has a ring. */
    paint(strips, bodies, layers = [], followed = null) {
      const { canvas, scene } = this;
      this.followed = followed;
      const width = canvas.clientWidth;
      if (width === 0) return;
      this.scale = width / (strips[0][1] - strips[0][0]);
      this.width = width;
      this.roadPx = scene.road.lanes * scene.road.lane_width_m * this.scale * ACROSS;
      this.strips = strips;
      const height = Math.ceil(strips.length * (this.roadPx + GAP_PX) + ABOVE_PX);
      const ratio = window.devicePixelRatio || 1;
      const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
      if (canvas.width !== wide || canvas.height !== high) {
        canvas.width = wide;
        canvas.height = high;
        canvas.style.height = `${height}px`;
      }
      const pen = canvas.getContext("2d");
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.clearRect(0, 0, width, height);
      this.pen = pen;
      strips.forEach((stretch, number) => {
        pen.save();
        pen.translate(0, this.top(number));
        this.stretch(stretch, bodies, layers);
        pen.restore();
      });
    }

    /** Return the vertical canvas position of a stretch. */
    top(number) {
      return ABOVE_PX + number * (this.roadPx + GAP_PX);
    }

    /** Return the horizontal canvas position of a position along the road. */
    x(s) {
      return (s - this.from) * this.scale;
    }

    /** Return the canvas position of a lateral position, relative to the left edge of the road. */
    y(place) {
      return this.roadPx - place * this.scale * ACROSS;
    }

    /** Return whether [rear, front] overlaps the stretch that is being drawn. */
    shows(rear, front) {
      return front >= this.from && rear <= this.to;
    }

    /** Return the road position {s, y} in m of a canvas position; null: between two stretches. */
    placeAt(canvasX, canvasY) {
      if (!this.strips) return null;
      for (let number = 0; number < this.strips.length; number += 1) {
        const down = canvasY - this.top(number);
        if (down >= 0 && down <= this.roadPx) {
          return {
            s: this.strips[number][0] + canvasX / this.scale,
            y: (this.roadPx - down) / (this.scale * ACROSS),
          };
        }
      }
      return null;
    }

    stretch([from, to], bodies, layers) {
      this.from = from;
      this.to = to;
      this.surface();
      this.metres();
      const { pen } = this;
      pen.beginPath();
      pen.rect(0, -ABOVE_PX, this.width, this.roadPx + ABOVE_PX);
      pen.clip();
      for (const layer of layers) layer(this);
      this.lineToName(bodies.find(({ name }) => name === this.followed));
      for (const body of bodies) {
        if (!this.shows(body.s - sizeOf(this.scene, body)[0], body.s)) continue;
        this.body(body);
        if (body.name === this.followed) this.ring(body);
      }
    }

    surface() {
      const { pen, theme, width, roadPx, scale, from, to } = this;
      const { road } = this.scene;
      pen.fillStyle = theme.asphalt;
      pen.fillRect(0, 0, width, roadPx);
      pen.strokeStyle = theme.paint;
      pen.lineWidth = 2;
      // Fix the dashes to the road, not to the canvas.
      pen.setLineDash([6 * scale, 6 * scale]);
      pen.lineDashOffset = from * scale;
      for (let lane = 1; lane < road.lanes; lane += 1) {
        line(pen, 0, this.y(lane * road.lane_width_m), width, this.y(lane * road.lane_width_m));
      }
      pen.setLineDash([]);
      pen.strokeStyle = theme.edge;
      line(pen, 0, 1, width, 1);
      line(pen, 0, roadPx - 1, width, roadPx - 1);
      if (road.sorting_start_m > from && road.sorting_start_m < to) {
        const x = this.x(road.sorting_start_m);
        pen.strokeStyle = theme.ink;
        pen.setLineDash([3, 3]);
        pen.lineDashOffset = 0;
        line(pen, x, 0, x, roadPx);
        pen.setLineDash([]);
      }
    }

    metres() {
      const { pen, theme, from, to, roadPx, width } = this;
      const every = to - from > 400 ? 100 : to - from > 200 ? 50 : 20;
      pen.fillStyle = theme.faint;
      pen.font = "11px system-ui, sans-serif";
      pen.textBaseline = "top";
      pen.textAlign = "left";
      let free = 0; // a label that would touch the one before it is left out
      for (let mark = Math.ceil(from / every) * every; mark <= to; mark += every) {
        const x = this.x(mark);
        pen.fillRect(x - 0.5, roadPx, 1, 4);
        const label = `${mark} m`;
        const long = pen.measureText(label).width;
        const left = Math.max(0, Math.min(width - long, x - long / 2));
        if (left < free) continue;
        pen.fillText(label, left, roadPx + 6);
        free = left + long + METRES_PX;
      }
    }

    /** Return the colour of a vehicle at a speed. */
    colour(lane, speed) {
      const { colours, shade: how, lattice } = this.scene;
      const own = lane < 0 ? UNKNOWN : colours[lane % colours.length];
      return shade(own, speed - lattice.speed_mps, how.span_mps, how.strength);
    }

    body(body) {
      const { pen, theme, scale } = this;
      const [length, width] = sizeOf(this.scene, body);
      const heading = Math.atan(body.slope);
      const [along, across] = [Math.cos(heading), Math.sin(heading)];
      const [centreS, centreY] = [body.s - 0.5 * length * along, body.y];
      const path = (rear, front, half) => {
        pen.beginPath();
        for (const [u, v] of [[rear, -half], [front, -half], [front, half], [rear, half]]) {
          const [a, b] = [u * length, v * width];
          pen.lineTo(this.x(centreS + a * along - b * across), this.y(centreY + a * across + b * along));
        }
        pen.closePath();
      };
      pen.fillStyle = this.colour(body.lane, body.v);
      pen.strokeStyle = body.faint ? pen.fillStyle : "#30343a";
      pen.lineWidth = body.faint ? 1.4 : 0.8;
      path(-0.5, 0.5, 0.5);
      if (body.faint) pen.setLineDash([3, 2]);
      else pen.fill();
      pen.stroke();
      pen.setLineDash([]);
      const numbered = this.scene.preferences && body.lane >= 0 && length * scale >= NUMBERED_PX;
      if (numbered && !body.faint) {
        const high = Math.round(Math.max(9, Math.min(15, 0.95 * width * scale * ACROSS)));
        pen.fillStyle = textColour(this.colour(body.lane, body.v));
        pen.font = `600 ${high}px system-ui, sans-serif`;
        pen.textAlign = "center";
        pen.textBaseline = "middle";
        pen.fillText(body.lane, this.x(centreS), this.y(centreY) + 0.5);
      } else if (!body.faint) {
        pen.fillStyle = theme.glass;
        path(0.12, 0.3, 0.36);
        pen.fill();
      }
      const followed = body.name === this.followed;
      if (scale > NAMED_FROM || followed) {
        pen.fillStyle = theme.ink;
        pen.font = `${followed ? "600 " : ""}10px system-ui, sans-serif`;
        pen.textAlign = "center";
        pen.textBaseline = "bottom";
        // Above the road, the name of the one that is followed covers no other vehicle.
        const up = followed ? -2 : this.y(centreY + 0.5 * width) - 2;
        pen.strokeStyle = theme.asphalt; // keeps the name legible on lines
        pen.lineWidth = 3;
        pen.strokeText(body.name, this.x(centreS), up);
        pen.fillText(body.name, this.x(centreS), up);
      }
    }

    /** Draw a line from the body that is followed to its name above the road, under other bodies. */
    lineToName(body) {
      if (!body) return;
      const x = this.x(body.s - 0.5 * sizeOf(this.scene, body)[0]);
      this.pen.strokeStyle = this.theme.ink;
      this.pen.lineWidth = 1;
      line(this.pen, x, 0, x, this.y(body.y));
    }

    /** Draw a dark ring with a light edge around the body that is followed. */
    ring(body) {
      const { pen, theme, scale } = this;
      const [length, width] = sizeOf(this.scene, body);
      const [long, wide] = [length * scale + 2 * RING_PX, width * scale * ACROSS + 2 * RING_PX];
      const corner = [this.x(body.s - length / 2) - long / 2, this.y(body.y) - wide / 2];
      for (const [colour, px] of [[theme.asphalt, 4], [theme.ink, 2]]) {
        pen.strokeStyle = colour;
        pen.lineWidth = px;
        pen.beginPath();
        pen.roundRect(...corner, long, wide, 7);
        pen.stroke();
      }
    }
  }

  return { ACROSS, LIGHT, DARK, shade, textColour, wholeRoad, windowAround, columnsAt, sizeOf, line, Painter };
})();

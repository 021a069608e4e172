"use strict";
// Layers between the road and the vehicles: columns of formations, cells, targets, marks.

const laneweaveLayers = (() => {
  const ROUND_PX = 3;

  /** Return the rectangle of a cell on the canvas: [x, y, width, height]. */
  function cellBox(painter, [column, lane], t) {
    const { scene } = painter;
    const [rear, front] = laneweaveRoad.columnsAt(scene, column, column, t);
    const width = scene.road.lane_width_m;
    const [left, right] = [painter.x(rear), painter.x(front)];
    const [top, bottom] = [painter.y((lane + 1) * width), painter.y(lane * width)];
    return [left, top, right - left, bottom - top];
  }

  function onStrip(painter, column, t) {
    return painter.shows(...laneweaveRoad.columnsAt(painter.scene, column, column, t));
  }

  function rounded(pen, [x, y, width, height], inset) {
    pen.beginPath();
    pen.roundRect(x + inset, y + inset, width - 2 * inset, height - 2 * inset, ROUND_PX);
  }

  function ownColour(painter, body) {
    const { colours, neutral } = painter.scene;
    return body.lane < 0 ? neutral : colours[body.lane % colours.length];
  }

  /** Draw the hold cells of vehicles with a frame, their other owned cells without. */
  function cells(bodies, t) {
    return (painter) => {
      const { pen, theme } = painter;
      for (const body of bodies) {
        pen.fillStyle = ownColour(painter, body);
        pen.globalAlpha = 0.09;
        for (const cell of body.owned) {
          if (!onStrip(painter, cell[0], t)) continue;
          rounded(pen, cellBox(painter, cell, t), 1.5);
          pen.fill();
        }
        pen.globalAlpha = 0.2;
        if (body.hold && onStrip(painter, body.hold[0], t)) {
          rounded(pen, cellBox(painter, body.hold, t), 1.5);
          pen.fill();
          // A dark line beside the coloured one keeps light colours visible.
          for (const [colour, px, alpha] of [[theme.ink, 2.2, 0.45], [ownColour(painter, body), 1.2, 1]]) {
            pen.strokeStyle = colour;
            pen.globalAlpha = alpha;
            pen.lineWidth = px;
            pen.stroke();
          }
        }
      }
      pen.globalAlpha = 1;
    };
  }

  /** Return formations with their columns, {numbers, rear, front}; joined ones are merged. */
  function groups(formations, joined) {
    const groupOf = new Map();
    for (const group of joined) for (const number of group) groupOf.set(number, group[0]);
    const found = new Map();
    for (const [number, rear, front] of formations) {
      const key = groupOf.get(number) ?? number;
      const one = found.get(key) ?? { numbers: [], rear, front };
      one.numbers = [...one.numbers, number].sort((a, b) => a - b);
      one.rear = Math.min(one.rear, rear);
      one.front = Math.max(one.front, front);
      found.set(key, one);
    }
    return [...found.values()].sort((a, b) => b.front - a.front);
  }

  /** Draw the columns of formations with a frame, and their numbers above. */
  function blocks(formations, joined, t) {
    return (painter) => {
      const { pen, theme, scene } = painter;
      for (const { numbers, rear, front } of groups(formations, joined)) {
        const [from, to] = laneweaveRoad.columnsAt(scene, rear, front, t);
        if (!painter.shows(from, to)) continue;
        const [left, right] = [painter.x(from), painter.x(to)];
        pen.fillStyle = pen.strokeStyle = theme.faint;
        pen.globalAlpha = 0.1;
        rounded(pen, [left, 0, right - left, painter.roadPx], 2.5);
        pen.fill();
        pen.globalAlpha = 0.85;
        pen.lineWidth = 1.5;
        pen.stroke();
        pen.globalAlpha = 1;
        const [begin, end] = [Math.max(left, 0), Math.min(right, painter.width)];
        const name = `formation ${numbers.join("+")}`;
        pen.font = "11px system-ui, sans-serif";
        if (pen.measureText(name).width > end - begin) continue;
        pen.textAlign = "center";
        pen.textBaseline = "bottom";
        pen.fillText(name, (begin + end) / 2, -1);
      }
    };
  }

  /** Draw a line from each vehicle that has not arrived to a ring in its target cell. */
  function targets(bodies, t) {
    return (painter) => {
      const { pen, scene } = painter;
      const { pitch_m: pitch, speed_mps: speed } = scene.lattice;
      const width = scene.road.lane_width_m;
      for (const body of bodies) {
        const target = body.target || body.hold;
        if (!target || body.faint) continue;
        const [s, y] = [speed * t + target[0] * pitch, (target[1] + 0.5) * width];
        if (Math.abs(s - body.s) < 0.4 * pitch && Math.abs(y - body.y) < 0.25 * width) continue;
        const [length] = laneweaveRoad.sizeOf(scene, body);
        if (!painter.shows(Math.min(s, body.s) - length, Math.max(s, body.s))) continue;
        const half = length / 2;
        const [x1, y1] = [painter.x(s - half), painter.y(y)];
        pen.fillStyle = painter.theme.asphalt;
        // A dark edge keeps light colours visible.
        for (const [colour, px] of [["#30343a", 3.5], [ownColour(painter, body), 2]]) {
          pen.strokeStyle = colour;
          pen.lineWidth = px;
          laneweaveRoad.line(pen, painter.x(body.s - half), painter.y(body.y), x1, y1);
          pen.beginPath();
          pen.arc(x1, y1, 4, 0, 2 * Math.PI);
          pen.stroke();
        }
        pen.fill();
      }
    };
  }

  /** Draw rings around vehicles that have no agent or are overdue. */
  function marks(bodies) {
    const odd = laneweaveFrames.UNATTENDED | laneweaveFrames.OVERDUE;
    return (painter) => {
      const { pen, scene } = painter;
      pen.strokeStyle = "#cc79a7";
      pen.lineWidth = 2;
      for (const body of bodies) {
        const [length] = laneweaveRoad.sizeOf(scene, body);
        if (!(body.flags & odd) || !painter.shows(body.s - length, body.s)) continue;
        const radius = Math.max(7, 0.75 * length * painter.scale);
        pen.beginPath();
        pen.arc(painter.x(body.s - length / 2), painter.y(body.y), radius, 0, 2 * Math.PI);
        pen.stroke();
      }
    };
  }

  return { cells, groups, blocks, targets, marks };
})();

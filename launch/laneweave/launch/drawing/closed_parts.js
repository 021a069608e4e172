"use strict";
// Closed parts of lanes, as a layer of the road (laneweave/launch/web/road.js). The road of the scene
// has `closed` [[lane, from, to], ...], `stop_lines` [[lane, s], ...] and `ramps` [[lane left of the
// edge, from, to], ...], in m.

const laneweaveClosed = (() => {
  const HATCH_PX = 7; // distance between the lines of the hatching
  const LINE_PX = 3; // width of stop lines

  /** Draw closed parts with hatching, the stop lines before them, and the edges of ramps. */
  function closedParts(painter) {
    const { pen, theme } = painter;
    const { closed, ramps, stop_lines: stopLines, lane_width_m: width } = painter.scene.road;
    const high = painter.y(0) - painter.y(width);
    for (const [lane, from, to] of closed) {
      if (painter.shows(from, to)) hatch(painter, from, to, painter.y((lane + 1) * width), high);
    }
    pen.strokeStyle = theme.ink;
    pen.lineWidth = LINE_PX;
    for (const [lane, s] of stopLines) {
      if (!painter.shows(s, s)) continue;
      // Keep all of the line on the canvas if it is at the border of the stretch.
      const x = Math.max(LINE_PX / 2, Math.min(painter.width - LINE_PX / 2, painter.x(s)));
      const top = painter.y((lane + 1) * width);
      laneweaveRoad.line(pen, x, top, x, top + high);
    }
    for (const [lane, from, to] of ramps ?? []) {
      const y = painter.y(lane * width);
      laneweaveRoad.line(pen, painter.x(from), y, painter.x(to), y);
    }
  }

  function hatch(painter, from, to, top, high) {
    const { pen, theme } = painter;
    const [begin, end] = [painter.x(from), painter.x(to)];
    const [left, right] = [Math.max(begin, 0), Math.min(end, painter.width)];
    pen.save();
    pen.beginPath();
    pen.rect(left, top, right - left, high);
    pen.clip();
    pen.fillStyle = theme.asphalt; // covers the lane markings
    pen.fillRect(left, top, right - left, high);
    pen.globalAlpha = 0.25;
    pen.fillStyle = pen.strokeStyle = theme.faint;
    pen.fillRect(left, top, right - left, high);
    pen.globalAlpha = 0.6;
    pen.lineWidth = 1;
    // Fix the lines to the road, not to the canvas.
    const skipped = Math.floor((left - begin) / HATCH_PX) * HATCH_PX;
    for (let foot = begin + skipped - high; foot < right; foot += HATCH_PX) {
      laneweaveRoad.line(pen, foot, top + high, foot + high, top);
    }
    pen.globalAlpha = 1;
    pen.lineWidth = 3;
    pen.strokeRect(begin, top, end - begin, high);
    pen.restore();
  }

  /** Draw parts [lane, from, to, kind] that are closed for a time, or cleared, and other vehicles. */
  function temporary(parts, others) {
    return (painter) => {
      const { pen, theme } = painter;
      const { lane_width_m: width } = painter.scene.road;
      const high = painter.y(0) - painter.y(width);
      for (const [lane, from, to, kind] of parts) {
        if (!painter.shows(from, to)) continue;
        const top = painter.y((lane + 1) * width);
        if (kind === 1) {
          hatch(painter, from, to, top, high);
          continue;
        }
        pen.fillStyle = pen.strokeStyle = theme.faint;
        pen.globalAlpha = 0.18;
        pen.fillRect(painter.x(from), top, painter.x(to) - painter.x(from), high);
        pen.globalAlpha = 1;
      }
      pen.fillStyle = theme.ink;
      for (const [, lane, front, length] of others) {
        if (!painter.shows(front - length, front)) continue;
        const top = painter.y((lane + 0.78) * width);
        const left = painter.x(front - length);
        pen.fillRect(left, top, Math.max(4, painter.x(front) - left), 0.56 * high);
      }
    };
  }

  return { closedParts, temporary };
})();

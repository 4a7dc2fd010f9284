// The map: robots, where they were, and the walls that lasers have seen. It can be moved and zoomed.

import {arrow, colour, context} from "./draw.js";

const CELL_M = 0.05, CELLS = 1024;
const TRAIL_MS = 60_000;
const REDRAW_MS = 500, FRAME_MS = 30;               // what lies below is drawn twice a second, robots 30 times at most

export class Map2D {
  constructor(canvas, onPick) {
    this.canvas = canvas;
    this.onPick = onPick;
    this.walls = Object.assign(document.createElement("canvas"), {width: CELLS, height: CELLS});
    this.below = document.createElement("canvas");   // trails and walls: drawn some times a second, not with each message
    this.forget();
    this.follow = true;                             // until somebody moves the map
    this.view = {x: 0, y: 0, scale: 40};            // pixels for a metre
    this.middle = [0, 0];                           // of the canvas, pixels: to ask the page for each point takes long
    this.pointers = new Map();
    this.listen();
  }

  forget() {
    this.walls.getContext("2d").clearRect(0, 0, CELLS, CELLS);
    this.origin = null;
    this.seen = [];                                 // two corners of what lasers have seen
    this.belowMs = this.drawnMs = -Infinity;
    this.changed = true;
  }

  listen() {
    const place = event => [event.offsetX, event.offsetY];
    this.canvas.addEventListener("pointerdown", event => {
      this.canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, place(event));
      this.moved = 0;
    });
    this.canvas.addEventListener("pointermove", event => {
      const before = this.pointers.get(event.pointerId);
      if (!before) return;
      const now = place(event), [dx, dy] = [now[0] - before[0], now[1] - before[1]];
      this.moved += Math.hypot(dx, dy);
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
      if (other) {
        const distance = at => Math.max(1, Math.hypot(at[0] - other[0], at[1] - other[1]));
        this.zoom(distance(now) / distance(before), other);
      } else if (this.moved > 4) this.shift(dx, dy);
      this.pointers.set(event.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel"])
      this.canvas.addEventListener(name, event => {
        if (this.pointers.delete(event.pointerId) && this.moved <= 4 && name === "pointerup") this.pick(...place(event));
      });
    this.canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 500), place(event));
    }, {passive: false});
  }

  shift(dx, dy) {
    this.follow = false;
    this.view.x -= dx / this.view.scale;
    this.view.y += dy / this.view.scale;
    this.belowMs = -Infinity;
    this.changed = true;
  }

  zoom(factor, [px, py]) {
    const {view} = this, fromX = px - this.canvas.clientWidth / 2, fromY = py - this.canvas.clientHeight / 2;
    const scale = Math.min(400, Math.max(0.5, view.scale * factor));
    this.follow = false;
    view.x += fromX / view.scale - fromX / scale;
    view.y -= fromY / view.scale - fromY / scale;
    view.scale = scale;
    this.belowMs = -Infinity;
    this.changed = true;
  }

  pick(px, py) {
    let nearest = null, best = 30;
    for (const robot of this.robots ?? []) {
      if (!robot.pose) continue;
      const [x, y] = this.at(robot.pose.x, robot.pose.y), distance = Math.hypot(x - px, y - py);
      if (distance < best) [nearest, best] = [robot, distance];
    }
    if (nearest) this.onPick(nearest.name);
  }

  at(x, y) {
    return [(x - this.view.x) * this.view.scale + this.middle[0], (this.view.y - y) * this.view.scale + this.middle[1]];
  }

  // Where a laser's rays ended.
  addScan(pose, scan) {
    const half = CELLS * CELL_M / 2;
    if (!this.origin || Math.hypot(pose.x - this.origin.x, pose.y - this.origin.y) > half * 0.8) {
      this.forget();
      this.origin = {x: pose.x, y: pose.y};
    }
    const drawing = this.walls.getContext("2d");
    drawing.fillStyle = colour("wall");
    scan.ranges.forEach((range, k) => {
      if (!Number.isFinite(range)) return;
      const angle = pose.yaw + scan.angle_min + k * scan.angle_increment;
      const x = pose.x + range * Math.cos(angle), y = pose.y + range * Math.sin(angle);
      if (!(Math.max(Math.abs(x - this.origin.x), Math.abs(y - this.origin.y)) < half)) return;  // beyond the walls' canvas
      const [low, high] = this.seen;
      this.seen = low ? [{x: Math.min(low.x, x), y: Math.min(low.y, y)}, {x: Math.max(high.x, x), y: Math.max(high.y, y)}] : [{x, y}, {x, y}];
      drawing.fillRect(Math.floor((x - this.origin.x + half) / CELL_M), Math.floor((this.origin.y - y + half) / CELL_M), 1, 1);
    });
  }

  fit(robots) {
    const points = robots.flatMap(robot => robot.trail.length ? robot.trail : robot.pose ? [robot.pose] : []);
    if (!points.length) return;
    points.push(...this.seen);
    let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const {x, y} of points) {
      [left, right] = [Math.min(left, x), Math.max(right, x)];
      [low, high] = [Math.min(low, y), Math.max(high, y)];
    }
    const margin = 0.8, scale = Math.min(this.canvas.clientWidth / (right - left + 2 * margin), this.canvas.clientHeight / (high - low + 2 * margin));
    const wanted = {x: (left + right) / 2, y: (low + high) / 2, scale: Math.min(120, scale)};
    const ease = this.fitted ? 0.5 : 1;
    for (const key of ["x", "y", "scale"]) this.view[key] += (wanted[key] - this.view[key]) * ease;
    this.fitted = true;
  }

  draw(robots, chosen, nowMs) {
    this.robots = robots;
    this.middle = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
    const clock = performance.now();
    if (clock - this.belowMs > REDRAW_MS) {
      if (this.follow) this.fit(robots);
      this.drawBelow(robots, chosen, nowMs);
      this.belowMs = clock;
    } else if (!this.changed || clock - this.drawnMs < FRAME_MS) return;
    this.changed = false;
    this.drawnMs = clock;
    const [drawing, width, height] = context(this.canvas);
    drawing.drawImage(this.below, 0, 0, width, height);
    drawing.font = "600 12px system-ui, sans-serif";
    for (const robot of robots) {
      if (!robot.pose) continue;
      const [x, y] = this.at(robot.pose.x, robot.pose.y), large = robot.name === chosen;
      drawing.globalAlpha = robot.away ? 0.4 : 1;
      arrow(drawing, x, y, -(robot.pose.yaw ?? 0), large ? 13 : 9, robot.tint);
      drawing.lineWidth = 3;
      drawing.strokeStyle = colour("lane");
      drawing.strokeText(robot.name, x + 13, y - 9);
      drawing.fillStyle = large ? colour("ink") : colour("soft");
      drawing.fillText(robot.name, x + 13, y - 9);
    }
    drawing.globalAlpha = 1;
  }

  drawBelow(robots, chosen, nowMs) {
    const ratio = devicePixelRatio || 1, width = this.canvas.clientWidth, height = this.canvas.clientHeight, {scale} = this.view;
    this.below.width = Math.round(width * ratio);
    this.below.height = Math.round(height * ratio);
    const drawing = this.below.getContext("2d");
    drawing.setTransform(ratio, 0, 0, ratio, 0, 0);
    const step = 10 ** Math.ceil(Math.log10(40 / scale)), metres = 40 / scale <= step / 5 ? step / 5 : 40 / scale <= step / 2 ? step / 2 : step;
    drawing.strokeStyle = colour("rule");
    drawing.beginPath();
    for (let x = Math.ceil((this.view.x - width / 2 / scale) / metres) * metres; this.at(x, 0)[0] < width; x += metres) {
      drawing.moveTo(Math.round(this.at(x, 0)[0]) + 0.5, 0);
      drawing.lineTo(Math.round(this.at(x, 0)[0]) + 0.5, height);
    }
    for (let y = Math.ceil((this.view.y - height / 2 / scale) / metres) * metres; this.at(0, y)[1] > 0; y += metres) {
      drawing.moveTo(0, Math.round(this.at(0, y)[1]) + 0.5);
      drawing.lineTo(width, Math.round(this.at(0, y)[1]) + 0.5);
    }
    drawing.stroke();
    if (this.seen.length) {                         // only the part of the walls' canvas in which there are any
      const half = CELLS * CELL_M / 2, [low, high] = this.seen;
      const column = Math.floor((low.x - this.origin.x + half) / CELL_M), row = Math.floor((this.origin.y - high.y + half) / CELL_M);
      const columns = Math.ceil((high.x - low.x) / CELL_M) + 1, rows = Math.ceil((high.y - low.y) / CELL_M) + 1;
      const [x, y] = this.at(this.origin.x - half + column * CELL_M, this.origin.y + half - row * CELL_M), size = CELL_M * scale;
      drawing.imageSmoothingEnabled = false;
      drawing.drawImage(this.walls, column, row, columns, rows, x, y, columns * size, rows * size);
    }
    drawing.lineJoin = "bevel";
    for (const robot of robots) {
      while (robot.trail.length && robot.trail[0].ms < nowMs - TRAIL_MS) robot.trail.shift();
      drawing.strokeStyle = robot.tint;
      drawing.lineWidth = robot.name === chosen ? 2.5 : 1.5;
      drawing.globalAlpha = robot.name === chosen ? 0.75 : 0.4;
      drawing.beginPath();
      for (const point of robot.trail) {
        const [x, y] = this.at(point.x, point.y);
        drawing.lineTo(x, y);
      }
      drawing.stroke();
    }
    drawing.globalAlpha = 1;
    drawing.fillStyle = colour("soft");
    drawing.font = "11px system-ui, sans-serif";
    drawing.fillRect(12, height - 14, metres * scale, 2);
    drawing.fillText(`${metres} m`, 12, height - 20);
  }
}

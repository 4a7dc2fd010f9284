// The map: robots, where they were, and the walls that lasers have seen. It can be moved and zoomed.

import {arrow, colour, context, faded, seconds, tint} from "./draw.js";
import {listen} from "./gestures.js";
import {BELOW_TOP, placed} from "./labels.js";
import {flagAt} from "./layers.js";

const CELL_M = 0.05, CELLS = 1024;
const TRAIL_MS = 60_000;
const REDRAW_MS = 500, LAYERS_MS = 150, FRAME_MS = 30;  // what lies below is drawn twice a second, or soon after a layer came; robots 30 times at most
const OLD_MS = 3000;

// Around a robot that is near another.
function ring(drawing, x, y) {
  drawing.strokeStyle = colour("warn");
  drawing.lineWidth = 2;
  drawing.beginPath();
  drawing.arc(x, y, 18, 0, 7);
  drawing.stroke();
}

export class Map2D {
  constructor(canvas, layers, onPick) {
    this.canvas = canvas;
    this.layers = layers;
    this.onPick = onPick;
    this.tool = this.preview = null;                // a tool in hand: {tint, done(at)}; and where it points now
    this.walls = Object.assign(document.createElement("canvas"), {width: CELLS, height: CELLS});
    this.below = document.createElement("canvas");   // trails and walls: drawn some times a second, not with each message
    this.forget();
    this.follow = true;                             // until somebody moves the map
    this.view = {x: 0, y: 0, scale: 40};            // pixels for a metre
    this.middle = [0, 0];                           // of the canvas, pixels: to ask the page for each point takes long
    listen(this);
  }

  forget() {
    this.walls.getContext("2d").clearRect(0, 0, CELLS, CELLS);
    this.origin = null;
    this.seen = [];                                 // two corners of what lasers have seen
    this.belowMs = this.drawnMs = -Infinity;
    this.changed = true;
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

  // A place where the pointer went down, with the heading to where it is; a tool takes it once the pointer is up.
  aim(from, to, isOver) {
    const [px, py] = from, {view} = this, yaw = Math.hypot(to[0] - px, to[1] - py) < 8 ? 0 : Math.atan2(py - to[1], to[0] - px);
    const at = {x: (px - this.middle[0]) / view.scale + view.x, y: view.y - (py - this.middle[1]) / view.scale, yaw};
    this.preview = isOver ? null : {...at, tint: this.tool.tint};
    this.changed = true;
    if (isOver) this.tool.done(at);
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
    const margin = 0.8, [aside, edge] = this.covered(), {clientWidth, clientHeight} = this.canvas;
    const scale = Math.min(120, (clientWidth - aside) / (right - left + 2 * margin), Math.max(80, clientHeight - 2 * edge) / (high - low + 2 * margin));
    const wanted = {x: (left + right) / 2 - aside / 2 / scale, y: (low + high) / 2, scale};
    const ease = this.fitted ? 0.5 : 1;
    for (const key of ["x", "y", "scale"]) this.view[key] += (wanted[key] - this.view[key]) * ease;
    this.fitted = true;
  }

  // How much of the map tools cover: from the left, and at most at the top or the bottom; pixels.
  covered() {
    const place = this.canvas.parentElement, its = this.canvas.getBoundingClientRect();
    const rects = names => [...place.querySelectorAll(names)].map(one => one.getBoundingClientRect()).filter(one => one.width);
    const edges = [...rects("#layers-box summary, #frame, #no-map").map(one => one.bottom - its.top), ...rects("#tools, #fit").map(one => its.bottom - one.top)];
    return [Math.max(0, ...rects("#driving").map(one => one.right - its.left)), Math.max(0, ...edges)];
  }

  // ``chosen`` is the robot whose layers are drawn, in ``frame``; it may be undefined.
  draw(robots, chosen, frame, nowMs) {
    this.robots = robots;
    this.middle = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
    const clock = performance.now();
    if (clock - this.belowMs > (this.layersChanged ? LAYERS_MS : REDRAW_MS)) {
      if (this.follow && !this.tool) this.fit(robots);
      this.drawBelow(robots, chosen, frame, nowMs);
      this.layersChanged = false;
      this.belowMs = clock;
    } else if (!this.changed || clock - this.drawnMs < FRAME_MS) return;
    this.changed = false;
    this.drawnMs = clock;
    const [drawing, width, height] = context(this.canvas);
    drawing.drawImage(this.below, 0, 0, width, height);
    const seen = robots.filter(robot => robot.pose);
    for (const robot of seen) {
      const [x, y] = this.at(robot.pose.x, robot.pose.y), old = faded(nowMs - robot.poseMs);
      drawing.globalAlpha = 1 - 0.4 * old;
      if (robot.near) ring(drawing, x, y);
      arrow(drawing, x, y, -(robot.pose.yaw ?? 0), robot === chosen ? 13 : 9, tint(robot.colour, old));
    }
    drawing.globalAlpha = 1;
    this.drawNames(drawing, seen, chosen, nowMs, width, height);
    if (this.preview) flagAt(drawing, this, this.preview, this.preview.tint);
  }

  drawNames(drawing, robots, chosen, nowMs, width, height) {
    const worth = robot => (robot === chosen ? -1 : robot.troubles?.[0]?.rank ?? 9);
    const items = [...robots].sort((one, other) => worth(one) - worth(other)).map(robot => {
      const [x, y] = this.at(robot.pose.x, robot.pose.y), ageMs = nowMs - robot.poseMs;
      return {robot, x, y, text: ageMs > OLD_MS ? `${robot.name} · ${seconds(ageMs / 1000)} old` : robot.name};
    });
    drawing.font = "600 12px system-ui, sans-serif";
    const boxes = placed(items, text => drawing.measureText(text).width, width, height);
    drawing.lineWidth = 3;
    drawing.strokeStyle = colour("lane");
    boxes.forEach((box, k) => {
      if (!box) return;
      const {robot, text} = items[k];
      drawing.strokeText(text, box[0], box[1] + BELOW_TOP, box[2] - box[0]);
      drawing.fillStyle = robot.troubles?.[0]?.level === "error" ? colour("lost") : robot === chosen ? colour("ink") : colour("soft");
      drawing.fillText(text, box[0], box[1] + BELOW_TOP, box[2] - box[0]);
    });
  }

  drawBelow(robots, chosen, frame, nowMs) {
    const ratio = devicePixelRatio || 1, width = this.canvas.clientWidth, height = this.canvas.clientHeight, {scale} = this.view;
    this.below.width = Math.round(width * ratio);
    this.below.height = Math.round(height * ratio);
    const drawing = this.below.getContext("2d");
    drawing.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (chosen) this.layers.draw(drawing, this, chosen, frame, nowMs, ["grid"]);
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
    if (this.seen.length && this.layers.isOn("laser walls")) {                         // only the part of the walls' canvas in which there are any
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
      if (!this.layers.isOn("trails")) continue;
      drawing.strokeStyle = tint(robot.colour);
      drawing.lineWidth = robot === chosen ? 2.5 : 1.5;
      drawing.globalAlpha = robot === chosen ? 0.75 : 0.4;
      drawing.beginPath();
      for (const point of robot.trail) {
        const [x, y] = this.at(point.x, point.y);
        drawing.lineTo(x, y);
      }
      drawing.stroke();
    }
    drawing.globalAlpha = 1;
    if (chosen) this.layers.draw(drawing, this, chosen, frame, nowMs, ["path", "poses", "markers", "goal"]);
    drawing.fillStyle = colour("soft");
    drawing.font = "11px system-ui, sans-serif";
    drawing.fillRect(12, height - 14, metres * scale, 2);
    drawing.lineWidth = 3;
    drawing.strokeStyle = colour("lane");
    drawing.strokeText(`${metres} m`, 12, height - 20);
    drawing.fillText(`${metres} m`, 12, height - 20);
  }
}

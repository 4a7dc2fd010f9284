// Layers of the map: which there are, which are on, and how each is drawn. What lies in other frames is led into the map's by tf.

import {colour, rgb, say} from "./draw.js";
import {within} from "./frames.js";

const BASE = ["laser walls", "trails"], HIDDEN = /costmap/, HERE = {x: 0, y: 0, yaw: 0};
export const SHAPES = {ARROW: 0, CUBE: 1, SPHERE: 2, CYLINDER: 3, STRIP: 4, LINES: 5, CUBES: 6, SPHERES: 7, POINTS: 8, TEXT: 9, MESH: 10, TRIANGLES: 11};
const ORDER = ["grid", "path", "poses", "markers", "goal"];
const css = ([red, green, blue, alpha]) => `rgb(${red * 255} ${green * 255} ${blue * 255} / ${alpha})`;

export class Layers {
  constructor(element, onChange) {
    this.element = element;
    this.onChange = onChange;
    this.rows = new Map();
    try {
      this.chosen = JSON.parse(localStorage.getItem("layers")) ?? {};
    } catch {
      this.chosen = {};
    }
  }

  isOn(name) { return this.chosen[name] ?? !HIDDEN.test(name); }

  // One box for each layer that the robot has; ``topics`` are those that can be drawn.
  list(robot, topics) {
    const names = [...BASE, ...topics.flatMap(topic => [topic, ...(robot.layers.get(topic)?.spaces ?? []).filter(Boolean).map(space => `${topic} ${space}`)])];
    for (const [name, row] of this.rows) if (!names.includes(name)) {
      row.remove();
      this.rows.delete(name);
    }
    names.forEach((name, k) => {
      if (!this.rows.has(name)) this.rows.set(name, this.row(name));
      const row = this.rows.get(name), lost = robot.layers.get(name)?.lost;
      if (this.element.children[k] !== row) this.element.insertBefore(row, this.element.children[k] ?? null);
      say(row.children[2], lost ? `in ${lost}: tf does not lead there` : "");
    });
  }

  row(name) {
    const row = document.createElement("label");
    row.innerHTML = `<input type="checkbox"><span></span><span class="soft"></span>`;
    const box = row.querySelector("input");
    row.children[1].textContent = name;
    box.checked = this.isOn(name);
    box.onchange = () => {
      this.chosen[name] = box.checked;
      localStorage.setItem("layers", JSON.stringify(this.chosen));
      this.onChange();
    };
    return row;
  }

  // Those of these kinds; ``map`` says where a point of its frame is on the canvas.
  draw(drawing, map, robot, frame, nowMs, kinds) {
    const sorted = [...robot.layers].sort(([, one], [, other]) => ORDER.indexOf(one.kind) - ORDER.indexOf(other.kind));
    for (const [topic, layer] of sorted) {
      if (!kinds.includes(layer.kind) || !this.isOn(topic)) continue;
      layer.lost = "";
      if (layer.kind === "markers") this.markers(drawing, map, robot, frame, nowMs, topic, layer);
      else this.led(robot, layer, layer.frame, frame, to => this[layer.kind](drawing, map, to, layer, robot));
    }
    drawing.globalAlpha = 1;
  }

  led(robot, layer, from, frame, draw) {
    const to = !from || !frame || from === frame ? HERE : robot.place.tree.between(from, frame);
    if (to) draw(to);
    else layer.lost = from;
  }

  grid(drawing, map, to, layer) {
    const theme = colour("wall") + colour("paper");
    if (layer.theme !== theme) [layer.image, layer.theme] = [painted(layer), theme];
    const {x, y, yaw} = within(to, layer.origin), [px, py] = map.at(x, y), scale = map.view.scale * layer.cellM;
    drawing.save();
    drawing.translate(px, py);
    drawing.rotate(-yaw);
    drawing.scale(scale, -scale);
    drawing.imageSmoothingEnabled = scale < 1;
    drawing.drawImage(layer.image, 0, 0);
    drawing.restore();
  }

  path(drawing, map, to, layer) {
    line(drawing, layer.places.map(at => within(to, at)), map);
    drawing.lineWidth = 3;
    drawing.setLineDash([9, 5]);
    drawing.strokeStyle = colour("plan");
    drawing.stroke();
    drawing.setLineDash([]);
  }

  poses(drawing, map, to, layer) {
    drawing.strokeStyle = colour("plan");
    drawing.lineWidth = 1;
    drawing.globalAlpha = 0.7;
    drawing.beginPath();
    for (const at of layer.places) {
      const {x, y, yaw} = within(to, at), [px, py] = map.at(x, y);
      drawing.moveTo(px, py);
      drawing.lineTo(px + 9 * Math.cos(yaw), py - 9 * Math.sin(yaw));
    }
    drawing.stroke();
    drawing.globalAlpha = 1;
  }

  goal(drawing, map, to, layer) { for (const at of layer.places) flagAt(drawing, map, within(to, at), colour("plan")); }

  markers(drawing, map, robot, frame, nowMs, topic, layer) {
    for (const [key, marker] of layer.markers) {
      if (marker.untilMs < nowMs) layer.markers.delete(key);
      else if (this.isOn(`${topic} ${marker.space}`)) this.led(robot, layer, marker.frame, frame, to => shape(drawing, map, within(to, marker.at), marker));
    }
  }
}

// A grid's cells as a picture: what is free is paper, what is not is wall, and what nobody knows is neither.
export function painted({width, height, cells}) {
  const canvas = Object.assign(document.createElement("canvas"), {width, height}), drawing = canvas.getContext("2d");
  const image = drawing.createImageData(width, height), words = new Uint32Array(image.data.buffer), colours = new Uint32Array(256);
  const [free, wall] = [rgb(colour("paper")), rgb(colour("wall"))];
  for (let value = 0; value <= 100; value++) {
    const [red, green, blue] = free.map((part, k) => Math.round(part + (wall[k] - part) * value / 100));
    colours[value] = new Uint32Array(new Uint8Array([red, green, blue, 255]).buffer)[0];
  }
  for (let k = 0; k < cells.length; k++) words[k] = colours[cells[k] & 255];
  drawing.putImageData(image, 0, 0);
  return canvas;
}

function line(drawing, points, map) {
  drawing.beginPath();
  for (const {x, y} of points) drawing.lineTo(...map.at(x, y));
}

// Where a robot shall go, or stand: a ring, and a line that way.
export function flagAt(drawing, map, {x, y, yaw}, tint) {
  const [px, py] = map.at(x, y);
  drawing.strokeStyle = drawing.fillStyle = tint;
  drawing.lineWidth = 2.5;
  drawing.beginPath();
  drawing.arc(px, py, 8, 0, 7);
  drawing.moveTo(px, py);
  drawing.lineTo(px + 24 * Math.cos(yaw), py - 24 * Math.sin(yaw));
  drawing.stroke();
  drawing.beginPath();
  drawing.arc(px + 24 * Math.cos(yaw), py - 24 * Math.sin(yaw), 4, 0, 7);
  drawing.fill();
}

// A marker that stands at ``to``; its points count from there. Seen from above, so a ball is a disc and a box a rectangle.
function shape(drawing, map, to, marker) {
  const {size: [sx, sy], points, colours} = marker, {scale} = map.view, tint = css(marker.colour), at = points.map(one => within(to, one));
  const own = k => colours.length === points.length ? css(colours[k]) : tint;
  const disc = ({x, y}, width, height, yaw = to.yaw) => {
    drawing.beginPath();
    drawing.ellipse(...map.at(x, y), Math.max(1, width * scale / 2), Math.max(1, height * scale / 2), -yaw, 0, 7);
    drawing.fill();
  };
  const box = ({x, y}, width, height) => {
    drawing.save();
    drawing.translate(...map.at(x, y));
    drawing.rotate(-to.yaw);
    const [w, h] = [Math.max(2, width * scale), Math.max(2, height * scale)];
    drawing.fillRect(-w / 2, -h / 2, w, h);
    drawing.restore();
  };
  drawing.fillStyle = drawing.strokeStyle = tint;
  drawing.lineWidth = Math.max(1.5, sx * scale);
  switch (marker.shape) {
    case SHAPES.ARROW: {
      const tip = at[1] ?? within(to, {x: sx, y: 0});
      drawing.lineWidth = Math.max(2, Math.min(8, sy * scale));
      line(drawing, [at[0] ?? to, tip], map);
      drawing.stroke();
      disc(tip, 8 / scale, 8 / scale);
      break;
    }
    case SHAPES.CUBE: box(to, sx, sy); break;
    case SHAPES.SPHERE: case SHAPES.CYLINDER: disc(to, sx, sy); break;
    case SHAPES.STRIP: line(drawing, at, map); drawing.stroke(); break;
    case SHAPES.LINES: case SHAPES.TRIANGLES: {
      const corners = marker.shape === SHAPES.LINES ? 2 : 3;
      for (let k = 0; k + corners <= at.length; k += corners) {
        drawing.fillStyle = drawing.strokeStyle = own(k);
        line(drawing, at.slice(k, k + corners), map);
        if (corners === 2) drawing.stroke();
        else drawing.fill();
      }
      break;
    }
    case SHAPES.SPHERES: at.forEach((one, k) => { drawing.fillStyle = own(k); disc(one, sx, sy); }); break;
    case SHAPES.CUBES: case SHAPES.POINTS: at.forEach((one, k) => { drawing.fillStyle = own(k); box(one, sx, sy); }); break;
    case SHAPES.TEXT:
      drawing.font = "600 12px system-ui, sans-serif";
      drawing.textAlign = "center";
      drawing.fillText(marker.text, ...map.at(to.x, to.y));
      drawing.textAlign = "left";
      break;
  }
}

// The 3-D tab: clouds, markers, the map and the robots in the frame that the map has. Loaded once somebody opens it.

import {cloud, Thinning} from "./cloud.js";
import {aged, colour, context, rgb, say, seconds, tint} from "./draw.js";
import {painted, SHAPES} from "./layers.js";
import {multiply, project, rigid, seen} from "./matrix.js";
import {listen} from "./orbit.js";
import {Scene} from "./scene.js";

const FRAME_MS = 30, ZOOM = 1.1, HERE = {at: [0, 0, 0], turn: [0, 0, 0, 1]}, MOST_PITCH = 1.55, MOST_TEXTS = 200;
const NEAR_M = 0.5, FAR_M = 5000, POINT_PX = 2, ARROW_M = 0.4, BODIES = {[SHAPES.CUBE]: "cube", [SHAPES.CUBES]: "cube",
  [SHAPES.SPHERE]: "sphere", [SHAPES.SPHERES]: "sphere", [SHAPES.CYLINDER]: "cylinder"};
// A robot: an arrow on the ground, two triangles, the second of them darker.
const ROBOT = new Float32Array([0.55, 0, 0.05, -0.4, 0.35, 0.05, -0.25, 0, 0.22, 0.55, 0, 0.05, -0.25, 0, 0.22, -0.4, -0.35, 0.05]), DARKER = 0.72;

const flat = at => ({at: [at.x, at.y, at.z ?? 0], turn: at.turn ?? [0, 0, Math.sin(at.yaw / 2), Math.cos(at.yaw / 2)]});

// The same colour for each of some points.
/** @type {(colour: number[], count: number) => Uint8Array} */
const alike = ([red, green, blue, alpha = 255], count) => {
  const colours = new Uint8Array(4 * count);
  for (let k = 0; k < colours.length; k += 4) colours.set([red, green, blue, alpha], k);
  return colours;
};

export class Space {
  // ``nowMs()`` is the time by which markers end.
  constructor($, layers, nowMs) {
    this.$ = $;
    this.layers = layers;
    this.nowMs = nowMs;
    const [canvas, over] = $("space").querySelectorAll("canvas");
    this.canvas = canvas;
    this.over = over;
    this.scene = new Scene(this.canvas);
    this.held = new Map();                          // what is on the graphics card, by what it shows
    this.shade = "";                                // the field that gives a cloud its colours
    this.drawnMs = this.frameMs = -Infinity;
    this.thinning = new Thinning();
    this.drewClouds = false;
    this.home();
    listen(this.canvas, this);
    $("home").onclick = () => this.home();
    $("shade").onchange = () => {
      this.shade = $("shade").value;
      this.changed = true;
    };
  }

  home() {
    this.view = {target: [0, 0, 0], yaw: -2.4, pitch: 0.55, distance: 14};
    this.follow = this.changed = true;
  }

  turn(dx, dy) {
    this.view.yaw -= dx / 150;
    this.view.pitch = Math.min(MOST_PITCH, Math.max(-MOST_PITCH, this.view.pitch + dy / 150));
    this.changed = true;
  }

  shift(dx, dy) {
    const {view} = this, metre = view.distance / (ZOOM * this.canvas.clientHeight), [cos, sin, lift] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.sin(view.pitch)];
    const [aside, up] = [-dx * metre, dy * metre];
    view.target = [view.target[0] - aside * sin - up * lift * cos, view.target[1] + aside * cos - up * lift * sin, view.target[2] + up * Math.cos(view.pitch)];
    this.follow = false;
    this.changed = true;
  }

  zoom(factor) {
    this.view.distance = Math.min(FAR_M, Math.max(NEAR_M, this.view.distance / factor));
    this.changed = true;
  }

  // Each frame of the screen; ``frame`` is the map's, ``robots`` are those in it.
  draw(robots, chosen, frame) {
    const clock = performance.now();
    if (this.drewClouds) this.thinning.took(clock - this.frameMs);
    this.frameMs = clock;
    this.drewClouds = false;
    if (!this.changed || clock - this.drawnMs < FRAME_MS || this.scene.lost) return;
    this.changed = false;
    this.drawnMs = clock;
    if (this.follow && chosen.pose) this.view.target = [chosen.pose.x, chosen.pose.y, 0];
    const camera = seen(this.view, ZOOM, this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight));
    this.texts = [];
    this.used = new Set();
    this.scene.begin(rgb(colour("lane")), camera, ZOOM);
    this.drawGround();
    for (const [topic, layer] of chosen.layers) if (this.layers.isOn(topic)) {
      layer.fault = "";
      if (layer.kind === "markers") this.drawMarkers(topic, layer, chosen, frame);
      else if (layer.kind === "cloud") this.drawCloud(topic, layer, chosen, frame);
      else this.drawFlat(topic, layer, chosen, frame);
    }
    if (chosen.scan) this.drawScan(chosen, frame);
    for (const robot of robots) if (robot.pose) this.drawRobot(robot, robot === chosen);
    for (const [key, held] of this.held) if (!this.used.has(key)) {
      for (const item of held.items) this.scene.free(item);
      this.held.delete(key);
    }
    this.write(camera);
  }

  // What ``make`` put on the graphics card for this ``source``; made anew when that is another.
  kept(key, source, make) {
    this.used.add(key);
    const held = this.held.get(key);
    if (held?.source === source) return held;
    for (const item of held?.items ?? []) this.scene.free(item);
    const made = {source, items: [], ...make()};
    this.held.set(key, made);
    return made;
  }

  // How a frame lies in the one that is shown. Of a robot without tf all stands where the robot does.
  led(robot, layer, from, frame) {
    if (!from || !frame || from === frame) return HERE;
    const {tree} = robot.place, to = tree.pose(from, frame) ?? (tree.links.size === 0 && robot.pose ? flat(robot.pose) : undefined);
    if (!to) layer.lost = from;
    return to;
  }

  drawGround() {
    const {target, distance} = this.view, step = 10 ** Math.round(Math.log10(distance / 10)), [x, y] = target.slice(0, 2).map(value => Math.round(value / step) * step);
    const {items: [lines]} = this.kept("ground", [x, y, step, colour("rule")].join(), () => {
      const places = [];
      for (let k = -20; k <= 20; k++) places.push(k * step, -20 * step, 0, k * step, 20 * step, 0, -20 * step, k * step, 0, 20 * step, k * step, 0);
      return {items: [this.scene.upload(new Float32Array(places), alike(rgb(colour("rule")), places.length / 3))]};
    });
    this.scene.drawLines(lines, rigid({...HERE, at: [x, y, -0.01]}), false, 0, 0.5);
  }

  drawCloud(topic, layer, robot, frame) {
    const held = this.kept(topic, layer.message, () => ({shade: null, every: 1})), {every} = this.thinning;
    this.drewClouds = true;
    if (held.shade !== this.shade || held.every !== every) {
      for (const item of held.items.splice(0)) this.scene.free(item);
      [held.shade, held.every] = [this.shade, every];
      try {
        held.cloud = cloud(layer.message, this.shade, every);
        held.items.push(this.scene.upload(held.cloud.places, held.cloud.colours));
      } catch (error) {
        held.fault = error instanceof RangeError ? "not what it says it is" : error.message;
      }
    }
    Object.assign(layer, {lost: "", fault: held.fault ?? "", count: held.cloud?.count ?? 0, every, by: held.cloud?.by, fields: held.cloud?.fields ?? []});
    const to = held.items.length ? this.led(robot, layer, held.cloud.frame, frame) : undefined;
    if (to) this.scene.drawPoints(held.items[0], rigid(to), 0, POINT_PX);
  }

  // A grid, a path, poses or a goal, on the ground.
  drawFlat(topic, layer, robot, frame) {
    const to = this.led(robot, layer, layer.frame, frame);
    if (!to) return;
    if (layer.kind === "grid") {
      const {items: [{texture}]} = this.kept(topic + colour("paper"), layer, () => ({items: [{texture: this.scene.texture(painted(layer))}]}));
      this.scene.drawPicture(texture, multiply(rigid(to), rigid(flat({...layer.origin, z: -0.02}))), [layer.width * layer.cellM, layer.height * layer.cellM]);
      return;
    }
    const {items: [lines]} = this.kept(topic + colour("plan"), layer, () => {
      const places = layer.places.flatMap(({x, y, yaw}) =>
        layer.kind === "path" ? [x, y, 0.03] : [x, y, 0.03, x + ARROW_M * Math.cos(yaw), y + ARROW_M * Math.sin(yaw), 0.03]);
      return {items: [this.scene.upload(new Float32Array(places), alike(rgb(colour("plan")), places.length / 3))]};
    });
    this.scene.drawLines(lines, rigid(to), layer.kind === "path", 0.05, layer.kind === "poses" ? 0.6 : 1.5);
  }

  drawScan(robot, frame) {
    const {scan} = robot, {items: [points]} = this.kept("scan", scan, () => {
      const places = [];
      scan.ranges.forEach((range, k) => {
        const angle = scan.angle_min + k * scan.angle_increment;
        if (Number.isFinite(range)) places.push(range * Math.cos(angle), range * Math.sin(angle), 0);
      });
      return {items: [this.scene.upload(new Float32Array(places), alike(rgb(tint(robot.colour)), places.length / 3))]};
    });
    const to = robot.place.tree.pose(scan.frame, frame) ?? (robot.pose && flat(robot.pose));
    if (to) this.scene.drawPoints(points, rigid(to), 0, POINT_PX + 1);
  }

  drawMarkers(topic, layer, robot, frame) {
    const nowMs = this.nowMs();
    for (const [key, marker] of layer.markers) {
      if (marker.untilMs < nowMs || !this.layers.isOn(`${topic} ${marker.space}`)) continue;
      const to = this.led(robot, layer, marker.frame, frame);
      if (to) this.drawMarker(`${topic} ${key}`, marker, multiply(rigid(to), rigid(flat(marker.at))));
    }
  }

  drawMarker(key, marker, model) {
    const {scene} = this, {size, points, colours, shape} = marker, bytes = ([red, green, blue, alpha]) => [red * 255, green * 255, blue * 255, alpha * 255];
    if (shape === SHAPES.TEXT) {
      this.texts.push({at: [model[12], model[13], model[14]], text: marker.text, css: `rgb(${bytes(marker.colour).slice(0, 3).join(" ")})`});
      return;
    }
    const {items: [item]} = this.kept(key, marker, () => {
      const isList = shape >= SHAPES.STRIP || (shape === SHAPES.ARROW && points.length > 1);
      const places = isList ? points.flatMap(({x, y, z}) => [x, y, z]) : shape === SHAPES.ARROW ? [0, 0, 0, size[0], 0, 0] : [0, 0, 0];
      const tints = alike(bytes(marker.colour), places.length / 3);
      if (isList && colours.length === points.length) tints.set(colours.flatMap(bytes));
      return {items: [scene.upload(new Float32Array(places), tints)]};
    });
    if (!item.count) return;
    if (BODIES[shape]) scene.drawBodies(BODIES[shape], item, model, size);
    else if (shape === SHAPES.POINTS) scene.drawPoints(item, model, size[0], POINT_PX);
    else if (shape === SHAPES.TRIANGLES) scene.drawTriangles(item, model);
    else if (shape === SHAPES.ARROW) scene.drawLines(item, model, false, points.length > 1 ? size[0] : size[1], 1.5);
    else if (shape === SHAPES.STRIP || shape === SHAPES.LINES) scene.drawLines(item, model, shape === SHAPES.STRIP, size[0]);
  }

  drawRobot(robot, isChosen) {
    const css = tint(robot.colour), {items: [item]} = this.kept(`robot ${robot.name}`, css, () => {
      const colours = alike(rgb(css), 6);
      for (let k = 12; k < 24; k++) if (k % 4 < 3) colours[k] *= DARKER;
      return {items: [this.scene.upload(ROBOT, colours)]};
    });
    const at = flat(robot.pose);
    this.scene.drawTriangles(item, rigid(at));
    this.texts.push({at: [at.at[0], at.at[1], 0.35], text: robot.name, css: colour(isChosen ? "ink" : "soft")});
  }

  // Names and texts, over the scene.
  write(camera) {
    const [drawing, width, height] = context(this.over);
    drawing.font = "600 12px system-ui, sans-serif";
    drawing.textAlign = "center";
    drawing.lineWidth = 3;
    drawing.strokeStyle = colour("lane");
    for (const {at, text, css} of this.texts.slice(-MOST_TEXTS)) {
      const [x, y] = project(camera, at) ?? [-1, -1];
      drawing.strokeText(text, x * width, y * height);
      drawing.fillStyle = css;
      drawing.fillText(text, x * width, y * height);
    }
  }

  // Some times a second.
  say(robot, nowMs) {
    const clouds = [...robot.layers].filter(([topic, layer]) => layer.kind === "cloud" && this.layers.isOn(topic));
    const said = clouds.map(([topic, {count, every, fault, lost, ms}]) =>
      `${topic}: ${fault || (lost ? `in ${lost}, and tf does not lead there` : `${count?.toLocaleString("en") ?? "no"} points${every > 1 ? `, 1 in ${every} as this machine is busy` : ""}, ${seconds((nowMs - ms) / 1000)} old`)}`);
    say(this.$("space").querySelector("figcaption"), this.scene.lost ? "This browser has lost its graphics: reload the page." : said.join(" · ") || "no PointCloud2");
    aged(this.$("space"), clouds.length ? nowMs - Math.max(...clouds.map(([, layer]) => layer.ms)) : 0);
    const names = ["", ...new Set(clouds.flatMap(([, layer]) => layer.fields ?? []))], select = this.$("shade");
    if (select.dataset.offered !== names.join()) {
      select.dataset.offered = names.join();
      select.replaceChildren(...names.map(name => new Option(name === "" ? "as they come" : name === "z" ? "by height" : `by ${name}`, name)));
      select.value = this.shade = names.includes(this.shade) ? this.shade : "";
    }
    if (robot.layers.size) this.changed = true;     // markers end, and what is on may have changed
  }
}

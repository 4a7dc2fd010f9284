// A robot's cameras: one beside its laser, all side by side on a tab, and one as large as the screen.

import {aged, context, say, seconds} from "./draw.js";
import {picture, unseen} from "./pictures.js";

// Decode the latest picture, one at a time for each camera.
function decode(camera) {
  if (!camera.coming || camera.decoding) return;
  const message = camera.coming, ms = camera.comingMs;
  camera.coming = null;
  camera.decoding = true;
  picture(message).then(bitmap => {
    camera.bitmap?.close();
    Object.assign(camera, {bitmap, ms, changed: true, fault: ""});
  }, error => { camera.fault = String(error.message); }).finally(() => { camera.decoding = false; });
}

function show(canvas, bitmap) {
  const [drawing, width, height] = context(canvas);
  if (!bitmap) return;
  const scale = Math.min(width / bitmap.width, height / bitmap.height), [w, h] = [bitmap.width * scale, bitmap.height * scale];
  drawing.drawImage(bitmap, (width - w) / 2, (height - h) / 2, w, h);
}

function caption(camera, nowMs) {
  if (!camera) return "no picture";
  while (camera.frames.length && camera.frames[0] < nowMs - 2000) camera.frames.shift();
  if (camera.fault) return `${camera.topic}: ${camera.fault}`;
  return camera.bitmap ? `${camera.topic}, ${(camera.frames.length / 2).toFixed(1)} a second, ${seconds((nowMs - camera.ms) / 1000)} old` : `${camera.topic}: no picture yet`;
}

// A figure that is pressed like a button.
function press(figure, act) {
  Object.assign(figure, {role: "button", tabIndex: 0, onclick: act, onkeydown: event => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    act();
  }});
}

export class Cameras {
  constructor(first, all, large) {
    this.first = first;
    this.all = all;
    this.large = large;
    this.topic = null;
    this.figures = new Map();
    press(first, () => this.enlarge([...this.robot?.cameras.keys() ?? []][0]));
    large.onclick = () => large.close();
    large.onclose = () => { this.topic = null; };
  }

  enlarge(topic) {
    if (!this.robot.cameras.get(topic)?.bitmap) return;
    this.topic = topic;
    this.redraw = true;
    if (!this.large.open) this.large.showModal();
  }

  // Each frame of the screen.
  draw(robot, tab) {
    if (this.robot !== robot) {
      this.robot = robot;
      this.redraw = true;
      this.figures.clear();
      this.all.replaceChildren();
      if (this.large.open) this.large.close();
    }
    const cameras = [...robot.cameras.values()];
    cameras.forEach((camera, k) => {
      decode(camera);
      if (!camera.changed && !this.redraw) return;
      if (k === 0 && tab === "overview") show(this.first.querySelector("canvas"), camera.bitmap);
      if (tab === "cameras") show(this.figure(camera.topic).firstChild, camera.bitmap);
      if (this.topic === camera.topic) show(this.large.querySelector("canvas"), camera.bitmap);
      camera.changed = false;
    });
    if (!cameras.length && this.redraw) show(this.first.querySelector("canvas"));
    this.redraw = false;
  }

  // Some times a second.
  say(robot, topics, nowMs) {
    const said = (figure, camera) => {
      figure.classList.toggle("blank", !camera?.bitmap && Boolean(camera?.fault));
      say(figure.querySelector("figcaption"), caption(camera, nowMs));
      aged(figure, camera?.bitmap ? nowMs - camera.ms : 0);
    };
    const isVideo = topic => robot.kinds[topic] === "video";
    const of = topic => robot.cameras.get(topic) ?? {topic, frames: [], fault: isVideo(topic) && unseen(topic, robot.status?.publishes[topic]?.type)};
    for (const topic of topics) said(this.figure(topic), of(topic));
    say(this.all.nextElementSibling, topics.length ? "" : "This robot has no camera.");
    said(this.first, [...robot.cameras.values()][0] ?? topics.filter(isVideo).map(of)[0]);
    if (this.topic !== null && robot.cameras.has(this.topic)) said(this.large, robot.cameras.get(this.topic));
  }

  figure(topic) {
    if (!this.figures.has(topic)) {
      const figure = document.createElement("figure");
      figure.innerHTML = "<canvas></canvas><figcaption></figcaption>";
      press(figure, () => this.enlarge(topic));
      this.all.append(figure);
      this.figures.set(topic, figure);
      this.redraw = true;
    }
    return this.figures.get(topic);
  }
}

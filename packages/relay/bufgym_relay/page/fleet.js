// What the robots have said: a state for each, which messages change and others draw.

import {Stamps} from "./clock.js";
import {colourOf, seconds} from "./draw.js";
import {layer} from "./drawings.js";
import {unpacked} from "./flat.js";
import {Place, within} from "./frames.js";
import {charge, diagnostics, DRAWN, flag, json, kindOf, queue, scan, status} from "./messages.js";
import {stopsOf} from "./stops.js";

export const AWAY_MS = 5000, LOW = 0.25;
export const GONE_MS = 600_000;                     // who was not here for so long needs nobody now
const HISTORY_MS = 60_000, TRAIL_GAP_MS = 300, POSES = 100, NEAR_MS = 20, GAP_MS = 400, PARTS = 500, LAYERS = 64, EARLY = 1000;
const JUMPED_MS = 60_000;                           // a jump of a robot's clock is told for so long
const SAME_MS = 3000;                               // a text that is said for longer says for how long
const LATELY_MS = 10_000, MANY = 0.3;               // a robot that drops so many of its messages lately is in trouble
const ROBOT = /^\/(?:robots\/([^/]+)|(ut\/[^/]+))\/(.+)$/;  // ours, and Robofleet's

// A robot's name and the topic below it; empty where a topic is no robot's.
export function split(topic) {
  const [, name, released, own] = ROBOT.exec(topic) ?? [];
  return {name: name ?? released, topic: own};
}

export class Fleet {
  // on: {nowMs(), drawn(robot), added(robot), here(robot), removed(name), status(robot), stopped(robot), claimed(name, why), reframed(robot), scanned(robot, pose, scan), moved()}
  constructor(on) {
    this.on = on;
    this.robots = new Map();
    this.early = new Map();                         // latched messages of robots that have said nothing yet, by topic
  }

  clear() {
    this.robots.clear();
    this.early.clear();
  }

  get(name) { return this.robots.get(name); }
  all() { return [...this.robots.values()]; }

  // Those of these kinds among all robots' topics, without the robots' names.
  topics(kinds, robots = this.all()) {
    return robots.flatMap(robot => Object.keys(robot.kinds).filter(topic => kinds.includes(robot.kinds[topic])));
  }

  of(name) {
    if (!this.robots.has(name)) {
      const robot = {name, colour: colourOf(name), place: new Place(name), kinds: Object.create(null), heardMs: 0, isHere: false};
      this.robots.set(name, robot);
      this.blank(robot);
      this.on.added(robot);
    }
    return this.robots.get(name);
  }

  // A robot's first message to this page.
  enter(robot) {
    robot.isHere = true;
    this.on.here(robot);
    for (const [topic, message] of this.early) if (split(topic).name === robot.name) {
      this.early.delete(topic);
      this.take(message, true);
    }
  }

  remove(name) {
    if (this.robots.delete(name)) this.on.removed(name);
  }

  // What the relay says of a robot that is away: its last status and when that was; null where somebody has removed it.
  takeLast(name, said, seenMs) {
    const known = this.robots.get(name);
    if (said === null && (!known || known.away || !known.isHere)) return this.remove(name);
    if (said === null || (known && known.heardMs >= seenMs)) return;
    const robot = this.of(name);
    robot.heardMs = Math.min(seenMs, this.on.nowMs());
    if (!robot.isHere) this.takeStatus(robot, status(said), seenMs);
  }

  // As it was before its first message; what its topics are is known still.
  blank(robot) {
    Object.assign(robot, {trail: [], poses: [], history: [], stamps: new Stamps(), unplaced: null, poseMs: 0, queueMs: 0, estop: new Map(),
      cameras: new Map(), layers: new Map(), parts: new Map()});
    robot.place.forget();
  }

  // A latched message may be as old as it likes: it does not say that its robot is there.
  take(message, isLatched = false) {
    const {name, topic} = split(message.topic);
    if (name && message.encoding === "robofleet") message = unpacked(message);
    if (!name || !message) return;
    if (topic === "stop") {                         // a stop says nothing of whether its robot is there
      const known = this.robots.get(name);
      if (known && stopsOf(json(message)?.stops).some(stop => stop.isHeld)) this.on.stopped(known);
      return;
    }
    if (topic === "claim") return this.on.claimed(name, String(json(message)?.why ?? "").slice(0, 300));
    if (topic === "last") return this.takeLast(name, json(message), message.atMs ?? message.stampMs);
    if (isLatched && !this.robots.get(name)?.isHere) {
      if (this.early.size < EARLY) this.early.set(message.topic, message);
      return;
    }
    const robot = this.of(name), atMs = message.atMs ?? this.on.nowMs();  // a recording has no time of the relay
    if (!isLatched) robot.heardMs = Math.max(robot.heardMs, atMs);
    if (!robot.isHere) this.enter(robot);
    const ms = isLatched ? atMs : robot.stamps.made(message.stampMs, atMs);
    if (topic === "status") return this.takeStatus(robot, status(json(message)), ms);
    if (topic === "queue") return this.takeQueue(robot, queue(json(message)), ms);
    const kind = robot.kinds[topic] ??= message.kind ?? kindOf(topic, message);
    if (kind === "pose" || kind === "tf") this.takePose(robot, robot.place.take(topic, kind, message, ms), ms);
    else if (kind === "scan") this.takeScan(robot, scan(message), ms);
    else if (kind === "picture") this.takePicture(robot, topic, message, ms);
    else if (kind === "battery") robot.charge = charge(message);
    else if (kind === "estop") robot.estop.set(topic, flag(message));
    else if (kind === "diagnostics") this.takeParts(robot, diagnostics(message), ms);
    if (DRAWN.includes(kind) || kind === "cloud") this.takeLayer(robot, topic, kind, message, ms);
  }

  takeStatus(robot, status, ms) {
    if (robot.status?.text !== status.text) robot.textMs = ms;  // since when it says so
    robot.status = status;
    for (const [topic, what] of Object.entries(status.publishes ?? {})) robot.kinds[topic] ??= kindOf(topic, what);
    this.takePose(robot, robot.place.takeStatus(status.location, ms), ms);
    if (status.queue && !(robot.queueMs > ms - 3000)) this.takeQueue(robot, status.queue, ms, false);
    this.on.status(robot);
  }

  takeQueue(robot, queue, ms, own = true) {
    robot.queue = queue;
    robot.saidMs = ms;
    if (own) robot.queueMs = ms;
    robot.history.push({ms, queued: queue.queued, capacity: queue.capacity, rate: queue.rate_bps ?? 0, put: queue.put ?? 0, dropped: queue.dropped, drops: 0});
    robot.history.sort((one, other) => one.ms - other.ms);
    while (robot.history[0].ms < ms - HISTORY_MS - 1000) robot.history.shift();
    for (let k = 1; k < robot.history.length; k++) {
      const [before, entry] = [robot.history[k - 1], robot.history[k]];
      entry.drops = Math.max(0, entry.dropped - before.dropped) / Math.max(0.1, (entry.ms - before.ms) / 1000);
    }
    robot.queueChanged = true;
  }

  takePose(robot, at, ms) {
    if (!at || robot.poseMs > ms) return;
    if (robot.pose && robot.pose.frame !== at.frame) {  // what was drawn lies in another frame
      robot.trail = [];
      robot.poses = [];
      this.on.reframed(robot);
    }
    robot.pose = at;
    robot.poseMs = ms;
    robot.poses.push({...at, ms});
    if (robot.poses.length > POSES) robot.poses.shift();
    if (!robot.trail.length || ms - robot.trail.at(-1).ms >= TRAIL_GAP_MS) robot.trail.push({x: at.x, y: at.y, ms});
    this.placeScan(robot);
    this.on.moved();
  }

  takeScan(robot, scan, ms) {
    if (!this.on.drawn(robot)) return;
    Object.assign(robot, {scan, scanMs: ms, scanChanged: true});
    robot.unplaced = {scan, ms};
    this.placeScan(robot);
  }

  // A scan lies where the robot was at its time; the pose of that time may come behind it.
  placeScan(robot) {
    const {scan, ms} = robot.unplaced ?? {}, then = scan && poseAt(robot, ms);
    if (!then) return;
    robot.unplaced = null;
    const {tree} = robot.place, mounted = tree.base && scan.frame && tree.between(scan.frame, tree.base);
    this.on.scanned(robot, mounted ? within(then, mounted) : then, scan);
  }

  // Only the latest picture is decoded.
  takePicture(robot, topic, message, ms) {
    if (!this.on.drawn(robot) || (!robot.cameras.has(topic) && robot.cameras.size >= LAYERS)) return;
    if (!robot.cameras.has(topic)) robot.cameras.set(topic, {topic, frames: []});
    const camera = robot.cameras.get(topic);
    Object.assign(camera, {coming: message, comingMs: ms});
    camera.frames.push(this.on.nowMs());
  }

  takeLayer(robot, topic, kind, message, ms) {
    if (!this.on.drawn(robot) || (!robot.layers.has(topic) && robot.layers.size >= LAYERS)) return;
    robot.layers.set(topic, layer(kind, message, ms, robot.layers.get(topic)));
    this.on.moved(true);
  }

  takeParts(robot, parts, ms) {
    for (const part of parts) if (robot.parts.size < PARTS || robot.parts.has(part.name)) robot.parts.set(part.name, {...part, ms});
  }
}

// Where a robot was: between two poses, or right at one.
function poseAt(robot, ms) {
  const k = robot.poses.findIndex(at => at.ms >= ms), after = robot.poses[k], before = robot.poses[k - 1];
  const near = [before, after, robot.poses.at(-1)].find(at => at && Math.abs(at.ms - ms) < NEAR_MS);
  if (!before || !after || after.ms - before.ms > GAP_MS) return near;
  const part = (ms - before.ms) / Math.max(1, after.ms - before.ms), turn = Math.atan2(Math.sin(after.yaw - before.yaw), Math.cos(after.yaw - before.yaw));
  return {x: before.x + part * (after.x - before.x), y: before.y + part * (after.y - before.y), yaw: before.yaw + part * turn};
}

// What a robot says of itself, and for how long; of one that is silent it is what it said before.
export function doing(robot, nowMs) {
  const {text} = robot.status ?? {}, saidMs = nowMs - robot.textMs;
  if (nowMs - robot.heardMs > AWAY_MS) return text ? `silent; before: ${text}` : "silent";
  return text ? `${text}${saidMs > SAME_MS ? `, for ${seconds(saidMs / 1000)}` : ""}` : "";
}

export const battery = robot => robot.status?.battery ?? robot.charge;

// The part of a robot's messages that it dropped in the last ten seconds.
function dropping(robot) {
  const last = robot.history.at(-1), first = robot.history.find(entry => entry.ms >= (last?.ms ?? 0) - LATELY_MS);
  return last && last.put > first.put ? (last.dropped - first.dropped) / (last.put - first.put) : 0;
}

// What is wrong with a robot, the worst first: {kind, rank, level, text}; kinds are fault, silent, stopped, battery, clock, dropping, near and warning.
export function troubles(robot, nowMs) {
  const {status = {}} = robot, silentMs = nowMs - robot.heardMs, charged = battery(robot), part = dropping(robot), found = [];
  if (!robot.isHere && silentMs > GONE_MS) return [];
  const say = (kind, rank, level, text, sinceMs = nowMs) => found.push({kind, rank, level, text, sinceMs});
  const parts = [...robot.parts.values()].filter(part => part.level > 0).sort((one, other) => other.level % 3 - one.level % 3);
  if (status.estop || [...robot.estop.values()].includes(true)) say("emergency stop", 0, "error", "emergency stop");
  if (status.ok === false) say("fault", 0, "error", status.text || "not OK");
  const broken = parts.find(part => part.level === 2), doubtful = parts.find(part => part.level !== 2);
  if (broken) say("diagnostics", 0, "error", `${broken.name}: ${broken.says}`);
  if (silentMs > AWAY_MS) say("silent", 1, "error", "silent", robot.heardMs);
  if (status.stop) say("stopped", 2, "warn", `stopped by ${status.stop.by}`);
  if (charged < LOW) say("battery", 2, "error", "low battery");
  const {jump} = robot.stamps;
  if (jump && nowMs - jump.ms < JUMPED_MS) say("clock", 3, "warn", `its clock jumped by ${Math.round(jump.byMs / 1000)} s`);
  if (part > MANY) say("dropping", 3, "warn", `drops ${Math.round(100 * part)} %`);
  if (robot.near) say("near", 3, "warn", `${robot.near.m.toFixed(1)} m from ${robot.near.name}`);
  if (doubtful) say("warning", 3, "warn", `${doubtful.name}: ${doubtful.says}`);
  return found;
}

// Where a robot is, in one frame: by tf, where that leads from the world to the robot; otherwise by one topic with poses.

import {yawOf} from "./cdr.js";
import {place, pose, transforms} from "./messages.js";

const BASES = ["base_link", "base_footprint", "base"], MOST_FRAMES = 1000;
const TF = 3, ODOMETRY = 2, POSE = 1, STATUS = 0;   // a source takes the place of one with a smaller number
const SILENT_MS = 3000, GONE_MS = 60_000;           // so long says the better source nothing, until another stands in: in its frame, in any

const last = frame => frame.slice(frame.lastIndexOf("/") + 1);

// The product of two quaternions (x, y, z, w), and a point turned by one of them.
/** @type {(one: number[], other: number[]) => number[]} */
const turned = ([ax, ay, az, aw], [bx, by, bz, bw]) => [
  aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
  aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz,
];
/** @type {(turn: number[]) => number[]} */
const inverse = ([x, y, z, w]) => [-x, -y, -z, w];
/** @type {(turn: number[], at: number[]) => number[]} */
const moved = (turn, [x, y, z]) => turned(turned(turn, [x, y, z, 0]), inverse(turn)).slice(0, 3);
/** @type {(pose: {at: number[], turn: number[], frame?: string}) => {x: number, y: number, yaw: number, frame: string} | undefined} */
const seenFromAbove = ({at: [x, y], turn, frame = ""}) => place({x, y, yaw: yawOf(turn), frame});

// The frames of tf, each with its parent.
class Tree {
  constructor(robot) {
    this.robot = robot;
    this.links = new Map();                         // frame -> {frame: its parent, at, turn}
    this.base = null;                               // the robot's own frame, once the world is known
  }

  // Whether the robot may have moved by it.
  add({frame, child, at, turn}) {
    const norm = Math.hypot(...turn), known = this.links.get(child);
    if (!(norm > 0.9 && norm < 1.1) || !at.every(Number.isFinite) || frame === child) return false;
    if (!known && this.links.size >= MOST_FRAMES) return false;
    this.links.set(child, {frame, at, turn: turn.map(part => part / norm)});
    if (known?.frame !== frame) this.base = this.find();
    return this.base !== null && this.above(this.base).includes(child);
  }

  // A frame and those above it, up to the map or the last that is known.
  above(frame) {
    const found = [frame];
    while (last(frame) !== "map" && this.links.has(frame) && found.length <= this.links.size)
      found.push(frame = this.links.get(frame).frame);
    return found;
  }

  // Several robots may be in one tree: the one of this name before others. A map before what only counts wheels.
  find() {
    const worth = frame => {
      const root = this.above(frame).at(-1), own = Number(frame.startsWith(this.robot + "/"));
      return BASES.includes(last(root)) ? -1 : 8 * own + 4 * Number(last(root) === "map") + 2 - BASES.indexOf(last(frame));
    };
    const bases = [...this.links.keys()].filter(frame => BASES.includes(last(frame)) && worth(frame) >= 0);
    return bases.sort((one, other) => worth(other) - worth(one))[0] ?? null;
  }

  // Where a frame's origin lies in the uppermost frame above it, and how it is turned there: {at, turn, frame}.
  from(frame) {
    let at = [0, 0, 0], turn = [0, 0, 0, 1];
    for (const child of this.above(frame).slice(0, -1)) {
      const link = this.links.get(child);
      at = moved(link.turn, at).map((value, k) => value + link.at[k]);
      turn = turned(link.turn, turn);
      frame = link.frame;
    }
    return {at, turn, frame};
  }

  place() { return seenFromAbove(this.from(this.base)); }

  // How a frame lies in another frame, {at, turn}; undefined where tf does not lead from one to the other.
  pose(frame, other) {
    const [a, b] = [this.from(frame), this.from(other)], back = inverse(b.turn);
    if (a.frame === b.frame) return {at: moved(back, a.at.map((value, k) => value - b.at[k])), turn: turned(back, a.turn)};
  }

  // The same, seen from above: x, y and yaw.
  between(frame, other) {
    const pose = this.pose(frame, other);
    return pose && seenFromAbove(pose);
  }
}

// A place that is said in a frame, in the frame in which that frame lies at ``to``.
export function within(to, {x, y, yaw = 0}) {
  const [cos, sin] = [Math.cos(to.yaw), Math.sin(to.yaw)];
  return {x: to.x + cos * x - sin * y, y: to.y + sin * x + cos * y, yaw: to.yaw + yaw};
}

export class Place {
  constructor(robot) {
    this.tree = new Tree(robot);
    this.forget();
  }

  forget() { this.source = null; }

  // Where the robot is by this message of a topic of this kind, "pose" or "tf"; undefined if it does not count.
  take(topic, kind, message, ms) {
    if (kind === "tf") {
      const moves = transforms(message).map(transform => this.tree.add(transform)).includes(true);
      return moves ? this.offer("tf", TF, this.tree.place(), ms) : undefined;
    }
    const at = pose(message), rank = message.type === "nav_msgs/msg/Odometry" || message.encoding === "json" ? ODOMETRY : POSE;
    return this.offer([topic, at?.frame, at?.child].join(":"), rank, at, ms);
  }

  takeStatus(at, ms) { return this.offer("status", STATUS, at, ms); }

  offer(name, rank, at, ms) {
    if (!at) return;
    if (this.source && name !== this.source.name && rank <= this.source.rank) {
      const silentMs = ms - this.source.ms;
      if (!(silentMs > (at.frame === this.source.frame ? SILENT_MS : GONE_MS))) return;
    }
    this.source = {name, rank, frame: at.frame, ms};
    return at;
  }
}

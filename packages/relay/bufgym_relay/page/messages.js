// What goes over the wire, and what is in it: the relay's binary frames, and what each kind of message says.

import {Cdr, FAR_M, number, numbers, object} from "./cdr.js";
import {stopsOf} from "./stops.js";

const text = new TextDecoder();
const MOST_RAYS = 20_000, MOST_SLOTS = 1000, MOST_TOPICS = 64, MOST_TRANSFORMS = 1000, MOST_PARTS = 500;

// A message of a binary frame: {topic, type, encoding, sender, seq, stampMs, atMs, noDrop, payload}.
export function decode(buffer) {
  const view = new DataView(buffer), names = [];
  if (view.getUint16(0) !== 0x6252 || view.getUint8(2) !== 1 || view.getUint8(3) !== 1) throw new Error("no frame of this relay");
  const isTimed = (view.getUint8(4) & 2) !== 0, isOrder = (view.getUint8(4) & 4) !== 0;
  let at = isTimed ? 48 : 32;
  if (isOrder) at += 10 + view.getUint16(at + 8);   // a command's number, and the stops that the relay knew
  for (let k = 0; k < 4; k++) {
    const length = view.getUint8(5 + k);
    names.push(text.decode(new Uint8Array(buffer, at, length)));
    at += length;
  }
  return {
    topic: names[0], type: names[1], encoding: names[2], sender: names[3],
    seq: Number(view.getBigUint64(16)), stampMs: Number(view.getBigInt64(24)) / 1000, atMs: isTimed ? Number(view.getBigUint64(32)) / 1000 : undefined,
    noDrop: (view.getUint8(4) & 1) === 1, payload: new Uint8Array(buffer, at, view.getUint32(12)),
  };
}

// The same of a JSON object: what a replay consists of.
export function fromJson(said) {
  const message = {...said, stampMs: said.stamp_us / 1000, atMs: said.at_us ? said.at_us / 1000 : undefined, noDrop: said.no_drop};
  if (said.encoding === "json") message.value = said.data;
  else message.payload = Uint8Array.from(atob(said.data), letter => letter.charCodeAt(0));
  return message;
}

export function json(message) {
  if (message.value === undefined) message.value = JSON.parse(text.decode(message.payload));
  return message.value;
}

const KINDS = {
  "nav_msgs/msg/Odometry": "pose", "geometry_msgs/msg/PoseStamped": "pose", "geometry_msgs/msg/PoseWithCovarianceStamped": "pose",
  "tf2_msgs/msg/TFMessage": "tf", "tf/msg/tfMessage": "tf",
  "sensor_msgs/msg/LaserScan": "scan", "sensor_msgs/msg/CompressedImage": "picture", "sensor_msgs/msg/Image": "picture",
  "diagnostic_msgs/msg/DiagnosticArray": "diagnostics", "sensor_msgs/msg/BatteryState": "battery",
  "nav_msgs/msg/OccupancyGrid": "grid", "nav_msgs/msg/Path": "path", "geometry_msgs/msg/PoseArray": "poses",
  "visualization_msgs/msg/MarkerArray": "markers", "visualization_msgs/msg/Marker": "markers", "sensor_msgs/msg/PointCloud2": "cloud",
};
export const VIDEO = {"theora_image_transport/msg/Packet": "theora", "foxglove_msgs/msg/CompressedVideo": "video", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": "h264"};
export const DRAWN = ["grid", "path", "poses", "goal", "markers"], HEALTH = ["diagnostics", "estop", "battery"];   // kinds: of the map's layers, of what is wrong

// Poses where a robot shall go, or that a person says; bag_poses.py has them too.
const GOAL = new RegExp("(^|[/_])(goals?|targets?|(way|set)_?points?|clicked|desired|cmd|command|(goal|target|set|initial)_?pose)" +
  "([^a-z/][^/]*)?(/(pose|local|global))?$");

const STOP = /(^|[/_])(e_?stop|emergency_?stop)/;

// What a topic shows, as in KINDS, or nothing that the page can draw.
export function kindOf(name, {type, encoding}) {
  const kind = KINDS[type];
  if (encoding === "cdr" && kind === "pose" && type !== "nav_msgs/msg/Odometry" && GOAL.test(name.toLowerCase())) return "goal";
  if (encoding === "cdr" && type === "std_msgs/msg/Bool" && STOP.test(name.toLowerCase())) return "estop";
  if (VIDEO[type] || name.endsWith("/compressedDepth")) return "video";
  if (kind && encoding === "cdr") return kind;
  if (encoding === "jpeg" || encoding === "png") return "picture";
  if (encoding === "json") return {odom: "pose", scan: "scan"}[name];
}

// A place on the map, or undefined if this is none. Without a frame it is taken to be in the one that is shown.
export function place(said) {
  const {x, y, yaw, frame} = object(said), at = {x: number(x, FAR_M), y: number(y, FAR_M), yaw: number(yaw) ?? 0, frame: String(frame ?? "").slice(0, 100)};
  return at.x === undefined || at.y === undefined ? undefined : at;
}

export function pose(message) {
  if (message.encoding === "json") return place(json(message));
  const cdr = new Cdr(message.payload);
  const frame = cdr.header(), child = message.type === "nav_msgs/msg/Odometry" ? cdr.frame() : "";
  const at = place({...cdr.pose(), frame});
  return at && {...at, child};
}

// The transforms of a message of tf: the frame, the child in it, where that is and how it is turned.
export function transforms(message) {
  if (message.transforms) return message.transforms;
  const cdr = new Cdr(message.payload);
  return Array.from({length: Math.min(MOST_TRANSFORMS, cdr.uint())}, () => cdr.transform());
}

// Distances in metres; NaN where a ray met nothing.
export function scan(message) {
  let said, frame = "";
  if (message.encoding === "json") said = object(json(message));
  else {
    const cdr = new Cdr(message.payload);
    frame = cdr.header();
    said = cdr.scan();
  }
  const ranges = Array.from(said.ranges.slice(0, MOST_RAYS), range => number(range, FAR_M) ?? NaN);
  return {angle_min: number(said.angle_min) ?? 0, angle_increment: number(said.angle_increment) ?? 0, ranges, frame};
}

export function queue(said) {
  const {policy, waiting, topics} = object(said), slots = Array.isArray(waiting) ? waiting : [];
  const {capacity, ...counts} = numbers(said, "capacity", "queued", "put", "dropped", "rate_bps", "qoi");
  return {
    ...counts, queued: counts.queued ?? 0, dropped: counts.dropped ?? 0,
    capacity: Math.min(MOST_SLOTS, Math.max(1, capacity ?? 1)), policy: String(policy ?? ""),
    waiting: slots.slice(0, MOST_SLOTS).map(topic => number(topic) ?? 0),
    topics: Object.fromEntries(Object.entries(object(topics)).slice(0, MOST_TOPICS).map(
      ([name, of]) => [name, numbers(of, "age_s", "left", "dropped", "qoi")])),
  };
}

const texts = said => (Array.isArray(said) ? said : []).slice(0, MOST_TOPICS).map(String);

export function status(said) {
  const {answer, commands, driver, estop, location, network, ok, policies, publishes, receives, recording, stop, stops, text, unwritten, queue: its} = object(said);
  return {
    ...numbers(said, "battery"), network: numbers(network, "rtt_ms"), location: place(location), recording: String(recording ?? ""),
    driver: String(driver ?? "").slice(0, 300),
    stops: stopsOf(stops), unwritten: unwritten === true, stop: stop ? {id: String(object(stop).id ?? ""), by: String(object(stop).by ?? "").slice(0, 100)} : null,
    ok: typeof ok === "boolean" ? ok : undefined, estop: estop === true, text: String(text ?? "").slice(0, 300),
    commands: texts(commands), receives: texts(receives), policies: texts(policies), queue: its && queue(its),
    answer: {id: String(object(answer).id ?? ""), why: String(object(answer).why ?? "").slice(0, 300)},
    publishes: Object.fromEntries(Object.entries(object(publishes)).slice(0, MOST_TOPICS).map(([topic, of]) => [topic, object(of)])),
  };
}

// What diagnostics say, a part each: its level (0 is fine, 1 a warning, 2 an error, 3 stale), name, message and values.
export function diagnostics(message) {
  const cdr = new Cdr(message.payload);
  cdr.header();
  return cdr.list(() => ({level: cdr.byte(), name: cdr.string().slice(0, 200), says: cdr.string().slice(0, 300), hardware: cdr.string(),
    values: cdr.list(() => [cdr.string(), cdr.string()])}), MOST_PARTS);
}

// Whether an emergency stop holds.
export const flag = message => new Cdr(message.payload).byte() === 1;

// The battery's charge, from 0 to 1, of a BatteryState.
export function charge(message) {
  const cdr = new Cdr(message.payload);
  cdr.header();
  for (let k = 0; k < 6; k++) cdr.float();          // voltage, temperature, current, charge, capacity, design capacity
  return number(cdr.float());
}

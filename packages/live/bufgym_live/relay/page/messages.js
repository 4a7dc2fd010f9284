// What goes over the wire, and what is in it: the relay's binary frames, and ROS 2 messages in CDR.

const text = new TextDecoder();
const FAR_M = 1e6, MOST = 1e12, MOST_RAYS = 20_000, MOST_SLOTS = 1000, MOST_TOPICS = 64, MOST_TRANSFORMS = 1000;

// A number from outside as it may be drawn: finite, from -most to most. Nothing else is a number.
function number(value, most = MOST) {
  return Number.isFinite(value) ? Math.min(most, Math.max(-most, value)) : undefined;
}
const numbers = (said, ...names) => Object.fromEntries(names.map(name => [name, number(said?.[name])]));
const object = value => value !== null && typeof value === "object" ? value : {};

// A message of a binary frame: {topic, type, encoding, sender, seq, stampMs, noDrop, payload}.
export function decode(buffer) {
  const view = new DataView(buffer), names = [];
  if (view.getUint16(0) !== 0x6252 || view.getUint8(2) !== 1 || view.getUint8(3) !== 1) throw new Error("no frame of this relay");
  let at = 32;
  for (let k = 0; k < 4; k++) {
    const length = view.getUint8(5 + k);
    names.push(text.decode(new Uint8Array(buffer, at, length)));
    at += length;
  }
  return {
    topic: names[0], type: names[1], encoding: names[2], sender: names[3],
    seq: Number(view.getBigUint64(16)), stampMs: Number(view.getBigInt64(24)) / 1000,
    noDrop: (view.getUint8(4) & 1) === 1, payload: new Uint8Array(buffer, at, view.getUint32(12)),
  };
}

// The same of a JSON object: what a replay consists of.
export function fromJson(said) {
  const message = {...said, stampMs: said.stamp_us / 1000, noDrop: said.no_drop};
  if (said.encoding === "json") message.value = said.data;
  else message.payload = Uint8Array.from(atob(said.data), letter => letter.charCodeAt(0));
  return message;
}

export function json(message) {
  if (message.value === undefined) message.value = JSON.parse(text.decode(message.payload));
  return message.value;
}

class Cdr {
  constructor(payload) {
    this.view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
    this.little = (this.view.getUint8(1) & 1) === 1;
    this.at = 4;                                    // alignment counts from behind the four bytes that say how it is encoded
  }
  skipTo(bytes) { this.at += (bytes - (this.at - 4) % bytes) % bytes; }
  number(kind, bytes) {
    this.skipTo(bytes);
    const value = this.view["get" + kind](this.at, this.little);
    this.at += bytes;
    return value;
  }
  uint() { return this.number("Uint32", 4); }
  float() { return this.number("Float32", 4); }
  double() { return this.number("Float64", 8); }
  bytes(length) { return new Uint8Array(this.view.buffer, this.view.byteOffset + (this.at += length) - length, length); }
  string() { const length = this.uint(); return text.decode(this.bytes(length).subarray(0, Math.max(0, length - 1))); }
  frame() { return this.string().replace(/^\/+/, ""); }
  header() { this.uint(); this.uint(); return this.frame(); }
  doubles(count) { return Array.from({length: count}, () => this.double()); }
  pose() {
    const [x, y, , qx, qy, qz, qw] = this.doubles(7);
    return {x, y, yaw: Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))};
  }
  transform() { return {frame: this.header(), child: this.frame(), at: this.doubles(3), turn: this.doubles(4)}; }
  scan() {
    const [angle_min, , angle_increment] = [this.float(), this.float(), this.float()];
    this.float(); this.float(); this.float(); this.float();
    const ranges = new Float32Array(Math.min(this.uint(), this.view.byteLength / 4));
    for (let k = 0; k < ranges.length; k++) ranges[k] = this.float();
    return {angle_min, angle_increment, ranges};
  }
}

const KINDS = {
  "nav_msgs/msg/Odometry": "pose", "geometry_msgs/msg/PoseStamped": "pose", "geometry_msgs/msg/PoseWithCovarianceStamped": "pose",
  "tf2_msgs/msg/TFMessage": "tf", "tf/msg/tfMessage": "tf",
  "sensor_msgs/msg/LaserScan": "scan", "sensor_msgs/msg/CompressedImage": "picture", "sensor_msgs/msg/Image": "picture",
};

// Poses where a robot shall go, or that a person says; bag_poses.py has them too.
const GOAL = new RegExp("(^|[/_])(goals?|targets?|(way|set)_?points?|clicked|desired|cmd|command|(goal|target|set|initial)_?pose)" +
  "([^a-z/][^/]*)?(/(pose|local|global))?$");

// What a topic shows: "pose", "tf", "scan", "picture", or nothing that the page can draw.
export function kindOf(name, {type, encoding}) {
  if (KINDS[type] === "pose" && type !== "nav_msgs/msg/Odometry" && GOAL.test(name.toLowerCase())) return;
  if (KINDS[type] && encoding === "cdr") return KINDS[type];
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
  const cdr = new Cdr(message.payload);
  return Array.from({length: Math.min(MOST_TRANSFORMS, cdr.uint())}, () => cdr.transform());
}

// Distances in metres; NaN where a ray met nothing.
export function scan(message) {
  let said;
  if (message.encoding === "json") said = object(json(message));
  else {
    const cdr = new Cdr(message.payload);
    cdr.header();
    said = cdr.scan();
  }
  const ranges = Array.from(said.ranges.slice(0, MOST_RAYS), range => number(range, FAR_M) ?? NaN);
  return {angle_min: number(said.angle_min) ?? 0, angle_increment: number(said.angle_increment) ?? 0, ranges};
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

export function status(said) {
  const {location, network, policies, publishes, recording, queue: its} = object(said);
  return {
    ...numbers(said, "battery"), network: numbers(network, "rtt_ms"), location: place(location), recording: String(recording ?? ""),
    policies: (Array.isArray(policies) ? policies : []).slice(0, MOST_TOPICS).map(String), queue: its && queue(its),
    publishes: Object.fromEntries(Object.entries(object(publishes)).slice(0, MOST_TOPICS).map(([topic, of]) => [topic, object(of)])),
  };
}

// A promise of something that a canvas can draw.
export function picture(message) {
  let {payload, encoding} = message;
  if (encoding === "cdr") {
    const cdr = new Cdr(payload);
    cdr.header();
    if (message.type === "sensor_msgs/msg/Image") return createImageBitmap(plain(cdr));
    encoding = cdr.string().includes("png") ? "png" : "jpeg";
    payload = cdr.bytes(cdr.uint());
  }
  return createImageBitmap(new Blob([payload], {type: "image/" + encoding}));
}

function plain(cdr) {
  const [height, width] = [cdr.uint(), cdr.uint()], order = cdr.string();
  cdr.at++;                                         // whether it is big endian
  const step = cdr.uint(), data = cdr.bytes(cdr.uint());
  const [red, green, blue, bytes] = {rgb8: [0, 1, 2, 3], bgr8: [2, 1, 0, 3], rgba8: [0, 1, 2, 4], bgra8: [2, 1, 0, 4]}[order] ?? [0, 0, 0, 1];
  if (Math.max(width * bytes, step) * height > data.length) throw new Error("a picture without its pixels");
  const image = new ImageData(width, height);
  for (let y = 0, to = 0; y < height; y++)
    for (let x = 0, from = y * step; x < width; x++, from += bytes, to += 4) {
      image.data[to] = data[from + red];
      image.data[to + 1] = data[from + green];
      image.data[to + 2] = data[from + blue];
      image.data[to + 3] = 255;
    }
  return image;
}

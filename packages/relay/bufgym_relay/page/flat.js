// Messages of Robofleet's released clients, flatbuffers by msg2fbs/schema.fbs in ut-amrl/robofleet, as the same that our robots say.
// In each table the field 0 is its metadata; the numbers of the others are their places in the schema.

import {FAR_M, number, object, yawOf} from "./cdr.js";
import {SHAPES} from "./layers.js";

const text = new TextDecoder(), MOST_ITEMS = 20_000, ARC = Math.PI / 36;
const POINT_M = 0.1, LINE_M = 0.04, HEADING_M = 0.3;  // what the messages draw has no size of its own
const PARTICLE = 0x8e24aa, OPTION = 0x8a939e, BEST = 0x1565c0, HERE = {x: 0, y: 0, z: 0, yaw: 0, turn: [0, 0, 0, 1]};

// A table of a flatbuffer; a field that it lacks is 0, empty, or a table without fields.
class Table {
  constructor(view, at) {
    this.view = view;
    this.at = at;
    this.fields = at === null ? null : at - view.getInt32(at, true);
  }
  where(field) {
    const place = 4 + 2 * field, isKnown = this.fields !== null && place < this.view.getUint16(this.fields, true);
    const offset = isKnown ? this.view.getUint16(this.fields + place, true) : 0;
    return offset ? this.at + offset : null;
  }
  refers(field) {
    const at = this.where(field);
    return at === null ? null : at + this.view.getUint32(at, true);
  }
  value(kind, field) {
    const at = this.where(field);
    return at === null ? 0 : this.view["get" + kind](at, true);
  }
  float(field) { return number(this.value("Float32", field)) ?? 0; }
  double(field) { return number(this.value("Float64", field)) ?? 0; }
  table(field) { return new Table(this.view, this.refers(field)); }
  // Items of ``bytes`` each: how many, and where they begin.
  vector(field, bytes) {
    const at = this.refers(field), count = at === null ? 0 : this.view.getUint32(at, true);
    if (at !== null && count * bytes > this.view.byteLength - at) throw new RangeError(`a vector of ${count}`);
    return [count, at + 4];
  }
  bytes(field) {
    const [count, at] = this.vector(field, 1);
    return new Uint8Array(this.view.buffer, this.view.byteOffset + at, count);
  }
  string(field) { return text.decode(this.bytes(field)); }
  floats(field) {
    const [count, at] = this.vector(field, 4);
    return Array.from({length: count}, (_, k) => this.view.getFloat32(at + 4 * k, true));
  }
  tables(field) {
    const [count, at] = this.vector(field, 4);
    if (count > MOST_ITEMS) throw new RangeError(`${count} tables`);
    return Array.from({length: count}, (_, k) => new Table(this.view, at + 4 * k + this.view.getUint32(at + 4 * k, true)));
  }
  // The frame of a header.
  frame() { return this.table(1).string(3).replace(/^\/+/, ""); }
}

const metres = value => number(value, FAR_M) ?? 0;
const xy = (table, z = 0) => ({x: metres(table.float(1)), y: metres(table.float(2)), z});
const rgba = colour => [colour >> 16 & 255, colour >> 8 & 255, colour & 255].map(part => part / 255).concat(1);

function pose(table) {
  const [at, turn] = [table.table(1), table.table(2)];
  return {x: metres(at.double(1)), y: metres(at.double(2)), yaw: yawOf([1, 2, 3, 4].map(field => turn.double(field)))};
}

// Lines along an arc, in pairs of ends.
function arc({x, y}, radius, from, to) {
  const steps = Math.min(144, Math.max(1, Math.ceil(Math.abs(to - from) / ARC))), ends = [];
  const on = k => ({x: x + radius * Math.cos(from + (to - from) * k / steps), y: y + radius * Math.sin(from + (to - from) * k / steps), z: 0});
  for (let k = 0; k < steps; k++) ends.push(on(k), on(k + 1));
  return ends;
}

// Where a robot comes that drives this far with a curvature, from its base ahead.
function option(table) {
  const [curvature, length] = [table.float(1), metres(table.float(2))], radius = 1 / curvature;
  if (Math.abs(curvature) < 1e-3) return [{x: 0, y: 0, z: 0}, {x: length, y: 0, z: 0}];
  const from = radius > 0 ? -Math.PI / 2 : Math.PI / 2;
  return arc({x: 0, y: radius}, Math.abs(radius), from, from + length * curvature);
}

// Markers of a namespace: its points, and its lines, arcs, particles and options of paths as lines.
function drawings(table) {
  const frame = table.frame(), space = table.string(2).slice(0, 100), ends = [], tints = [], paths = table.tables(4);
  const line = (some, colour) => { for (const end of some) { ends.push(end); tints.push(rgba(colour)); } };
  for (const one of table.tables(6)) line([xy(one.table(1)), xy(one.table(2))], one.value("Uint32", 3));
  for (const one of table.tables(7)) line(arc(xy(one.table(1)), metres(one.float(2)), one.float(3), one.float(4)), one.value("Uint32", 5));
  for (const one of table.tables(3)) {
    const at = xy(one), yaw = one.float(3);
    line([at, {x: at.x + HEADING_M * Math.cos(yaw), y: at.y + HEADING_M * Math.sin(yaw), z: 0}], PARTICLE);
  }
  paths.forEach((one, k) => line(option(one), k === paths.length - 1 ? BEST : OPTION));
  const spots = table.tables(5), marker = (shape, size, points, colours) => ({
    frame, space, key: `${space}/${frame}/${shape}`, shape, action: 0, at: HERE, size: [size, size, size], colour: [0, 0, 0, 1], keepMs: 0, points, colours, text: ""});
  return [marker(SHAPES.POINTS, POINT_M, spots.map(one => xy(one.table(1))), spots.map(one => rgba(one.value("Uint32", 2)))), marker(SHAPES.LINES, LINE_M, ends, tints)];
}

const READS = {
  "amrl_msgs/RobofleetStatus"(table) {
    const level = table.float(3), place = table.string(4);
    const said = [table.string(1), place && `at ${place}`].filter(Boolean).join(", ");
    return {value: {ok: table.value("Uint8", 2) === 1, text: said, battery: level > 1 ? level / 100 : level}};
  },
  // The robot's frame in the map's, as tf says it, so that what it draws around itself has its place.
  "amrl_msgs/Localization2DMsg"(table) {
    const at = xy(table.table(2)), half = table.table(2).float(3) / 2;
    return {kind: "tf", transforms: [{frame: table.frame() || "map", child: "base_link", at: [at.x, at.y, 0], turn: [0, 0, Math.sin(half), Math.cos(half)]}]};
  },
  "amrl_msgs/VisualizationMsg": table => ({kind: "markers", markers: drawings(table)}),
  "nav_msgs/Odometry": table => ({kind: "pose", value: {...pose(table.table(3).table(1)), frame: table.frame()}}),
  "geometry_msgs/PoseStamped": table => ({kind: "goal", value: {...pose(table.table(2)), frame: table.frame()}}),
  "sensor_msgs/LaserScan": table => ({kind: "scan", value: {angle_min: table.float(2), angle_increment: table.float(4), ranges: table.floats(9)}}),
  "sensor_msgs/CompressedImage": table => ({kind: "picture", payload: table.bytes(3), encoding: table.string(2).includes("png") ? "png" : "jpeg"}),
};

// A message as one of our robots would say it; undefined for a type that the page does not draw.
export function unpacked(message) {
  const view = new DataView(message.payload.buffer, message.payload.byteOffset, message.payload.byteLength);
  const read = READS[message.type.replace("/msg/", "/")];
  return read && {...message, encoding: "json", ...object(read(new Table(view, view.getUint32(0, true))))};
}

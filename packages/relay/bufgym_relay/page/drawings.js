// What robots want drawn on the map, read from ROS 2 messages: grids, paths, poses, goals and markers, each in its frame.

import {Cdr, FAR_M, number} from "./cdr.js";
import {place, pose} from "./messages.js";

const MOST_CELLS = 16_000_000, MOST_MARKERS = 5000, ADD = 0, DELETE_ALL = 3;

// A number of metres that can be drawn; what is none is 0.
const metres = value => number(value, FAR_M) ?? 0;

function grid(cdr) {
  const frame = cdr.header();
  cdr.uint(); cdr.uint();                           // when the map was loaded
  const cellM = cdr.float(), [width, height] = [cdr.uint(), cdr.uint()], origin = place(cdr.pose());
  const cells = cdr.bytes(cdr.uint());
  if (!(cellM > 0 && cellM < 1000) || !origin || width * height > MOST_CELLS || width * height !== cells.length) throw new Error("a grid without its cells");
  return {frame, cellM, width, height, origin, cells: new Int8Array(cells)};
}

const places = read => cdr => ({frame: cdr.header(), places: cdr.list(() => place(read(cdr))).filter(Boolean)});
const poses = places(cdr => cdr.pose()), path = places(cdr => { cdr.header(); return cdr.pose(); });

const point = cdr => { const [x, y, z] = cdr.doubles(3).map(metres); return {x, y, z}; };
const rgba = cdr => Array.from({length: 4}, () => Math.min(1, Math.max(0, number(cdr.float()) ?? 0)));

function marker(cdr) {
  const frame = cdr.header(), space = cdr.string().slice(0, 100), key = `${space}/${cdr.int()}`, shape = cdr.int(), action = cdr.int();
  const said = cdr.pose(), norm = Math.hypot(...said.turn), isTurned = norm > 0.9 && norm < 1.1;
  const at = {...place(said) ?? {x: 0, y: 0, yaw: 0}, z: metres(said.z), turn: isTurned ? said.turn.map(part => part / norm) : [0, 0, 0, 1]}, size = cdr.doubles(3).map(metres), colour = rgba(cdr);
  const keepMs = 1000 * cdr.int() + cdr.uint() / 1e6;
  cdr.byte();                                       // whether it stays with its frame: what is drawn always does
  const points = cdr.list(point), colours = cdr.list(rgba);
  cdr.string();                                     // a texture: its name, its picture, where its corners lie
  cdr.header(); cdr.string(); cdr.bytes(cdr.uint());
  cdr.list(() => [cdr.float(), cdr.float()]);
  const text = cdr.string().slice(0, 300);
  cdr.string(); cdr.string(); cdr.bytes(cdr.uint()); cdr.byte();  // a mesh
  return {frame, space, key, shape, action, at, size, colour, keepMs, points, colours, text};
}

// Markers that a topic has set so far, changed by those of a message: added, taken away one by one, or all.
function changed(before, markers, ms) {
  const all = new Map(before?.markers);
  for (const one of markers) {
    if (one.action === DELETE_ALL) all.clear();
    else if (one.action !== ADD) all.delete(one.key);
    else if (all.size < MOST_MARKERS || all.has(one.key)) all.set(one.key, {...one, untilMs: one.keepMs > 0 ? ms + one.keepMs : Infinity});
  }
  return all;
}

// A layer of the map by a message of a kind that is drawn; ``before`` is what the topic's layer was. A cloud is read once it is drawn.
export function layer(kind, message, ms, before) {
  if (kind === "cloud") return {kind, ms, message};
  if (kind === "goal") {
    const at = pose(message);
    return {kind, ms, frame: at?.frame ?? "", places: at ? [at] : []};
  }
  const cdr = message.markers ? null : new Cdr(message.payload);
  if (kind === "markers") {
    const markers = changed(before, message.markers ?? (message.type.endsWith("Array") ? cdr.list(marker, MOST_MARKERS) : [marker(cdr)]), ms);
    return {kind, ms, markers, spaces: [...new Set([...markers.values()].map(one => one.space))]};
  }
  return {kind, ms, ...{grid, path, poses}[kind](cdr)};
}

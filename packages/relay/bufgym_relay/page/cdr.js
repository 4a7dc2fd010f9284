// Values from outside: numbers that may be drawn, and the parts that ROS 2 messages in CDR consist of.

const text = new TextDecoder(), MOST = 1e12, MOST_ITEMS = 200_000;
export const FAR_M = 1e6;

// A number from outside as it may be drawn: finite, from -most to most. Nothing else is a number.
export function number(value, most = MOST) {
  return Number.isFinite(value) ? Math.min(most, Math.max(-most, value)) : undefined;
}
export const numbers = (said, ...names) => Object.fromEntries(names.map(name => [name, number(said?.[name])]));
export const object = value => value !== null && typeof value === "object" ? value : {};

// The turn round z of a quaternion (x, y, z, w).
/** @type {(turn: number[]) => number} */
export const yawOf = ([x, y, z, w]) => Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));

export class Cdr {
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
  byte() { return this.number("Uint8", 1); }
  int() { return this.number("Int32", 4); }
  uint() { return this.number("Uint32", 4); }
  float() { return this.number("Float32", 4); }
  double() { return this.number("Float64", 8); }
  bytes(length) { return new Uint8Array(this.view.buffer, this.view.byteOffset + (this.at += length) - length, length); }
  string() { const length = this.uint(); return text.decode(this.bytes(length).subarray(0, Math.max(0, length - 1))); }
  frame() { return this.string().replace(/^\/+/, ""); }
  header() { this.uint(); this.uint(); return this.frame(); }
  // A list of what ``read`` reads; one that cannot be in the message is an error.
  list(read, most = MOST_ITEMS) {
    const count = this.uint();
    if (count > Math.min(most, this.view.byteLength - this.at)) throw new Error(`a list of ${count}`);
    return Array.from({length: count}, () => read(this));
  }
  doubles(count) { return Array.from({length: count}, () => this.double()); }
  pose() {
    const [x, y, z, ...turn] = this.doubles(7);
    return {x, y, z, turn, yaw: yawOf(turn)};
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

// Messages of ROS 2 that the page sends itself, in CDR and in base64, as the relay's text frames carry them.

class Writer {
  constructor() {
    this.bytes = [0, 1, 0, 0];                      // little endian
  }

  put(kind, size, value) {
    while ((this.bytes.length - 4) % size) this.bytes.push(0);
    const view = new DataView(new ArrayBuffer(size));
    view["set" + kind](0, value, true);
    this.bytes.push(...new Uint8Array(view.buffer));
  }

  text(text) {
    const bytes = new TextEncoder().encode(text + "\0");
    this.put("Uint32", 4, bytes.length);
    this.bytes.push(...bytes);
  }

  doubles(values) { for (const value of values) this.put("Float64", 8, value); }

  base64() { return btoa(String.fromCharCode(...this.bytes)); }
}

// A PoseStamped, or a PoseWithCovarianceStamped as sure as RViz says it, of this time.
export function stamped(isEstimate, {x, y, yaw, frame}, ms) {
  const writer = new Writer();
  writer.put("Int32", 4, Math.floor(ms / 1000));
  writer.put("Uint32", 4, ms % 1000 * 1e6);
  writer.text(frame || "map");
  writer.doubles([x, y, 0, 0, 0, Math.sin(yaw / 2), Math.cos(yaw / 2)]);
  if (isEstimate) writer.doubles(Array.from({length: 36}, (_, k) => ({0: 0.25, 7: 0.25, 35: 0.0685})[k] ?? 0));
  return writer.base64();
}

// A Twist of zeros.
export function still() {
  const writer = new Writer();
  writer.doubles([0, 0, 0, 0, 0, 0]);
  return writer.base64();
}

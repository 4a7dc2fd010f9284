// A PointCloud2 as the graphics card takes it: places in metres and colours, by whatever fields, datatypes and order of bytes it has.

import {Cdr, FAR_M} from "./cdr.js";

const MOST_POINTS = 1_000_000, SAMPLES = 2000;
// Datatypes of sensor_msgs/PointField: how many bytes, and how they are read.
const TYPES = {
  1: [1, (view, at) => view.getInt8(at)], 2: [1, (view, at) => view.getUint8(at)],
  3: [2, (view, at, little) => view.getInt16(at, little)], 4: [2, (view, at, little) => view.getUint16(at, little)],
  5: [4, (view, at, little) => view.getInt32(at, little)], 6: [4, (view, at, little) => view.getUint32(at, little)],
  7: [4, (view, at, little) => view.getFloat32(at, little)], 8: [8, (view, at, little) => view.getFloat64(at, little)],
};
const PACKED = ["rgb", "rgba"], BRIGHT = ["intensity", "intensities", "reflectivity", "i"];

// Red, green, blue and 255 in the order of bytes that browsers have.
const word = (red, green, blue) => 255 << 24 | blue << 16 | green << 8 | red;
// From blue over green and yellow to red.
const PALETTE = Uint32Array.from({length: 256}, (_, k) => {
  const wave = centre => 255 * Math.min(1, Math.max(0.08, 1.5 - Math.abs(k / 63.75 - centre)));
  return word(wave(3), wave(2), wave(1));
});

// The colours that values have between the 2nd and the 98th part of a hundred of them.
function shaded(values, count, colours) {
  const step = Math.max(1, Math.floor(count / SAMPLES)), sample = Float64Array.from({length: Math.ceil(count / step)}, (_, k) => values[k * step]).filter(Number.isFinite).sort();
  const low = sample[Math.floor(sample.length * 0.02)] ?? 0, scale = 255 / (sample[Math.floor(sample.length * 0.98)] - low || 1);
  for (let k = 0; k < count; k++) colours[k] = PALETTE[Math.min(255, Math.max(0, Math.round((values[k] - low) * scale) || 0))];
}

const LATE_MS = 100, EASY_MS = 35, EASY_FRAMES = 30, MOST_EVERY = 64;

// Of how many points one is drawn. A frame that takes long halves the points, and many quick ones double them again:
// fewer points of now rather than all of a while ago.
export class Thinning {
  every = 1;
  easy = 0;

  // A frame that drew clouds took so long until the next.
  took(ms) {
    this.easy = ms < EASY_MS ? this.easy + 1 : 0;
    if (ms > LATE_MS) this.every = Math.min(MOST_EVERY, 2 * this.every);
    else if (this.easy >= EASY_FRAMES) [this.every, this.easy] = [Math.max(1, this.every / 2), 0];
  }
}

// ``by`` names the field that gives the colours, "z" for the height; what has none is coloured by rgb, intensity or height, the first it has.
// Of ``every`` so many points one is read. {frame, fields, by, count, places, colours}: ``places`` x, y and z of each point, ``colours`` red, green, blue and 255.
export function cloud(message, by = "", every = 1) {
  const cdr = new Cdr(message.payload), frame = cdr.header(), [height, width] = [cdr.uint(), cdr.uint()];
  const fields = new Map(cdr.list(() => ({name: cdr.string(), offset: cdr.uint(), type: TYPES[cdr.byte()], count: cdr.uint()}), 200).map(one => [one.name, one]));
  const little = cdr.byte() === 0, [step, row] = [cdr.uint(), cdr.uint()], length = cdr.uint(), data = cdr.bytes(length);
  const view = new DataView(data.buffer, data.byteOffset, length);
  if (width * height > MOST_POINTS) throw new Error(`${width * height} points are too many`);
  if (width * height > 0 && (width * step > length || (height - 1) * row + width * step > length)) throw new Error("a cloud without its points");
  const field = name => {
    const {offset, type} = fields.get(name) ?? {};
    if (!type || offset + type[0] > step) throw new Error(`no field ${name} of a known type`);
    return {offset, read: type[1]};
  };
  const [x, y, z] = ["x", "y", "z"].map(field), chosen = [by, ...PACKED, ...BRIGHT].find(name => fields.get(name)?.type) ?? "z";
  const isPacked = PACKED.includes(chosen), shade = field(chosen);
  const most = Math.ceil(width * height / every), places = new Float32Array(3 * most), colours = new Uint32Array(most), values = new Float64Array(most);
  let count = 0;
  for (let line = 0, column = 0; line < height; line += Math.floor(column / width), column %= width || 1)
    for (; column < width; column += every) {
      const at = line * row + column * step;
      const px = x.read(view, at + x.offset, little), py = y.read(view, at + y.offset, little), pz = z.read(view, at + z.offset, little);
      if (!(Math.abs(px) < FAR_M && Math.abs(py) < FAR_M && Math.abs(pz) < FAR_M)) continue;  // where a ray met nothing
      places[3 * count] = px;
      places[3 * count + 1] = py;
      places[3 * count + 2] = pz;
      if (isPacked) {
        const packed = view.getUint32(at + shade.offset, little);
        colours[count] = word(packed >> 16 & 255, packed >> 8 & 255, packed & 255);
      } else values[count] = shade.read(view, at + shade.offset, little);
      count++;
    }
  if (!isPacked) shaded(values, count, colours);
  const named = [...fields.keys()].filter(name => name !== "x" && name !== "y" && fields.get(name).type);
  return {frame, fields: named, by: chosen, count, places: places.subarray(0, 3 * count), colours: new Uint8Array(colours.buffer, 0, 4 * count)};
}

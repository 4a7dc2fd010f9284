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

// From blue over green and yellow to red: 256 colours of three bytes.
const PALETTE = Uint8Array.from({length: 768}, (_, k) => {
  const part = Math.floor(k / 3) / 255, wave = centre => 255 * Math.min(1, Math.max(0.08, 1.5 - Math.abs(4 * part - centre)));
  return wave([3, 2, 1][k % 3]);
});

// The colours that values have between the 2nd and the 98th part of a hundred of them.
function shaded(values, count, colours) {
  const step = Math.max(1, Math.floor(count / SAMPLES)), sample = values.slice(0, count).filter((value, k) => k % step === 0 && Number.isFinite(value)).sort();
  const low = sample[Math.floor(sample.length * 0.02)] ?? 0, scale = 255 / (sample[Math.floor(sample.length * 0.98)] - low || 1);
  for (let k = 0; k < count; k++) {
    const at = 3 * Math.min(255, Math.max(0, Math.round((values[k] - low) * scale) || 0));
    colours[4 * k] = PALETTE[at];
    colours[4 * k + 1] = PALETTE[at + 1];
    colours[4 * k + 2] = PALETTE[at + 2];
    colours[4 * k + 3] = 255;
  }
}

// ``by`` names the field that gives the colours, "z" for the height; what has none is coloured by rgb, intensity or height, the first it has.
// {frame, fields, by, count, places, colours}: ``places`` x, y and z of each point, ``colours`` red, green, blue and 255.
export function cloud(message, by = "") {
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
  const places = new Float32Array(3 * width * height), colours = new Uint8Array(4 * width * height), values = new Float64Array(width * height);
  let count = 0;
  for (let line = 0; line < height; line++)
    for (let column = 0, at = line * row; column < width; column++, at += step) {
      const px = x.read(view, at + x.offset, little), py = y.read(view, at + y.offset, little), pz = z.read(view, at + z.offset, little);
      if (!(Math.abs(px) < FAR_M && Math.abs(py) < FAR_M && Math.abs(pz) < FAR_M)) continue;  // where a ray met nothing
      places[3 * count] = px;
      places[3 * count + 1] = py;
      places[3 * count + 2] = pz;
      if (isPacked) {
        const word = view.getUint32(at + shade.offset, little);
        colours.set([word >> 16 & 255, word >> 8 & 255, word & 255, 255], 4 * count);
      } else values[count] = shade.read(view, at + shade.offset, little);
      count++;
    }
  if (!isPacked) shaded(values, count, colours);
  const named = [...fields.keys()].filter(name => name !== "x" && name !== "y" && fields.get(name).type);
  return {frame, fields: named, by: chosen, count, places: places.subarray(0, 3 * count), colours: colours.subarray(0, 4 * count)};
}

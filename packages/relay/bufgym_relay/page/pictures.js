// Pictures: what they are is asked before anything is decoded, for 48 kB of PNG can be 1.6 GB of pixels.

import {Cdr} from "./cdr.js";
import {VIDEO} from "./messages.js";

const MOST_PIXELS = 16_000_000;                     // two pictures of 4K

// Why a topic of kind "video" is not shown.
export const unseen = (topic, type = "") => `this page cannot show ${VIDEO[type] ?? topic.split("/").at(-1)}; send ${topic.replace(/\/[^/]*$/, "")}/compressed`;

// Width and height of a PNG or JPEG file, by its first bytes; undefined if it is neither.
export function dimensions(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (view.byteLength >= 24 && view.getUint32(0) === 0x89504e47) return [view.getUint32(16), view.getUint32(20)];
  if (view.byteLength < 4 || view.getUint16(0) !== 0xffd8) return;
  for (let at = 2; at + 9 < view.byteLength;) {     // segments, until one that begins a frame
    if (view.getUint8(at) !== 0xff) return;
    const mark = view.getUint8(at + 1);
    if (mark >= 0xc0 && mark <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(mark)) return [view.getUint16(at + 7), view.getUint16(at + 5)];
    at += mark === 0xff ? 1 : 2 + view.getUint16(at + 2);
  }
}

function check(width, height) {
  if (!(width > 0 && height > 0)) throw new Error("a picture without pixels");
  if (width * height > MOST_PIXELS) throw new Error(`${width} × ${height} pixels are too many`);
}

// A canvas's picture; an error says in words why there is none.
export async function picture(message) {
  let {payload, encoding} = message;
  if (encoding === "cdr") {
    const cdr = new Cdr(payload);
    cdr.header();
    if (message.type === "sensor_msgs/msg/Image") return createImageBitmap(plain(cdr));
    const format = cdr.string();
    if (/compressedDepth|h264|hevc|theora/i.test(format)) throw new Error(`this page cannot show ${format}`);
    payload = cdr.bytes(cdr.uint());
    encoding = format.includes("png") ? "png" : "jpeg";
  }
  const size = dimensions(payload);
  if (!size) throw new Error("neither a JPEG nor a PNG");
  check(...size);
  return createImageBitmap(new Blob([payload], {type: "image/" + encoding})).catch(() => { throw new Error("a broken picture"); });
}

const ORDERS = {rgb8: [0, 1, 2, 3], bgr8: [2, 1, 0, 3], rgba8: [0, 1, 2, 4], bgra8: [2, 1, 0, 4], mono8: [0, 0, 0, 1], "8UC1": [0, 0, 0, 1]};

function plain(cdr) {
  const [height, width] = [cdr.uint(), cdr.uint()], order = cdr.string();
  if (!ORDERS[order]) throw new Error(`this page cannot show ${order}`);
  check(width, height);
  cdr.byte();                                       // whether it is big endian
  const step = cdr.uint(), data = cdr.bytes(cdr.uint()), [red, green, blue, bytes] = ORDERS[order];
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

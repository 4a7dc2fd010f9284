// Canvases: their size, their colours, and what the panels of one robot show.

const SENSES_RANGE_M = 8;
const HISTORY_MS = 60_000, FRESH_MS = 1000, GREY_MS = 10_000, OLD_MS = 2000;

// A canvas's context, its pixels as many as the screen has; [context, width, height] in CSS pixels.
export function context(canvas) {
  const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const drawing = canvas.getContext("2d");
  drawing.setTransform(ratio, 0, 0, ratio, 0, 0);
  drawing.clearRect(0, 0, width, height);
  return [drawing, width, height];
}

let colours = {};
export function colour(name) {
  return colours[name] ??= getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
}
const night = matchMedia("(prefers-color-scheme: dark)");
export function whenColoursChange(redraw) {
  night.addEventListener("change", () => { colours = {}; redraw(); });
}

// Red, green and blue, 0 to 255, of a colour of CSS.
const probe = document.createElement("canvas").getContext("2d");
export function rgb(css) {
  probe.fillStyle = css;
  return String(probe.fillStyle).match(/[0-9a-f]{2}/g).map(pair => parseInt(pair, 16));
}

// Hues far apart, one after the other, as many as there are topics.
export const hue = k => tint((210 + k * 137.5) % 360);

// A robot's colour is a part of a turn round the colours, from its name: the same in every browser, and far from its neighbours' by number.
export function colourOf(name) {
  const [, stem, number] = /^(.*?)(\d*)$/s.exec(name);
  let hash = 2166136261;
  for (const letter of stem) hash = Math.imul(hash ^ letter.codePointAt(0), 16777619) >>> 0;
  return (hash % 360 + (Number(number.slice(-9)) || 0) * 137.5) % 360;
}

// What is old loses its colour: from ``part`` 0, fresh, to 1. Each is dark or light enough to be 3 : 1 from what lies below.
export const tint = (colour, part = 0, dark = night.matches) =>
  `hsl(${colour} ${(dark ? 70 : 68) * (1 - part)}% ${dark ? 64 - 14 * part : 33 + 21 * part}%)`;
export const faded = ageMs => Math.min(1, Math.max(0, (ageMs - FRESH_MS) / (GREY_MS - FRESH_MS)));

// Let a figure lose colour with the age of what it shows, and say that age in large letters.
export function aged(figure, ageMs) {
  const part = faded(ageMs).toFixed(1), old = ageMs > OLD_MS ? `${seconds(ageMs / 1000)} old` : "";
  if (figure.style.getPropertyValue("--age") !== part) figure.style.setProperty("--age", part);
  if (figure.dataset.old !== old) figure.dataset.old = old;
}

export const say = (element, text) => { if (element.textContent !== String(text)) element.textContent = text; };

// The robot in the middle looks up.
export function drawScan(canvas, scan, tint) {
  const [drawing, width, height] = context(canvas);
  if (!scan) return;
  const far = scan.ranges.reduce((most, range) => range > most ? range : most, 1);
  const reach = Math.min(far, SENSES_RANGE_M), scale = Math.min(width, height) / 2 / reach * 0.94;
  drawing.translate(width / 2, height / 2);
  drawing.strokeStyle = colour("rule");
  for (let metres = 2; metres <= reach + 1; metres += 2) {
    drawing.beginPath();
    drawing.arc(0, 0, metres * scale, 0, 7);
    drawing.stroke();
  }
  drawing.beginPath();
  const points = [];
  scan.ranges.forEach((range, k) => {
    if (!Number.isFinite(range)) return;
    const angle = scan.angle_min + k * scan.angle_increment;
    points.push([-Math.sin(angle) * range * scale, -Math.cos(angle) * range * scale]);
  });
  for (const [x, y] of points) drawing.lineTo(x, y);
  drawing.closePath();
  drawing.globalAlpha = 0.18;
  drawing.fillStyle = tint;
  drawing.fill();
  drawing.globalAlpha = 1;
  for (const [x, y] of points) drawing.fillRect(x - 1, y - 1, 2, 2);
  arrow(drawing, 0, 0, -Math.PI / 2, 8, tint);
}

// A robot from above; ``angle`` in the canvas's sense.
export function arrow(drawing, x, y, angle, size, tint) {
  drawing.save();
  drawing.translate(x, y);
  drawing.rotate(angle);
  drawing.beginPath();
  drawing.moveTo(size, 0);
  drawing.lineTo(-size * 0.75, size * 0.7);
  drawing.lineTo(-size * 0.4, 0);
  drawing.lineTo(-size * 0.75, -size * 0.7);
  drawing.closePath();
  drawing.fillStyle = tint;
  drawing.fill();
  drawing.lineWidth = 1.5;
  drawing.strokeStyle = colour("paper");
  drawing.stroke();
  drawing.restore();
}

// What waits, a box a message, the oldest on the left.
export function drawSlots(canvas, queue) {
  const [drawing, width, height] = context(canvas);
  if (!queue) return;
  const waiting = queue.waiting ?? [], places = Math.max(queue.capacity, waiting.length), step = width / places;
  for (let k = 0; k < places; k++) {
    drawing.fillStyle = k < waiting.length ? hue(waiting[k] * 2 + 1) : colour("lane");
    drawing.fillRect(k * step, 0, Math.max(1, step - 2), height);
  }
}

// The last minute: the queue's length, what it dropped, and the link's rate.
export function drawHistory(canvas, entries, nowMs) {
  const [drawing, width, height] = context(canvas);
  const x = ms => width - (nowMs - ms) / HISTORY_MS * width;
  const most = (key, least) => Math.max(least, ...entries.map(entry => entry[key]));
  const capacity = most("capacity", 1), drops = most("drops", 5), rate = most("rate", 1000);
  const unit = (height - 3 * 16) / 5;
  const lanes = [
    {units: 2, most: capacity, key: "queued", tint: colour("accent"), says: `queue, of ${capacity}`},
    {units: 1, most: drops, key: "drops", tint: colour("lost"), says: `dropped, up to ${Math.round(drops)} a second`},
    {units: 2, most: rate, key: "rate", tint: colour("link"), says: `link, up to ${bits(rate)}`},
  ];
  drawing.font = "11px system-ui, sans-serif";
  let top = 0;
  for (const lane of lanes) {
    drawing.fillStyle = colour("soft");
    drawing.fillText(lane.says, 0, top + 12);
    top += 16;
    const bottom = top + lane.units * unit, y = value => bottom - value / lane.most * (bottom - top - 1);
    drawing.fillStyle = colour("lane");
    drawing.fillRect(0, top, width, bottom - top);
    if (entries.length > 1) {
      drawing.beginPath();
      for (const entry of entries) drawing.lineTo(x(entry.ms), y(entry[lane.key]));
      drawing.strokeStyle = drawing.fillStyle = lane.tint;
      drawing.lineWidth = 1.5;
      drawing.stroke();
      for (const {ms} of [entries.at(-1), entries[0]]) drawing.lineTo(x(ms), bottom);
      drawing.globalAlpha = 0.3;
      drawing.fill();
      drawing.globalAlpha = 1;
    }
    top = bottom;
  }
  drawing.fillStyle = colour("soft");
  drawing.textAlign = "right";
  drawing.fillText("last minute", width, 12);
  drawing.textAlign = "left";
}

export const bits = rate => rate >= 1e6 ? `${(rate / 1e6).toFixed(1)} Mbit/s` : `${(rate / 1e3).toFixed(0)} kbit/s`;
export const seconds = s => s == null ? "–" : s < 10 ? `${s.toFixed(1)} s` : s < 120 ? `${s.toFixed(0)} s` : s < 7200 ? `${(s / 60).toFixed(0)} min` :
  s < 172_800 ? `${(s / 3600).toFixed(0)} h` : `${(s / 86_400).toFixed(0)} days`;
export const clock = s => [...(s < 3600 ? [] : [Math.floor(s / 3600)]), Math.floor(s % 3600 / 60), Math.floor(s % 60)].map(part => String(part).padStart(2, "0")).join(":");
export const percent = part => part == null ? "–" : `${Math.round(part * 100)} %`;

// How the map is moved, zoomed and tapped, and how a place with a heading is drawn on it: by mouse, by wheel, by fingers, by keys.

const STILL_PX = 6, STEP_PX = 60, AIM_PX = 15, FINE_PX = 1, LOOK_PX = 40, TURN = Math.PI / 12;

// map: {canvas, shift(dx, dy), zoom(factor, at), pick(x, y), aim(from, to, isOver)}; aim is for a tool, where one is in hand.
export function listen(map) {
  const {canvas} = map, place = event => [event.offsetX, event.offsetY];
  let from = null, before = null, moved = 0;
  canvas.addEventListener("pointerdown", event => {
    if (!event.isPrimary) return;
    canvas.setPointerCapture(event.pointerId);
    from = before = place(event);
    moved = 0;
    if (map.tool) map.aim(from, from, false);
  });
  canvas.addEventListener("pointermove", event => {
    if (!before || !event.isPrimary) return;
    const now = place(event);
    moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (map.tool) map.aim(from, now, false);
    else if (event.pointerType !== "touch" && moved > STILL_PX) map.shift(now[0] - before[0], now[1] - before[1]);
    before = now;
  });
  canvas.addEventListener("pointerup", event => {
    if (!before || !event.isPrimary) return;
    if (map.tool) map.aim(from, place(event), true);
    else if (moved <= STILL_PX) map.pick(...place(event));
    before = null;
  });
  canvas.addEventListener("pointercancel", () => {  // the page scrolls: one finger is for that
    before = null;
    map.preview = null;
  });
  aimByKeys(map);
  wheelAndKeys(canvas, (dx, dy) => map.shift(dx, dy), (factor, at) => map.zoom(factor, at));
  fingers(map);
}

// A tool by keys: arrows move its place, with shift by a pixel; Enter takes it, then left and right turn where it looks, and Enter ends it.
function aimByKeys(map) {
  const {canvas} = map;
  let tool = null, from = null, yaw = null;
  canvas.addEventListener("keydown", event => {
    if (!map.tool) return;
    if (map.tool !== tool) [tool, from, yaw] = [map.tool, [canvas.clientWidth / 2, canvas.clientHeight / 2], null];
    const step = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[event.key], isOver = event.key === "Enter" && yaw !== null;
    if (!step && event.key !== "Enter") return;
    event.preventDefault();
    event.stopImmediatePropagation();               // the map does not move, too
    if (!step) yaw ??= 0;
    else if (yaw !== null) yaw -= TURN * step[0];
    else from = from.map((at, k) => Math.min([canvas.clientWidth, canvas.clientHeight][k], Math.max(0, at + step[k] * (event.shiftKey ? FINE_PX : AIM_PX))));
    map.aim(from, yaw === null ? from : [from[0] + LOOK_PX * Math.cos(yaw), from[1] - LOOK_PX * Math.sin(yaw)], isOver);
  });
}

// move(dx, dy, isShift) and zoom(factor, at), in pixels.
export function wheelAndKeys(canvas, move, zoom) {
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500), [event.offsetX, event.offsetY]);
  }, {passive: false});
  canvas.addEventListener("keydown", event => {
    const step = {ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]}[event.key], factor = {"+": 1.25, "=": 1.25, "-": 0.8}[event.key];
    if (step) move(STEP_PX * step[0], STEP_PX * step[1], event.shiftKey);
    else if (factor) zoom(factor, [canvas.clientWidth / 2, canvas.clientHeight / 2]);
    else return;
    event.preventDefault();
  });
}

// Two fingers move the map and zoom it.
function fingers(map) {
  const {canvas} = map;
  let last = null;
  const two = event => {
    const {left, top} = canvas.getBoundingClientRect(), [one, other] = [...event.targetTouches].map(touch => [touch.clientX - left, touch.clientY - top]);
    return {middle: [(one[0] + other[0]) / 2, (one[1] + other[1]) / 2], apart: Math.max(1, Math.hypot(one[0] - other[0], one[1] - other[1]))};
  };
  const take = event => {
    if (map.tool || event.targetTouches.length !== 2) {
      last = null;
      return;
    }
    if (event.cancelable) event.preventDefault();
    const now = two(event);
    if (last) {
      map.shift(now.middle[0] - last.middle[0], now.middle[1] - last.middle[1]);
      map.zoom(now.apart / last.apart, now.middle);
    }
    last = now;
  };
  for (const name of ["touchstart", "touchmove", "touchend", "touchcancel"]) canvas.addEventListener(name, take, {passive: false});
}

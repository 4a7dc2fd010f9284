// How the 3-D view is turned, moved and zoomed: by mouse, by wheel, by fingers, by keys.

import {wheelAndKeys} from "./gestures.js";

// view: {turn(dx, dy), shift(dx, dy), zoom(factor)}, in pixels. One finger or the left button turns; two fingers or another button move.
export function listen(canvas, view) {
  const held = new Map(), place = event => [event.clientX, event.clientY];
  const two = () => {
    const [[ax, ay], [bx, by]] = held.values();
    return {x: (ax + bx) / 2, y: (ay + by) / 2, apart: Math.max(1, Math.hypot(ax - bx, ay - by))};
  };
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, place(event));
  });
  canvas.addEventListener("pointermove", event => {
    const from = held.get(event.pointerId);
    if (!from) return;
    const to = place(event), before = held.size === 2 && two();
    held.set(event.pointerId, to);
    if (before) {
      const now = two();
      view.shift(now.x - before.x, now.y - before.y);
      view.zoom(now.apart / before.apart);
    } else if (event.shiftKey || event.buttons > 1) view.shift(to[0] - from[0], to[1] - from[1]);
    else if (held.size === 1) view.turn(to[0] - from[0], to[1] - from[1]);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, event => held.delete(event.pointerId));
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  wheelAndKeys(canvas, (dx, dy, isShift) => view[isShift ? "shift" : "turn"](dx, dy), factor => view.zoom(factor));
}

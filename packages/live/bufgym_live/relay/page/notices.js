// What must not be missed: troubles that began and refusals. Each stays until somebody says that it was seen, even when it is over.

import {say, seconds} from "./draw.js";
import {address} from "./route.js";

const MOST = 200, isNarrow = matchMedia("(max-width: 44rem)");

export class Notices {
  constructor(element) {
    this.element = element;
    this.notices = new Map();                       // key -> {name, text, ms, overMs, isOver, level}
    this.seen = new Set();                          // troubles that were seen and last
  }

  // The troubles that a robot has now; texts may change while one lasts.
  troubles(robot, nowMs) {
    const now = new Map(robot.troubles.filter(one => one.level === "error").map(one => [`${robot.name} ${one.kind}`, one]));
    for (const [key, {text, level}] of now)
      if (!this.seen.has(key)) this.put(key, {name: robot.name, text, level, overMs: null, ms: this.notices.get(key)?.ms ?? nowMs});
    for (const [key, notice] of this.notices) if (notice.name === robot.name && notice.level === "error" && !now.has(key)) notice.overMs ??= nowMs;
    for (const key of this.seen) if (key.startsWith(robot.name + " ") && !now.has(key)) this.seen.delete(key);
  }

  refused(name, text, nowMs) { this.put(`refused ${name} ${text}`, {name, text, level: "refused", overMs: null, ms: nowMs}); }

  put(key, notice) {
    if (this.notices.has(key) || this.notices.size < MOST) this.notices.set(key, notice);
  }

  clear() {
    for (const key of this.notices.keys()) this.dismiss(key);
  }

  dismiss(key) {
    const notice = this.notices.get(key);
    if (notice?.level === "error" && notice.overMs === null) this.seen.add(key);
    this.notices.delete(key);
    this.draw(Date.now());
  }

  forget() {
    this.seen.clear();
    this.notices.clear();
    this.element.hidden = true;
  }

  draw(nowMs) {
    const all = [...this.notices].sort(([, one], [, other]) => Number(one.overMs !== null) - Number(other.overMs !== null) || other.ms - one.ms);
    const shown = all.slice(0, isNarrow.matches ? 1 : 3), more = all.length - shown.length;
    this.element.hidden = all.length === 0;
    while (this.element.children.length > shown.length + 1) this.element.lastChild.remove();
    while (this.element.children.length < shown.length + 1) this.element.append(this.line());
    const last = this.element.children[shown.length];
    shown.forEach(([key, {name, text, ms, overMs, level}], k) => {
      const line = this.element.children[k], [link, says, button] = line.children;
      line.hidden = false;
      line.className = overMs === null ? level : "over";
      if (link.hash !== address(name, "health")) link.href = address(name, "health");
      say(link, name);
      say(says, level === "refused" ? `refused: ${text}` : `${text}, ${overMs === null ? `for ${seconds((nowMs - ms) / 1000)}` : `over, lasted ${seconds((overMs - ms) / 1000)}`}`);
      say(button, "Seen");
      button.onclick = () => this.dismiss(key);
    });
    last.hidden = all.length < 2;
    last.className = "all";
    say(last.children[0], "");
    say(last.children[1], more > 0 ? `and ${more} more` : "");
    say(last.children[2], "All seen");
    last.children[2].onclick = () => this.clear();
  }

  line() {
    const line = document.createElement("p");
    line.innerHTML = `<a></a><span></span><button type="button"></button>`;
    return line;
  }
}

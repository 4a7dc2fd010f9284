// What must not be missed: troubles that began and refusals. Each stays until somebody says that it was seen, even when it is over.

import {say, seconds} from "./draw.js";
import {address} from "./route.js";

const MOST = 200, isNarrow = matchMedia("(max-width: 44rem)");

export class Notices {
  constructor(element) {
    this.element = element;
    this.drawnMs = 0;
    this.notices = new Map();                       // key -> {name, text, ms, overMs, isOver, level}
    this.seen = new Set();                          // troubles that were seen and last
  }

  // The troubles that a robot has now; texts may change while one lasts.
  troubles(robot, nowMs) {
    const begun = (key, sinceMs) => {               // what is over and comes again begins again
      const before = this.notices.get(key);
      return before && before.overMs === null ? before.ms : sinceMs;
    };
    const now = new Map(robot.troubles.filter(one => one.level === "error").map(one => [`${robot.name} ${one.kind}`, one]));
    for (const [key, {text, level, sinceMs}] of now)
      if (!this.seen.has(key)) this.put(key, {name: robot.name, text, level, overMs: null, ms: begun(key, sinceMs)});
    for (const [key, notice] of this.notices) if (notice.name === robot.name && notice.level === "error" && !now.has(key)) notice.overMs ??= nowMs;
    for (const key of this.seen) if (key.startsWith(robot.name + " ") && !now.has(key)) this.seen.delete(key);
  }

  // ``again`` does once more what was refused, if somebody wants that.
  refused(name, text, nowMs, again = null) { this.put(`refused ${name} ${text}`, {name, text, level: "refused", overMs: null, ms: nowMs, again}); }

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
    this.draw(this.drawnMs);
  }

  forget() {
    this.seen.clear();
    this.notices.clear();
    this.element.hidden = true;
  }

  draw(nowMs) {
    this.drawnMs = nowMs;
    const all = [...this.notices].sort(([, one], [, other]) => Number(one.overMs !== null) - Number(other.overMs !== null) || other.ms - one.ms);
    const shown = all.slice(0, isNarrow.matches ? 1 : 3), more = all.length - shown.length;
    this.element.hidden = all.length === 0;
    while (this.element.children.length > shown.length + 1) this.element.lastChild.remove();
    while (this.element.children.length < shown.length + 1) this.element.append(this.line());
    const last = this.element.children[shown.length];
    shown.forEach(([key, {name, text, ms, overMs, level, again}], k) => {
      const line = this.element.children[k], [link, says, button, once] = line.children;
      line.hidden = false;
      line.className = overMs === null ? level : "over";
      if (link.hash !== address(name, "health")) link.href = address(name, "health");
      say(link, name);
      say(says, level === "refused" ? `refused: ${text}` : `${text}, ${overMs === null ? `for ${seconds((nowMs - ms) / 1000)}` : `over, lasted ${seconds((overMs - ms) / 1000)}`}`);
      say(button, "Seen");
      button.onclick = () => this.dismiss(key);
      once.hidden = !again;
      once.onclick = () => {
        this.dismiss(key);
        again();
      };
    });
    last.hidden = all.length < 2;
    last.className = "all";
    last.children[3].hidden = true;
    say(last.children[0], "");
    say(last.children[1], more > 0 ? `and ${more} more` : "");
    say(last.children[2], "All seen");
    last.children[2].onclick = () => this.clear();
  }

  line() {
    const line = document.createElement("p");
    line.innerHTML = `<a></a><span></span><button type="button"></button><button type="button" hidden>Send again</button>`;
    return line;
  }
}

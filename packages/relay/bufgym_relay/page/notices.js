// Alerts: troubles that began and refusals, the worst first. Each stays until somebody says that it was seen, even when it is over.

import {say, seconds} from "./draw.js";
import {address} from "./route.js";

const MOST = 200;                                   // beyond it refusals and what is over go, the least first; a trouble that lasts never goes
const CALM_MS = 2000;                               // a screen reader is told of new alerts so often at most
const SAME_MS = 10_000;                             // refusals of a kind within so long are one, with their number
const REFUSED = 1.5;                                // the rank of a refusal: behind a robot that is silent, before a low battery
const isNarrow = matchMedia("(max-width: 44rem), (max-height: 30rem)");

export class Notices {
  // ``spoken`` is the live region: texts of ``element`` change with each second, so nobody would listen to them.
  constructor(element, spoken) {
    this.element = element;
    this.spoken = spoken;
    this.spokenMs = -Infinity;
    this.begun = new Set();                         // keys that the live region has not said yet
    this.drawnMs = 0;
    this.notices = new Map();                       // key -> {name, text, ms, overMs, level, rank}
    this.seen = new Set();                          // troubles that were seen and last
  }

  // The troubles that a robot has now; texts may change while one lasts.
  troubles(robot, nowMs) {
    const begun = (key, sinceMs) => {               // what is over and comes again begins again
      const before = this.notices.get(key);
      return before && before.overMs === null ? before.ms : sinceMs;
    };
    const now = new Map(robot.troubles.filter(one => one.level === "error").map(one => [`${robot.name} ${one.kind}`, one]));
    for (const [key, {text, level, rank, sinceMs}] of now)
      if (!this.seen.has(key)) this.put(key, {name: robot.name, text, level, rank, overMs: null, ms: begun(key, sinceMs)});
    for (const [key, notice] of this.notices) if (notice.name === robot.name && notice.level === "error" && !now.has(key)) notice.overMs ??= nowMs;
    for (const key of this.seen) if (key.startsWith(robot.name + " ") && !now.has(key)) this.seen.delete(key);
  }

  // ``again`` does once more what was refused, if somebody wants that.
  refused(name, text, nowMs, again = null, kind = text) {
    const key = `refused ${name} ${kind}`, before = this.notices.get(key), times = before && nowMs - before.ms < SAME_MS ? before.times + 1 : 1;
    this.put(key, {name, text, level: "refused", rank: REFUSED, overMs: null, ms: nowMs, again, times});
  }

  // What befell the page itself; a later one of a kind replaces it.
  told(kind, text, nowMs) { this.put(`told ${kind}`, {name: "", text, level: "told", rank: REFUSED, overMs: null, ms: nowMs}); }

  put(key, notice) {
    if (this.notices.get(key)?.overMs !== null) this.begun.add(key);
    this.notices.set(key, notice);
  }

  // A robot that somebody has removed.
  removed(name) { for (const [key, notice] of this.notices) if (notice.name === name) this.notices.delete(key); }

  clear() {
    for (const key of this.notices.keys()) this.dismiss(key);
  }

  dismiss(key) {
    const notice = this.notices.get(key);
    if (notice?.level === "error" && notice.overMs === null) this.seen.add(key);
    this.notices.delete(key);
    this.draw(this.drawnMs);
  }

  // All of them, [key, notice] each: those that last first, the worst of them first, and the latest of equals.
  sorted() {
    return [...this.notices].sort(([, one], [, other]) => Number(one.overMs !== null) - Number(other.overMs !== null) || one.rank - other.rank || other.ms - one.ms);
  }

  // Say which have begun since it was said last: each once, however its text changes.
  speak(all) {
    const fresh = all.filter(([key, {overMs}]) => this.begun.has(key) && overMs === null).map(([, {name, text, level}]) => `${name && `${name}: `}${level === "refused" ? "refused: " : ""}${text}`);
    if (!fresh.length || performance.now() - this.spokenMs < CALM_MS) return;
    this.begun.clear();
    this.spokenMs = performance.now();
    this.spoken.replaceChildren(fresh.slice(0, 3).join(". ") + (fresh.length > 3 ? `. And ${fresh.length - 3} more alerts` : ""));
  }

  draw(nowMs) {
    this.drawnMs = nowMs;
    const all = this.sorted();
    for (const [key, {level, overMs}] of all.slice(MOST)) if (level !== "error" || overMs !== null) this.notices.delete(key);
    this.speak(all);
    const shown = all.slice(0, isNarrow.matches ? 1 : 3), more = all.length - shown.length;
    this.element.hidden = all.length === 0;
    while (this.element.children.length > shown.length + 1) this.element.lastChild.remove();
    while (this.element.children.length < shown.length + 1) this.element.append(this.line());
    const last = this.element.children[shown.length];
    shown.forEach(([key, {name, text, ms, overMs, level, again, times}], k) => {
      const line = this.element.children[k], [link, says, button, once] = line.children;
      line.hidden = false;
      line.className = overMs === null ? level : "over";
      if (link.hash !== address(name, "health")) link.href = address(name, "health");
      say(link, name);
      say(says, level === "told" ? text : level === "refused" ? `refused: ${text}${times > 1 ? ` (${times} times)` : ""}` : `${text}, ${overMs === null ? `for ${seconds((nowMs - ms) / 1000)}` : `over, lasted ${seconds((overMs - ms) / 1000)}`}`);
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

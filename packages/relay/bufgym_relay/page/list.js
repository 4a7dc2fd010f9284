// The list of robots: those that need somebody first, and those that a search finds.

import {bits, percent, say, seconds, tint} from "./draw.js";
import {battery, doing, LOW} from "./fleet.js";
import {address} from "./route.js";

const names = new Intl.Collator(undefined, {numeric: true}), byName = (one, other) => names.compare(one.name, other.name);

export class List {
  constructor(element, search, count) {
    this.element = element;
    this.search = search;
    this.count = count;
    this.cards = new Map();
    search.oninput = () => this.find();
    element.onkeydown = event => {
      const shown = this.shown(), step = {ArrowDown: 1, ArrowUp: -1}[event.key], to = shown[shown.indexOf(document.activeElement) + step];
      if (step) event.preventDefault();
      to?.focus();
    };
  }

  add(robot) {
    const card = Object.assign(document.createElement("a"), {className: "card"});
    card.innerHTML = `<b><i class="dot"></i><span class="called"></span><i class="mark" hidden></i></b><span class="says"></span>
      <span class="soft"><span class="seen"></span><span class="charge"></span></span><span class="bar" hidden><i></i></span>`;
    card.querySelector(".called").textContent = robot.name;
    const odd = /[^\x20-\x7e]/.test(robot.name);    // letters of other scripts look like ours
    Object.assign(card.querySelector(".mark"), {hidden: !odd, textContent: "unusual letters", title: [...robot.name].map(letter => "U+" + letter.codePointAt(0).toString(16)).join(" ")});
    this.cards.set(robot.name, card);
    this.element.append(card);
    this.colour(robot);
    document.getElementById("nobody")?.remove();
  }

  colour(robot) { this.cards.get(robot.name)?.style.setProperty("--robot", tint(robot.colour)); }

  remove(name) {
    this.cards.get(name)?.remove();
    this.cards.delete(name);
  }

  clear() {
    this.element.replaceChildren();
    this.cards.clear();
  }

  // Their troubles are in ``robot.troubles``.
  update(robots, chosen, tab, nowMs) {
    for (const robot of robots) this.say(robot, chosen, tab, nowMs);
    const rank = robot => robot.troubles[0]?.rank ?? (robot.isHere ? 9 : 10);
    const sorted = [...robots].sort((one, other) => rank(one) - rank(other) || byName(one, other)), focused = /** @type {HTMLElement} */ (document.activeElement);
    let at = this.element.firstElementChild;
    for (const {name} of sorted) {
      const card = this.cards.get(name);
      if (at?.nextElementSibling === card) this.element.append(at);  // one goes down, and not all others up
      else if (at !== card) this.element.insertBefore(card, at);
      at = card.nextElementSibling;
    }
    if (focused !== document.activeElement && this.element.contains(focused)) focused.focus({preventScroll: true});
    const absent = robots.filter(robot => rank(robot) === 10).length, bad = robots.filter(robot => rank(robot) < 3).length;
    say(this.count, `${robots.length - absent}${absent ? `, ${absent} away` : ""}${bad ? `, ${bad} need${bad === 1 ? "s" : ""} help` : ""}`);
    this.find();
  }

  say(robot, chosen, tab, nowMs) {
    const card = this.cards.get(robot.name), charged = battery(robot), [worst] = robot.troubles, silentMs = nowMs - robot.heardMs;
    const level = worst?.level ?? (robot.status?.ok && robot.isHere ? "ok" : ""), [says, seen, charge, bar] = [".says", ".seen", ".charge", ".bar"].map(name => card.querySelector(name));
    const text = worst?.kind === "silent" ? doing(robot, nowMs) : worst ? worst.text : robot.status?.text || (robot.status?.ok ? "OK" : "");
    card.classList.toggle("away", robot.away);
    card.classList.toggle("absent", !worst && !robot.isHere);
    card.dataset.level = level;
    if (card.hash !== address(robot.name, tab)) card.href = address(robot.name, tab);
    card.ariaCurrent = robot.name === chosen ? "true" : null;
    say(says, text);
    if (says.title !== text) says.title = text;
    say(seen, !robot.isHere ? `last seen ${seconds(silentMs / 1000)} ago${robot.pose ? ` at ${robot.pose.x.toFixed(1)}, ${robot.pose.y.toFixed(1)} m` : ""}` : robot.away ? `silent for ${seconds(silentMs / 1000)}` : bits(robot.queue?.rate_bps ?? 0));
    say(charge, charged == null ? "" : percent(charged));
    bar.hidden = charged == null;
    bar.classList.toggle("low", charged < LOW);
    bar.firstChild.style.width = percent(Math.min(1, Math.max(0, charged ?? 0))).replace(" ", "");
  }

  find() {
    const wanted = this.search.value.trim().toLowerCase();
    for (const [name, card] of this.cards) card.hidden = !(name + " " + card.querySelector(".says").textContent).toLowerCase().includes(wanted);
    // One of them is reached by Tab, the others from it by arrows.
    const shown = this.shown(), first = shown.find(card => card === document.activeElement) ?? shown.find(card => card.ariaCurrent) ?? shown[0];
    for (const card of shown) if (card.tabIndex !== (card === first ? 0 : -1)) card.tabIndex = card === first ? 0 : -1;
  }

  shown() { return [...this.element.children].filter(card => !card.hidden); }
}

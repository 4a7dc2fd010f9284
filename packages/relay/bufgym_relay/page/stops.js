// The stops of all robots, as relay and robots say them, and those that this browser has said and no robot has confirmed: kept over a reload.
// A stop is named by who says it and its number. Of each who the last one counts, and of one number its release.

import {object} from "./cdr.js";

const KEPT = "bufgym-stop ", MOST = 1000;

function named(id) {
  const found = /^(.+)-([0-9]{1,16})$/s.exec(id);
  return found ? [found[1], Number(found[2])] : [id, 1];
}

// What a message or a status says of stops: {id, by, isHeld}.
export function stopsOf(said) {
  return (Array.isArray(said) ? said : []).slice(0, MOST).map(object).filter(({id}) => typeof id === "string" && id)
    .map(one => ({id: String(one.id).slice(0, 150), by: String(one.by ?? "").slice(0, 100), isHeld: !one.released_us}));
}

export class Stops {
  constructor(who) {
    this.who = who;
    this.number = 0;
    this.ledgers = new Map();                       // robot -> who -> {number, id, by, isHeld}
    this.robots = new Map();                        // robot -> what it said last
    this.relay = new Map();                         // robot -> what the relay said last, on this connection
    this.waiting = new Map();                       // id -> robot, of those that no robot has confirmed
    for (const key of Object.keys(localStorage)) if (key.startsWith(KEPT)) this.waiting.set(key.slice(KEPT.length), localStorage.getItem(key));
  }

  say(robot) {
    const id = `${this.who}-${++this.number}`;
    this.waiting.set(id, robot);
    try {
      localStorage.setItem(KEPT + id, robot);
    } catch {
      // It is full, or forbidden: then the stop is lost by a reload, and said until then.
    }
    return id;
  }

  forget(id) {
    this.waiting.delete(id);
    localStorage.removeItem(KEPT + id);
  }

  ids(robot) { return [...this.waiting].filter(([, one]) => one === robot).map(([id]) => id); }

  // Whether a list of stops has this one, or a later one of the same who.
  static has(stops, id) {
    const [who, number] = named(id);
    return stops.some(stop => { const [other, its] = named(stop.id); return other === who && its >= number; });
  }

  // What the relay or the robot knows; ``isRobot`` if it is the robot itself, which confirms what it has written down.
  heard(robot, stops, isRobot = false, confirms = isRobot) {
    const ledger = this.ledgers.get(robot) ?? new Map();
    this.ledgers.set(robot, ledger);
    (isRobot ? this.robots : this.relay).set(robot, stops);
    for (const stop of stops) {
      const [who, number] = named(stop.id), before = ledger.get(who);
      if (!before || number > before.number || (number === before.number && !stop.isHeld)) ledger.set(who, {...stop, number});
    }
    for (const id of this.ids(robot)) {
      const [who, number] = named(id), known = ledger.get(who), isOver = known && (known.number > number || (known.number === number && !known.isHeld));
      if (isOver || (confirms && Stops.has(stops, id))) this.forget(id);
    }
  }

  // Another connection: another relay may know less.
  begin() { this.relay.clear(); }

  // What anybody holds still, unless the relay knows its release: {id, by}.
  held(robot) {
    const over = (this.relay.get(robot) ?? []).filter(stop => !stop.isHeld), held = new Map();
    for (const stop of [...this.ledgers.get(robot)?.values() ?? [], ...this.robots.get(robot) ?? []])
      if (stop.isHeld && !Stops.has(over, stop.id)) held.set(stop.id, stop);
    for (const id of this.ids(robot)) if (!Stops.has([...held.values()], id)) held.set(id, {id, by: "you"});
    return [...held.values()];
  }
}

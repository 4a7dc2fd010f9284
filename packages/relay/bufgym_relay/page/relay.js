// The connection to the relay: says hello, subscribes, sends commands, and connects again by itself.

import {Clock} from "./clock.js";
import {decode, fromJson, json} from "./messages.js";
import {Rights} from "./rights.js";
import {Sleep} from "./sleep.js";
import {Stops, stopsOf} from "./stops.js";

const FIRST_MS = 200, AWAY_MS = 1000, MOST_MS = 2000, HELD_MS = 5000;  // as in backoff.py, but somebody waits for it
const ASK_MS = 500, SILENT_MS = 2000, LOST_MS = 6000;  // the relay is asked so often; without an answer for so long it is not live, then given up
const COMMAND_S = 3, EARLY = 1000, STOP = /^\/robots\/([^/]+)\/stop$/;

export class Relay {
  // on: {state(text, isOn), welcome(), rights(), message(message), said(object), unauthorized(why, token), slept(ms)}
  constructor(on) {
    this.on = on;
    this.welcome = null;
    this.clock = new Clock();
    this.rights = new Rights(this);
    this.early = [];                                // messages on topics of which the relay has not said yet what they are
    this.sleep = new Sleep(ASK_MS);
    this.waits = 0;                                 // timer of the next try
    this.askedMs = null;                            // since when an answer is awaited
    this.isLive = false;
    this.received = 0;                              // the highest no_drop message that came
    this.acked = 0;                                 // and the highest of ours that the relay holds
    this.subscriptions = new Map();
    this.commands = [];                             // not answered yet; the first is on its way
    this.held = new Map();                          // number of a command that the relay holds -> who is told what became of it
    this.name = "page-" + [...crypto.getRandomValues(new Uint8Array(8))].map(byte => byte.toString(16).padStart(2, "0")).join("");
    this.stops = new Stops(this.name);
    this.token = sessionStorage.getItem("token");
    const brought = new URLSearchParams(location.hash.slice(1)).get("token");
    if (brought !== null) {                         // kept, but not in an address that somebody may send on
      this.keep(brought);
      history.replaceState(null, "", "#/");
    }
    this.mostMs = FIRST_MS;                         // the longest delay until the next try
    this.connect();
    setInterval(() => this.watch(), ASK_MS);
    addEventListener("online", () => this.socket.readyState === WebSocket.CONNECTING ? this.anew() : this.again());
    document.addEventListener("visibilitychange", () => { if (!document.hidden) this.again(); });
  }

  connect() {
    clearTimeout(this.waits);
    this.waits = 0;
    this.beganMs = performance.now();
    const address = new URL("relay", location.href);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    address.hash = address.search = "";
    this.socket = new WebSocket(address, ["bufgym.relay.v1"]);
    this.socket.binaryType = "arraybuffer";
    this.isClosed = false;
    let isAway = true;
    this.socket.onopen = () => {
      isAway = false;
      // Without a session: it ends with the connection. Who sent a command that it leaves is asked whether it goes again.
      this.received = 0;
      this.shown = this.token;
      this.say("hello", {version: 1, name: this.name, form: "binary", ...(this.token ? {token: this.token} : {})});
    };
    const {socket} = this;
    socket.onmessage = event => { if (socket === this.socket) this.hear(event.data); };
    socket.onclose = () => {
      if (socket !== this.socket || this.isClosed) return;
      this.isClosed = true;
      if (this.welcome && performance.now() - this.since >= HELD_MS) this.mostMs = FIRST_MS;
      this.welcome = null;
      this.isLive = false;
      this.held.clear();
      for (const {failed} of this.commands.splice(0)) failed(new Error("not confirmed before the link broke"));
      this.on.state("not connected", false);
      if (!this.refused) this.waits = setTimeout(() => this.connect(), Math.min(this.mostMs, isAway ? AWAY_MS : MOST_MS) * Math.random());
      this.mostMs = Math.min(2 * this.mostMs, MOST_MS);
    };
  }

  // Try now, if it waits for the next try.
  again() { if (this.waits) this.connect(); }

  // Give this connection up, whose own end may come a minute later, and connect at once.
  anew() {
    this.giveUp();
    this.again();
  }

  giveUp() {
    const {socket} = this;
    socket.close();
    socket.onclose(null);
  }

  // Ask the relay for its time: its answers say that the link is alive, both ways.
  watch() {
    const slept = this.sleep.slept();
    if (slept) {                                    // the clock is wrong, and the relay may have given this connection up
      this.on.slept(slept);
      return this.anew();
    }
    const ms = performance.now(), silentMs = this.welcome && this.askedMs !== null ? ms - this.askedMs : 0;
    if (!this.welcome) {
      if (!this.isClosed && ms - this.beganMs > LOST_MS) this.giveUp();
    } else if (silentMs > LOST_MS) this.giveUp();
    else if (silentMs > SILENT_MS) {
      if (this.isLive) this.on.state("no answer", this.isLive = false);
    } else if (this.askedMs === null) {
      this.askedMs = ms;
      this.say("clock", {});
    }
  }

  // Connect with this token: now, or ``later``, when the relay ends the connection because the token before is over.
  authorize(token, later = false) {
    this.keep(token);
    this.refused = false;
    if (this.socket.readyState === WebSocket.CLOSED) this.connect();
    else if (!later) this.socket.close();
  }

  keep(token) {
    this.token = token;
    sessionStorage.setItem("token", token);
  }

  say(op, fields) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({op, ...fields}));
  }

  subscribe(id, topic, fields = {}) {
    if (this.subscriptions.get(id)?.topic === topic) return;
    this.subscriptions.set(id, {id, topic, ...fields});
    if (this.welcome) this.say("subscribe", this.subscriptions.get(id));
  }

  unsubscribe(id) {
    if (this.subscriptions.delete(id) && this.welcome) this.say("unsubscribe", {id});
  }

  holds(topic) { return this.rights.of(topic).no_drop ?? topic.endsWith("/command"); }

  // Say what is worth nothing later: not while the relay is away. What must not go goes only where what was said before has left and the relay
  // answers in time. Whether it went.
  sayNow(topic, data, must, forMs) {
    const keepsUp = this.socket.bufferedAmount === 0 && (this.askedMs === null || performance.now() - this.askedMs < 2 * forMs);
    if (!this.isLive || !(must || keepsUp)) return false;
    this.say("publish", {topic, data, encoding: "json", stamp_us: Math.round(1000 * this.clock.stamp()), until_us: this.until(forMs)});
    return true;
  }

  // The relay's time in so many ms.
  until(ms) { return Math.floor(1000 * (this.clock.now() + ms)); }

  // The deadline of a command on a topic, by the relay's rule.
  deadline(topic) { return this.until(1000 * (this.rights.of(topic).command_s ?? COMMAND_S)); }

  // Stop a robot, said on each connection until the robot confirms it. What waits for it is withdrawn.
  stop(robot) {
    const id = this.stops.say(robot), own = `/robots/${robot}/`;
    for (const command of this.commands) if (command.topic.startsWith(own)) command.failed(new Error("withdrawn by a stop"));
    if (this.welcome) this.sayStop(id, robot);
    return id;
  }

  sayStop(id, robot) { this.say("publish", {topic: `/robots/${robot}/stop`, data: {command: "stop", id}}); }

  // Release a robot from all stops that anybody holds.
  release(robot) {
    const of = this.stops.held(robot).map(stop => stop.id), topic = `/robots/${robot}/stop`;
    this.say("publish", {topic, data: {command: "release", id: `${this.name}-release`, of}, until_us: this.deadline(`/robots/${robot}/command`)});
    return of;
  }

  // Done when the relay holds it, true; an error says why it does not. What it does not hold goes at once, false.
  // ``ended`` is called with what became of it: {lost, why}.
  command(topic, data, fields = {encoding: "json"}, ended = said => {}) {
    if (!this.isLive) return Promise.reject(new Error("not sent: the relay does not answer"));
    fields = {...fields, until_us: this.deadline(topic)};
    if (!this.holds(topic)) {
      this.say("publish", {topic, data, ...fields});
      return Promise.resolve(false);
    }
    return new Promise((done, failed) => {
      this.commands.push({topic, data, fields, done, failed, ended});
      if (this.commands.length === 1) this.sendCommand();
    });
  }

  sendCommand() {
    const [command] = this.commands;
    if (command) this.say("publish", {topic: command.topic, data: command.data, ...command.fields, no_drop: true, seq: this.acked + 1});
  }

  // ``unknown`` is the answer until the relay has said.
  mayCommand(topic, unknown = false) { return this.rights.of(topic).send ?? unknown; }

  // Whether the relay keeps a topic's last message for who subscribes later: what comes may be old. Undefined until the relay has said.
  isLatched(topic) { return this.rights.of(topic).latched; }

  hear(data) {
    if (typeof data !== "string") return this.take(decode(data));
    const said = JSON.parse(data);
    if (said.op === "message") this.take(fromJson(said));
    else if (said.op === "welcome") {
      this.welcome = said;
      this.since = performance.now();
      this.rights.begin();
      this.early = [];
      this.clock.begin(said.clock_us / 1000);
      this.askedMs = null;
      this.isLive = true;
      this.stops.begin();
      for (const [id, robot] of this.stops.waiting) this.sayStop(id, robot);
      this.acked = said.received;
      for (const subscription of this.subscriptions.values()) this.say("subscribe", subscription);
      this.on.state("live", true);
      this.on.welcome();
    } else if (said.op === "clock") {
      this.clock.heard(said.clock_us / 1000);
      this.askedMs = null;
      if (!this.isLive) this.on.state("live", this.isLive = true);
    } else if (said.op === "ack") this.answered(said.seq);
    else if (said.op === "rights") {
      this.rights.heard(said.rights);
      for (const message of this.early.splice(0)) this.pass(message);
      this.on.rights();
    } else if (said.op === "delivered") {
      this.answered(said.seq);                      // it may come before the ack, which it implies
      this.held.get(said.seq)?.(said);
      this.held.delete(said.seq);
    } else if (said.op === "refused") this.refuse(said);
    else this.on.said(said);
  }

  answered(seq) {
    if (seq <= this.acked) return;
    this.acked = seq;
    const command = this.commands.shift();
    if (command) {
      command.done(true);
      this.held.set(seq, command.ended);
    }
    this.sendCommand();
  }

  refuse(said) {
    if (said.code === "unauthorized") this.rights.begin();  // the rules may have changed
    if (said.what === "hello" && said.code === "unauthorized") {
      this.refused = true;
      this.on.unauthorized(said.why, this.shown);
    } else if (said.what === "hello") {
      return;                                       // it was too slow, or there are too many: it connects again
    } else if (said.what === "publish" && said.topic === this.commands[0]?.topic) {
      this.commands.shift().failed(new Error(said.why));
      this.sendCommand();
    } else this.on.said(said);
  }

  take(message) {
    const stopped = STOP.exec(message.topic);
    if (stopped) this.stops.heard(stopped[1], stopsOf(json(message)?.stops));
    this.clock.heard(message.atMs);
    if (message.noDrop) {
      if (message.seq <= this.received) return;
      this.received = message.seq;
      this.say("ack", {seq: message.seq});
    }
    this.pass(message);
  }

  // Pass it on, once it is known whether it may be old; that a robot was stopped or removed waits for nothing.
  pass(message) {
    if (/\/(stop|claim|last)$/.test(message.topic) || this.isLatched(message.topic) !== undefined || this.early.length >= EARLY) this.on.message(message);
    else this.early.push(message);
  }
}

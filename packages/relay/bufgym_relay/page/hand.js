// Commands by hand: stop, a goal or a pose by drag with its heading, cancel, a policy. Each is offered where a rule allows it and the
// robot takes it, and is done once the robot answers.

import {say, tint} from "./draw.js";
import {Drive} from "./drive.js";
import {FAR_M, number} from "./cdr.js";
import {stamped, still} from "./cdr_write.js";
import {Stops} from "./stops.js";
import {Gamepads} from "./gamepad.js";
import {listen} from "./keys.js";

// Topics of ROS that do the same, below /robots/NAME/to/, for a robot that takes them: each with its type and what it says.
const POSE = "geometry_msgs/msg/PoseStamped", ESTIMATE = "geometry_msgs/msg/PoseWithCovarianceStamped";
const TOPICS = {
  goal: {"goal_pose": POSE, "move_base_simple/goal": POSE}, pose: {"initialpose": ESTIMATE}, stop: {"cmd_vel": "geometry_msgs/msg/Twist"},
};
const ARMED_MS = 4000;                              // the second press that stops all robots comes within so long
const KINDS = ["stop", "goal", "pose", "cancel", "drive"];

export class Hand {
  // asks: {robot(), live(), all(), isReplay(), frame(), nowMs(), removed(name)}; ``live`` is the chosen robot as it is now, ``robot`` as it is shown
  constructor($, relay, map, notices, asks) {
    this.$ = $;
    this.relay = relay;
    this.map = map;
    this.notices = notices;
    this.asks = asks;
    this.sent = null;
    this.all = null;                                // of a stop for all: {count, open: robots -> ids of those that have not confirmed}
    this.armedMs = -Infinity;                       // when the button for all was pressed once
    this.number = 0;
    this.drive = new Drive($, relay);
    $("remove").onclick = () => {
      const {name} = asks.robot();
      relay.command(`/robots/${name}/last`, null).then(() => asks.removed(name), error => notices.refused(name, `remove: ${error.message}`, asks.nowMs()));
    };
    $("stop").onclick = () => {
      this.drive.release();
      this.stop();
    };
    $("release").onclick = () => this.release();
    $("stop-all").onclick = () => this.stopAll();
    $("cancel").onclick = () => this.send("cancel");
    for (const kind of ["goal", "pose"]) $(kind).onclick = () => this.take(map.tool?.kind === kind ? null : kind);
    new Gamepads(this.drive, () => $("stop").click());
    listen($, this.drive, {stop: () => $("stop").click(), escape: () => this.escape()});
    $("policy").onchange = () => this.send("policy", {policy: $("policy").value});
  }

  // What is open or in hand is so no more.
  escape() {
    this.take(null);
    this.drive.open(false);
    const box = this.$("layers-box"), summary = box.firstElementChild;
    if (box.contains(document.activeElement)) summary.focus();
    box.open = false;
  }

  // How the robot takes a command of a kind: its topic, and a type if that is ROS's own; undefined if it does not, or the viewer may not.
  way(robot, kind) {
    const {commands = [], receives = []} = robot.status ?? {}, own = `/robots/${robot.name}/${kind === "drive" ? "drive" : "command"}`, asked = kind === "policy" ? robot.status?.policies.length : commands.includes(kind);
    if (asked && this.relay.mayCommand(own, kind === "stop") && !(kind === "drive" && this.relay.holds(own))) return {topic: own};   // what is held comes late
    for (const [name, type] of Object.entries(TOPICS[kind] ?? {})) {
      const topic = `/robots/${robot.name}/to/${name}`;
      if (receives.some(one => one.replace(/^\//, "") === name) && this.relay.mayCommand(topic, kind === "stop")) return {topic, type};
    }
  }

  take(kind) {
    const robot = this.asks.robot();
    this.map.tool = kind && robot ? {kind, tint: tint(robot.colour), done: at => this.aimed(kind, robot, at)} : null;
    this.map.preview = null;
    this.map.canvas.classList.toggle("aims", this.map.tool !== null);
    for (const each of ["goal", "pose"]) this.$(each).setAttribute("aria-pressed", this.map.tool?.kind === each);
    if (this.map.tool) {
      this.map.canvas.focus({preventScroll: true});
      this.tell(`${robot.name}: press where, drag to where it shall look; or arrows, Enter, arrows, Enter; Escape ends it`, "aim");
    }
    else if (this.statusKind === "aim") this.tell("");
  }

  aimed(kind, robot, at) {
    this.take(null);
    const {x, y, yaw} = Object.fromEntries(Object.entries(at).map(([name, value]) => [name, Number((number(value, FAR_M) ?? 0).toFixed(3))]));
    if (robot === this.asks.robot()) this.send(kind, {x, y, yaw, frame: this.asks.frame() ?? ""});
  }

  tell(text, what = "") {
    this.statusKind = what;
    say(this.$("command-status"), text);
  }

  // A robot that knows stops hears this as soon as it can be reached, before all else, and stands until somebody releases it.
  stop(robot = this.asks.live()) {
    if (!robot || !this.way(robot, "stop")) return;
    if (!robot.status?.commands.includes("release")) return this.send("stop", {}, robot);
    this.take(null);
    const id = this.relay.stop(robot.name);
    this.sent = {id, of: [id], kind: "stop", robot, state: "on its way"};
    this.draw();
  }

  // Live robots that can be stopped; those that are silent, too: a stop is kept for them.
  stoppable() { return this.asks.all().filter(robot => robot.isHere && this.way(robot, "stop") !== undefined); }

  stopAll() {
    const robots = this.stoppable();
    if (performance.now() - this.armedMs > ARMED_MS) this.armedMs = performance.now();
    else {
      this.armedMs = -Infinity;
      this.drive.release();
      const all = this.all = {count: robots.length, open: new Map()};
      for (const robot of robots) {
        this.stop(robot);
        if (this.sent?.robot === robot) all.open.set(robot, this.sent.id);
      }
      this.sent = null;
    }
    this.draw();
  }

  release() {
    this.all = null;
    const robot = this.asks.live();
    if (!robot || !this.relay.stops.held(robot.name).length) return;
    this.sent = {id: "", of: this.relay.release(robot.name), kind: "release", robot, state: "on its way"};
    this.draw();
  }

  async send(kind, fields = {}, robot = this.asks.robot()) {
    const way = robot && this.way(robot, kind);
    if (!way) return;
    const id = `${this.relay.name}-${++this.number}`, sent = this.sent = {id, kind, robot, state: "not sent yet"};
    this.draw();
    const ended = said => {
      if (!said.lost && !(way.type && said.why)) return;  // a robot that refused it says so in its status
      this.notices.refused(robot.name, `${kind}: ${said.why}`, this.asks.nowMs(), () => this.send(kind, fields, robot));
      if (this.sent === sent) this.sent = null;
      this.draw();
    };
    try {
      if (way.type) {
        await this.relay.command(way.topic, kind === "stop" ? still() : stamped(way.type === ESTIMATE, /** @type {any} */ (fields), this.relay.clock.now()), {type: way.type, encoding: "cdr"}, ended);
        sent.state = "sent to its ROS, which does not answer";
      } else {
        await this.relay.command(way.topic, {command: kind, id, ...fields}, undefined, ended);
        if (sent.state === "not sent yet") sent.state = "held by the relay, until the robot answers";
      }
    } catch (error) {
      const isOpen = error.message.startsWith("not ");  // not sent, or not confirmed: nobody knows whether it is wanted still
      this.notices.refused(robot.name, `${kind}: ${error.message}`, this.asks.nowMs(), isOpen ? () => this.send(kind, fields, robot) : null);
      if (this.sent === sent) this.sent = null;
    }
    this.draw();
  }

  // A robot's status: it may answer.
  answered(robot) {
    const {answer: {id, why}, stops, unwritten} = robot.status, {sent} = this;
    this.relay.stops.heard(robot.name, stops, true, !unwritten);
    const one = this.all?.open.get(robot);
    if (one !== undefined && (id === one || Stops.has(stops, one))) this.all?.open.delete(robot);
    if (!sent || sent.doneMs || sent.robot !== robot || !this.isDone(robot)) return;
    if (why && id === sent.id) this.notices.refused(robot.name, `${sent.kind}: ${why}`, this.asks.nowMs());
    sent.state = why && id === sent.id ? "refused" : "done";
    sent.doneMs = performance.now();
    this.draw();
  }

  // Whether the robot's status says that the last command is over.
  isDone(robot) {
    const {answer: {id}, stops} = robot.status, {sent} = this;
    if (sent.kind === "stop" && sent.of) return Stops.has(stops, sent.of[0]);
    if (sent.kind === "release") return sent.of.every(one => Stops.has(stops.filter(stop => !stop.isHeld), one));
    return id === sent.id || (sent.kind === "policy" && robot.queue?.policy === this.$("policy").value);
  }

  // What is offered, and how far the last command is.
  draw() {
    const robot = this.asks.live(), isOff = !robot || this.asks.isReplay(), {isLive} = this.relay, ways = Object.fromEntries(KINDS.map(kind => [kind, !isOff && this.way(robot, kind) !== undefined]));
    const may = robot !== undefined && this.relay.mayCommand(`/robots/${robot.name}/command`), stops = robot !== undefined && this.way(robot, "stop") !== undefined;
    this.$("stop").hidden = !may && !stops;
    this.$("stop").disabled = !stops;
    say(this.$("stop"), stops ? `Stop ${robot.name}` : `${robot?.name ?? ""} takes no stop`);
    const count = this.stoppable().length, isArmed = performance.now() - this.armedMs < ARMED_MS;
    this.$("stop-all").hidden = count < 2;
    this.$("stop-all").setAttribute("aria-pressed", isArmed);
    say(this.$("stop-all"), isArmed ? `Stop all ${count}: press again` : `Stop all ${count}`);
    this.$("release").hidden = !isLive || !robot || !this.relay.stops.held(robot.name).length || !may;
    say(this.$("release"), `Release ${robot?.name ?? ""}`);
    this.$("release").title = robot ? `stopped by ${this.relay.stops.held(robot.name).map(stop => stop.by).join(", ")}` : "";
    for (const kind of ["goal", "pose", "cancel"]) this.$(kind).hidden = !ways[kind] || !isLive;
    this.drive.offer(ways.drive && isLive && !robot.away ? robot : null);
    this.$("remove").hidden = isOff || !robot.away || !this.relay.mayCommand(`/robots/${robot.name}/last`);
    if (this.map.tool && !(ways[this.map.tool.kind] && isLive)) this.take(null);
    if (this.statusKind === "aim") return;
    const {sent, all} = this;
    if (!sent && all) return this.tell(`stop: ${all.count - all.open.size} of ${all.count} robots have confirmed`, "sent");
    this.tell(sent && sent.robot === robot ? `${sent.kind}: ${sent.doneMs ? `${robot.name} answers: ${sent.state}` : this.waits(robot) ?? sent.state}` : "", "sent");
  }

  // Why a stop has not reached its robot yet.
  waits(robot) {
    if (this.sent.kind === "stop" && this.relay.stops.ids(robot.name).length && (robot.away || !this.relay.isLive))
      return `kept: ${robot.name} stops as soon as it can be reached`;
  }

  // A stop that anybody said: keys that are held count no more.
  stopped(robot) { if (robot === this.drive.robot) this.drive.release(); }

  offerPolicies() {
    const robot = this.asks.robot(), policies = robot?.status?.policies ?? [], now = robot?.queue?.policy ?? "", select = this.$("policy");
    const may = robot && !this.asks.isReplay() && this.way(robot, "policy") !== undefined;
    select.parentNode.hidden = !policies.length && !now;
    select.disabled = !may;
    select.title = may ? "" : "You may only watch";
    const offered = [...new Set([...policies, now])].filter(Boolean).join();
    if (select.dataset.offered !== offered) {
      select.dataset.offered = offered;
      select.replaceChildren(...offered.split(",").map(policy => new Option(policy, policy)));
    }
    if (!(this.sent?.kind === "policy" && !this.sent.doneMs) && document.activeElement !== select) select.value = now;
  }
}

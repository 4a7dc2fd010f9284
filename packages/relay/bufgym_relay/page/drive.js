// Driving by hand: a pad and keys, to be held. Each message has a deadline. So the robot stops where none comes in time, and where this page
// is left.

import {say} from "./draw.js";

const PERIOD_MS = 100, FOR_MS = 400, TURN = 2;      // rad/s at the pad's edge for each m/s there
const AHEAD = [1, 0], BACK = [-1, 0], LEFT = [0, 1], RIGHT = [0, -1];
const KEYS = {ArrowUp: AHEAD, KeyW: AHEAD, ArrowDown: BACK, KeyS: BACK, ArrowLeft: LEFT, KeyA: LEFT, ArrowRight: RIGHT, KeyD: RIGHT};  // by event.code
const within = value => Math.min(1, Math.max(-1, value));

export class Drive {
  constructor($, relay) {
    this.$ = $;
    this.relay = relay;
    this.robot = null;                              // who may be driven
    this.keys = new Set();
    this.pointer = null;                            // [ahead, left] of the pad's middle, from -1 to 1
    this.stick = null;                              // the same, of a gamepad
    this.timer = 0;
    this.isHeard = true;                            // whether the last velocity went
    const pad = this.pad = $("pad");
    $("drive").onclick = () => this.open($("driving").hidden);
    const aim = event => {
      const {left, top, width, height} = pad.getBoundingClientRect();
      this.pointer = [within(1 - 2 * (event.clientY - top) / height), within(1 - 2 * (event.clientX - left) / width)];
      this.hold();
    };
    pad.onpointerdown = event => {
      pad.setPointerCapture(event.pointerId);
      pad.focus();
      aim(event);
    };
    pad.onpointermove = event => { if (this.pointer) aim(event); };
    pad.onpointerup = pad.onpointercancel = pad.onlostpointercapture = () => {
      this.pointer = null;
      this.hold();
    };
    pad.onblur = () => this.release();
    addEventListener("blur", () => this.release());
    addEventListener("pagehide", () => this.release());
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.release(); });
  }

  get topic() { return `/robots/${this.robot.name}/drive`; }

  // The robot that may be driven now, or null; another one ends it. A stop takes the keys out of the hand: they count when they are pressed anew.
  offer(robot) {
    if (robot !== this.robot) {
      this.open(false);
      this.robot = robot;
    }
    this.$("drive").hidden = robot === null;
    const stop = robot?.status?.stop;
    if (stop) this.release();
    const driver = robot?.status?.driver ?? "";
    say(this.$("driver"), stop ? `stopped by ${stop.by}: release it first` : driver && driver !== this.relay.name ? "somebody else drives it" : !this.isHeard ? "the link does not keep up: nothing is sent" : "hold, or arrows");
  }

  open(isOpen) {
    this.release();
    this.$("driving").hidden = !isOpen;
    this.$("drive").setAttribute("aria-pressed", isOpen);
    if (isOpen) this.pad.focus();
  }

  get isOpen() { return this.robot !== null && !this.$("driving").hidden; }

  // A key is down; whether it drives. One that was held before it could drive is to be pressed anew.
  press(code, isRepeat) {
    if (!this.isOpen || !(code in KEYS)) return false;
    if (isRepeat) return true;
    this.keys.add(code);
    this.hold();
    return true;
  }

  lift(code) { if (this.keys.delete(code)) this.hold(); }

  // A gamepad's stick, or null where none drives any more.
  tilt(stick) {
    if (!stick && !this.stick) return;
    this.stick = stick;
    this.hold();
  }

  // What is held has changed.
  hold() {
    if (!this.pointer && !this.stick && !this.keys.size) return this.release();
    if (!this.robot || this.timer) return;
    if (this.robot.status?.stop) return;
    this.timer = setInterval(() => this.send(), PERIOD_MS);
    this.still();                                   // after a stop, a robot moves only for who says zeros first; a queue may keep the newest alone
  }

  send() {
    const sum = [0, 0];
    for (const [ahead, left] of this.pointer ? [this.pointer] : this.stick ? [this.stick] : [...this.keys].map(key => KEYS[key])) {
      sum[0] += ahead;
      sum[1] += left;
    }
    const most = Number(this.$("speed-most").value), [ahead, left] = sum.map(within);
    this.isHeard = this.relay.sayNow(this.topic, {linear: most * ahead, angular: most * TURN * left, for_ms: FOR_MS}, false, FOR_MS);
  }

  release() {
    this.keys.clear();
    this.pointer = this.stick = null;
    this.isHeard = true;
    if (!this.timer) return;
    clearInterval(this.timer);
    this.timer = 0;
    this.still();
  }

  still() { this.relay.sayNow(this.topic, {linear: 0, angular: 0, for_ms: 0}, true, FOR_MS); }
}

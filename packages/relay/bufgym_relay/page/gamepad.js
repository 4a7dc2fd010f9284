// Driving by a gamepad: the left stick drives while the left shoulder button is held, and letting go of it ends it at once. B or Back stops.

const PERIOD_MS = 40, DEAD = 0.1, HELD = 4, STOPS = [1, 8];  // buttons of the standard mapping

const past = value => Math.abs(value) < DEAD ? 0 : Math.sign(value) * Math.min(1, (Math.abs(value) - DEAD) / (1 - DEAD));

export class Gamepads {
  constructor(drive, stop) {
    this.drive = drive;
    this.stop = stop;
    this.timer = 0;
    this.mayHold = false;                           // the shoulder button was up since anything else ended the drive
    this.isHolding = false;                         // it was held, and drove, when they were looked at last
    this.stops = false;                             // a stop button is down
    addEventListener("gamepadconnected", () => this.look());
    addEventListener("gamepaddisconnected", () => this.look());
    this.look();
  }

  all() { return [...navigator.getGamepads?.() ?? []].filter(pad => pad?.connected && pad.mapping === "standard"); }

  // Look at them as long as there is one.
  look() {
    const pads = this.all();
    if (!pads.length) {
      clearInterval(this.timer);
      this.timer = 0;
      this.mayHold = this.stops = false;
    } else this.timer ||= setInterval(() => this.look(), PERIOD_MS);
    this.take(pads);
  }

  take(pads) {
    const stops = pads.some(pad => STOPS.some(button => pad.buttons[button]?.pressed)), isNew = stops && !this.stops, {drive} = this;
    this.stops = stops;
    if (isNew) this.stop();
    const held = pads.find(pad => pad.buttons[HELD]?.pressed);
    if (!held) {
      this.mayHold = pads.length > 0;
      this.isHolding = false;
      return drive.tilt(null);
    }
    if (this.isHolding && !drive.stick) this.mayHold = false;  // a stop, or the page was left: it is to be pressed anew
    if (!this.mayHold || stops || !document.hasFocus()) drive.tilt(null);
    else if (drive.robot) {
      if (!drive.isOpen) drive.open(true);
      drive.tilt([past(-held.axes[1]), past(-held.axes[0])]);
    }
    this.isHolding = drive.stick !== null;
    if (!this.isHolding) this.mayHold = false;
  }
}

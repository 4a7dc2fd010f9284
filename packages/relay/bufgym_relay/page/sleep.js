// Whether this computer slept: no timer ran, and its monotonic clock may have stood still, by which all deadlines are counted.

const STOOD_MS = 1000, LATE_MS = 3000;

export class Sleep {
  // It is asked each ``everyMs``.
  constructor(everyMs) {
    this.everyMs = everyMs;
    this.look();
    document.addEventListener("visibilitychange", () => { this.wasHidden ||= document.hidden; });
  }

  look() {
    this.wallMs = Date.now();
    this.ms = performance.now();
    this.wasHidden = document.hidden;
  }

  // How long it slept since it was asked last, ms; 0 if it did not. The timers of a hidden page come late without a sleep.
  slept() {
    const {wallMs, ms, wasHidden, everyMs} = this;
    this.look();
    const byDate = this.wallMs - wallMs, byClock = this.ms - ms, stood = byDate - byClock, isLate = !wasHidden && Math.min(byDate, byClock) > everyMs + LATE_MS;
    return stood > STOOD_MS ? stood : isLate ? byDate - everyMs : 0;
  }
}

// The relay's time, in ms since 1970 by the relay's clock. The browser only counts what passes between two messages: what its date says is of
// no account. Each message tells when the relay took it, so the clock is at least that far.

const DRIFT = 5e-4;                                 // most that two clocks drift apart, ms for each ms

export class Clock {
  constructor() {
    this.aheadMs = null;
    this.setMs = 0;
    this.stampsAheadMs = -Infinity;
  }

  // Another connection: the relay may be another.
  begin(relayMs) {
    this.aheadMs = null;
    this.heard(relayMs);
  }

  heard(relayMs) {
    if (!(relayMs > 0)) return;
    const ms = performance.now(), ahead = relayMs - ms;
    this.aheadMs = this.aheadMs === null ? ahead : Math.max(ahead, this.aheadMs - DRIFT * (ms - this.setMs));
    this.setMs = ms;
  }

  // For stamps, from which a robot counts: they never go back, not with another connection, and after a sleep they are right again.
  stamp() {
    this.stampsAheadMs = Math.max(this.stampsAheadMs, this.aheadMs ?? 0);
    return performance.now() + this.stampsAheadMs;
  }

  now() { return performance.now() + (this.aheadMs ?? 0); }
}

// When a robot made its messages, by the relay's clock. A robot's own clock may be wrong, and may jump: how late a message is shows beside the
// promptest of the last ones.
const WINDOW_MS = 15_000, AHEAD_MS = 1000, LATE_MS = 60_000;

export class Stamps {
  constructor() {
    this.skews = [Infinity, Infinity];              // least delay, in the window before and in this one
    this.sinceMs = -Infinity;
    this.jump = null;                               // the last: when, and by how much; ms
  }

  // A message with this stamp that the relay took at ``atMs``.
  made(stampMs, atMs) {
    const skew = atMs - stampMs, known = Math.min(...this.skews);
    if (!Number.isFinite(skew)) return atMs;
    if (known !== Infinity && (skew < known - AHEAD_MS || skew > known + LATE_MS)) {
      this.jump = {ms: atMs, byMs: known - skew};
      this.skews = [Infinity, skew];
      this.sinceMs = atMs;
      return atMs;
    }
    if (atMs - this.sinceMs > WINDOW_MS) {
      this.skews = [this.skews[1], Infinity];
      this.sinceMs = atMs;
    }
    this.skews[1] = Math.min(this.skews[1], skew);
    return atMs - (skew - Math.min(...this.skews));
  }
}

// A recording, played: asks the relay for it piece by piece, and hands its messages on at their times.

import {fromJson} from "./messages.js";

const AHEAD_MS = 3000, BEFORE_MS = 2000, PIECE_BYTES = 1_000_000;

export class Replay {
  constructor(relay, file, onMessage, onJump) {
    this.relay = relay;
    this.file = file;
    this.onMessage = onMessage;
    this.onJump = onJump;
    this.speed = 1;
    this.playing = true;
    this.number = 0;
    this.firstMs = this.lastMs = null;
    this.seek(0);
  }

  seek(ms) {
    this.id = "replay-" + ++this.number;            // answers to what was asked before are let pass
    this.messages = [];
    this.nowMs = ms;
    this.nextUs = Math.round(Math.max(0, ms - BEFORE_MS) * 1000);  // what was said last holds, paused or not
    this.asking = false;
    this.frameMs = null;
    this.onJump();
    this.ask();
  }

  ask() {
    if (this.asking || this.nextUs === null) return;
    this.asking = true;
    this.relay.say("replay", {id: this.id, file: this.file, from_us: this.nextUs, most_bytes: PIECE_BYTES});
  }

  // An answer of the relay's.
  take(said) {
    if (said.id !== this.id) return;
    this.asking = false;
    [this.firstMs, this.lastMs, this.nextUs] = [said.first_us / 1000, said.last_us / 1000, said.next_us];
    this.nowMs = Math.max(this.nowMs, this.firstMs);
    for (const message of said.messages) this.messages.push(fromJson(message));
  }

  // Once for each frame of the screen.
  frame(clockMs) {
    const passed = this.frameMs === null || !this.playing ? 0 : clockMs - this.frameMs;
    this.frameMs = clockMs;
    if (this.firstMs === null) return;
    const known = this.nextUs === null ? this.lastMs : this.messages.at(-1)?.stampMs ?? this.nowMs;
    this.nowMs = Math.min(this.nowMs + passed * this.speed, Math.max(known, this.nowMs));
    let due = 0;
    while (due < this.messages.length && this.messages[due].stampMs <= this.nowMs) this.onMessage(this.messages[due++]);
    this.messages.splice(0, due);
    if (!this.messages.length || this.messages.at(-1).stampMs < this.nowMs + AHEAD_MS * this.speed) this.ask();
  }
}

// Recordings: which there are, and one played with pause, seek and speed.

import {clock} from "./draw.js";
import {Replay} from "./replay.js";

const STEPS_S = {ArrowLeft: -5, ArrowDown: -5, ArrowRight: 5, ArrowUp: 5, PageDown: -60, PageUp: 60};

export class Player {
  // on: {message(message), begin(), jump(), end()}
  constructor($, relay, on) {
    this.$ = $;
    this.relay = relay;
    this.on = on;
    this.replay = null;
    this.isDragged = false;                         // the slider: it shows where it would go
    $("recordings").onclick = () => relay.say("recordings", {});
    $("live").onclick = () => this.end();
    $("play").onclick = () => {
      this.replay.playing = !this.replay.playing;
      $("play").textContent = this.replay.playing ? "Pause" : "Play";
    };
    $("speed").onchange = () => { this.replay.speed = Number($("speed").value); };
    $("back").onclick = () => this.step(-10);
    $("ahead").onclick = () => this.step(10);
    $("when").oninput = () => {
      this.isDragged = true;
      this.say();
    };
    $("when").onchange = () => {
      this.isDragged = false;
      this.seek(Number($("when").value));
    };
    $("when").onkeydown = event => {
      if (!STEPS_S[event.key]) return;
      event.preventDefault();
      this.step(STEPS_S[event.key]);
    };
  }

  get nowMs() { return this.replay.nowMs; }

  list(files) {
    const {$} = this;
    $("files").querySelector("ul").replaceChildren(...files.map(file => {
      const item = document.createElement("li"), button = item.appendChild(Object.assign(document.createElement("button"), {type: "button"}));
      button.textContent = `${file.name}, ${(file.bytes / 1e6).toFixed(1)} MB, ${new Date(file.modified_us / 1000).toLocaleString()}`;
      button.onclick = () => { $("files").close(); this.play(file.name); };
      return item;
    }), ...(files.length ? [] : [Object.assign(document.createElement("li"), {textContent: "This relay has none."})]));
    $("files").showModal();
  }

  play(file) {
    this.on.begin();
    this.replay = new Replay(this.relay, file, this.on.message, this.on.jump);
    this.$("player").hidden = false;
    this.$("play").textContent = "Pause";
    this.$("speed").value = "1";
  }

  end() {
    this.replay = null;
    this.$("player").hidden = true;
    this.on.end();
  }

  step(s) { this.seek((this.nowMs - this.replay.firstMs) / 1000 + s); }

  // ``s`` counts from the recording's begin.
  seek(s) {
    const {firstMs, lastMs} = this.replay;
    if (firstMs !== null) this.replay.seek(Math.min(lastMs, Math.max(firstMs, firstMs + 1000 * s)));
    this.say();
  }

  say() {
    const {firstMs, lastMs, nowMs} = this.replay, when = this.$("when"), longS = (lastMs - firstMs) / 1000;
    if (firstMs === null) return;
    when.max = longS;
    if (!this.isDragged) when.value = (nowMs - firstMs) / 1000;
    when.ariaValueText = this.$("clock").textContent = `${clock(Number(when.value))} of ${clock(longS)}`;
  }
}

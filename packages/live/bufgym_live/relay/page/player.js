// Recordings: which there are, and one played with pause, seek and speed.

import {seconds} from "./draw.js";
import {Replay} from "./replay.js";

export class Player {
  // on: {message(message), begin(), jump(), end()}
  constructor($, relay, on) {
    this.$ = $;
    this.relay = relay;
    this.on = on;
    this.replay = null;
    $("recordings").onclick = () => relay.say("recordings", {});
    $("live").onclick = () => this.end();
    $("play").onclick = () => {
      this.replay.playing = !this.replay.playing;
      $("play").textContent = this.replay.playing ? "Pause" : "Play";
    };
    $("speed").onchange = () => { this.replay.speed = Number($("speed").value); };
    $("when").oninput = () => this.replay.seek(this.replay.firstMs + $("when").value / 1000 * (this.replay.lastMs - this.replay.firstMs));
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

  say() {
    const {firstMs, lastMs, nowMs} = this.replay, {$} = this;
    if (firstMs === null) return;
    if (document.activeElement !== $("when")) $("when").value = 1000 * (nowMs - firstMs) / Math.max(1, lastMs - firstMs);
    $("clock").textContent = `${seconds((nowMs - firstMs) / 1000)} of ${seconds((lastMs - firstMs) / 1000)}`;
  }
}

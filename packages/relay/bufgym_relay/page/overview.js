// The tab that shows how the chosen robot is: its laser, its queue, its last minute and its topics in numbers.

import {aged, bits, drawHistory, drawScan, drawSlots, hue, percent, say, seconds, tint} from "./draw.js";
import {battery, doing} from "./fleet.js";

export class Overview {
  constructor($) { this.$ = $; }

  // Each frame of the screen: what has changed.
  draw(robot) {
    if (robot.scanChanged) drawScan(this.$("scan"), robot.scan, tint(robot.colour));
    if (robot.queueChanged) drawSlots(this.$("slots"), robot.queue);
    robot.scanChanged = robot.queueChanged = false;
  }

  drawHistory(robot, nowMs) { drawHistory(this.$("history"), robot.history, nowMs); }

  facts(robot, nowMs) {
    const {x, y, frame} = robot.pose ?? {}, {status} = robot, rtt = status?.network?.rtt_ms, charged = battery(robot), oldMs = nowMs - robot.poseMs;
    say(this.$("doing"), doing(robot, nowMs));
    say(this.$("facts"), [x === undefined ? "" : `at ${x.toFixed(1)}, ${y.toFixed(1)} m${frame && " in " + frame}${oldMs > 3000 ? `, ${seconds(oldMs / 1000)} ago` : ""}`,
      rtt == null ? "" : `answers in ${Math.round(rtt)} ms`, charged == null ? "" : `battery ${percent(charged)}`, status?.recording ?? ""].filter(Boolean).join(" · "));
  }

  say(robot, nowMs) {
    const {$} = this, {queue} = robot, agoS = Math.max(0, nowMs - (robot.saidMs ?? nowMs)) / 1000;
    say($("scan-says"), robot.scan ? `laser, ${seconds((nowMs - robot.scanMs) / 1000)} old` : "no laser");
    aged($("laser"), robot.scan ? nowMs - robot.scanMs : 0);
    $("queue").hidden = !queue;
    if (!queue) return;
    say($("rate"), bits(queue.rate_bps ?? 0));
    say($("qoi"), percent(queue.qoi));
    say($("queued"), `${queue.queued} of ${queue.capacity}`);
    say($("dropped"), queue.put ? `${queue.dropped} (${percent(queue.dropped / queue.put)})` : "0");
    const names = Object.keys(queue.topics ?? {});
    while ($("topics").rows.length > names.length) $("topics").deleteRow(-1);
    names.forEach((name, k) => {
      const topic = queue.topics[name], row = $("topics").rows[k] ?? $("topics").insertRow();
      if (row.cells.length === 0) for (let c = 0; c < 5; c++) row.insertCell();
      if (row.dataset.name !== name) {
        row.dataset.name = name;
        row.cells[0].innerHTML = "<i></i><span></span>";
        row.cells[0].firstChild.style.background = hue(k * 2 + 1);
        row.cells[0].lastChild.textContent = row.cells[0].title = name;
      }
      const texts = [topic.age_s == null ? "–" : seconds(topic.age_s + agoS), topic.left, topic.dropped, percent(topic.qoi)];
      texts.forEach((text, c) => { say(row.cells[c + 1], text ?? ""); });
    });
  }
}

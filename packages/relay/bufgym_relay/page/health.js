// The tab that says what is wrong: the robot's own words, its troubles, and its diagnostics by level.

import {percent, say, seconds} from "./draw.js";
import {battery} from "./fleet.js";

const LEVELS = ["fine", "warning", "error", "stale"], WORST = [3, 1, 0, 2], OLD_MS = 5000;

// Rows of a table, kept and filled anew: cells of text, and a level.
function fill(body, rows) {
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach(({level, cells, title}, k) => {
    const row = body.rows[k] ?? body.insertRow();
    while (row.cells.length < cells.length) row.insertCell();
    row.dataset.level = level;
    if (row.title !== title) row.title = title;
    cells.forEach((text, c) => say(row.cells[c], text));
  });
}

export class Health {
  constructor($) { this.$ = $; }

  draw(robot, nowMs) {
    const {$} = this, {ok, text} = robot.status ?? {}, charged = battery(robot);
    $("verdict").dataset.level = robot.troubles[0]?.level ?? (ok ? "ok" : "");
    say($("verdict-says"), robot.troubles[0] ? robot.troubles[0].text : ok ? "OK" : "Nothing wrong is known");
    say($("status-text"), [text, charged == null ? "" : `battery ${percent(charged)}`, `last heard ${seconds((nowMs - robot.heardMs) / 1000)} ago`].filter(Boolean).join(" · "));
    fill($("wrong"), robot.troubles.slice(1).map(one => ({level: one.level, title: "", cells: [one.kind, one.text]})));
    const parts = [...robot.parts.values()].sort((one, other) => WORST[one.level] - WORST[other.level] || one.name.localeCompare(other.name));
    fill($("parts"), parts.map(part => ({
      level: ["ok", "warn", "error", "warn"][part.level] ?? "warn",
      title: part.values.map(([key, value]) => `${key}: ${value}`).join("\n"),
      cells: [LEVELS[part.level] ?? String(part.level), part.name, part.says + (nowMs - part.ms > OLD_MS ? `, ${seconds((nowMs - part.ms) / 1000)} old` : "")],
    })));
    say($("no-parts"), parts.length ? "" : "This robot sends no diagnostic_msgs/DiagnosticArray.");
  }
}

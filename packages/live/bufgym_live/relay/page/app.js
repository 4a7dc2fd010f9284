// The page: which robots there are, and what the chosen one senses and sends. Messages only change the state;
// everything is drawn once for each frame of the screen.

import {bits, drawHistory, drawPicture, drawScan, drawSlots, hue, percent, seconds, whenColoursChange} from "./draw.js";
import {Place} from "./frames.js";
import {Map2D} from "./map.js";
import {json, kindOf, picture, queue, scan, status} from "./messages.js";
import {Relay} from "./relay.js";
import {Replay} from "./replay.js";

const HISTORY_MS = 60_000, TRAIL_GAP_MS = 300, AWAY_MS = 5000, TEXT_MS = 250;
const USUAL_POSES = ["odom", "odometry", "localization", "tf", "tf_static"];   // asked for before a robot's status, which comes once a second, names its own
const POSES = 100, NEAR_MS = 20, GAP_MS = 400;
const ROBOT = /^\/robots\/([^/]+)\/(.+)$/;

const $ = id => document.getElementById(id);
const say = (element, text) => { if (element.textContent !== String(text)) element.textContent = text; };
const escaped = text => text.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");

const robots = new Map();
let chosen = null, replay = null, textMs = -Infinity, texts = false, wanted = "";

const map = new Map2D($("map"), choose);
const relay = new Relay({
  state(text, isOn) {
    $("state").textContent = replay ? "replay" : text;
    $("state").className = "state" + (replay ? " replay" : isOn ? " on" : "");
  },
  welcome() { offerPolicies(); },
  message(message) { if (!replay) tried(message); },
  said(said) {
    if (said.op === "recordings") listFiles(said.files);
    else if (said.op === "replayed") replay?.take(said);
    else if (said.op === "refused" && said.what === "replay") $("told").textContent = said.why;
  },
  unauthorized(why) {
    $("why").textContent = why;
    $("ask").showModal();
  },
});
function begin() {
  relay.subscribe("status", "^/robots/[^/]+/status$");
  relay.subscribe("relay", "^/relay/status$");
  subscribe();
}
begin();

const nowMs = () => replay ? replay.nowMs : Date.now();

// --- what comes ------------------------------------------------------------------------------------------------------

function robotOf(name) {
  if (!robots.has(name)) {
    const robot = {name, number: robots.size, trail: [], poses: [], history: [], kinds: {}, skewMs: Infinity, heardMs: 0, frames: [], place: new Place(name)};
    robot.tint = hue(robot.number);
    robots.set(name, robot);
    addCard(robot);
    if (chosen === null) choose(name);
  }
  return robots.get(name);
}

// A message that is not what it says it is changes nothing.
function tried(message) {
  try {
    take(message);
  } catch {
    return;
  }
}

function take(message) {
  if (message.topic === "/relay/status") return sayRelay(json(message));
  const [, name, topic] = ROBOT.exec(message.topic) ?? [];
  if (!name) return;
  const robot = robotOf(name);
  robot.heardMs = nowMs();
  // A robot's clock may be wrong; how late a message is shows beside the promptest of them.
  robot.skewMs = Math.min(robot.skewMs, nowMs() - message.stampMs);
  if (topic === "status") return takeStatus(robot, status(json(message)), message.stampMs + robot.skewMs);
  if (topic === "queue") return takeQueue(robot, queue(json(message)), message.stampMs + robot.skewMs);
  robot.kinds[topic] ??= kindOf(topic, message);
  const kind = robot.kinds[topic], ms = message.stampMs + robot.skewMs;
  if (kind === "pose" || kind === "tf") takePose(robot, robot.place.take(topic, kind, message, ms), ms);
  else if (robot.kinds[topic] === "scan" && name === chosen) {
    robot.scan = scan(message);
    robot.scanMs = message.stampMs + robot.skewMs;
    robot.scanChanged = true;
    const then = poseAt(robot, robot.scanMs);
    if (then) map.addScan(then, robot.scan);
  } else if (robot.kinds[topic] === "picture" && name === chosen) {
    robot.coming = message;                         // only the latest is decoded
    robot.frames.push(nowMs());
  }
}

function takeStatus(robot, status, ms) {
  robot.status = status;
  for (const [topic, what] of Object.entries(status.publishes ?? {})) robot.kinds[topic] ??= kindOf(topic, what);
  takePose(robot, robot.place.takeStatus(status.location, ms), ms);
  if (status.queue && !(robot.queueMs > ms - 3000)) takeQueue(robot, status.queue, ms, false);
  subscribe();
  if (robot.name === chosen) offerPolicies();
}

function takeQueue(robot, queue, ms, own = true) {
  robot.queue = queue;
  robot.saidMs = ms;
  if (own) robot.queueMs = ms;
  robot.history.push({ms, queued: queue.queued, capacity: queue.capacity, rate: queue.rate_bps ?? 0, dropped: queue.dropped, drops: 0});
  robot.history.sort((one, other) => one.ms - other.ms);
  while (robot.history[0].ms < ms - HISTORY_MS - 1000) robot.history.shift();
  for (let k = 1; k < robot.history.length; k++) {
    const [before, entry] = [robot.history[k - 1], robot.history[k]];
    entry.drops = Math.max(0, entry.dropped - before.dropped) / Math.max(0.1, (entry.ms - before.ms) / 1000);
  }
  robot.queueChanged = true;
}

function takePose(robot, at, ms) {
  if (!at || robot.poseMs > ms) return;
  if (robot.pose && robot.pose.frame !== at.frame) {  // what was drawn lies in another frame
    robot.trail = [];
    robot.poses = [];
    if (robot.name === chosen) map.forget();
  }
  robot.pose = at;
  robot.poseMs = ms;
  robot.poses.push({...at, ms});
  if (robot.poses.length > POSES) robot.poses.shift();
  if (!robot.trail.length || ms - robot.trail.at(-1).ms >= TRAIL_GAP_MS) robot.trail.push({x: at.x, y: at.y, ms});
  map.changed = true;
}

// Where a robot was: between two poses, or right at one.
function poseAt(robot, ms) {
  const k = robot.poses.findIndex(at => at.ms >= ms), after = robot.poses[k], before = robot.poses[k - 1];
  const near = [before, after, robot.poses.at(-1)].find(at => at && Math.abs(at.ms - ms) < NEAR_MS);
  if (!before || !after || after.ms - before.ms > GAP_MS) return near;
  const part = (ms - before.ms) / Math.max(1, after.ms - before.ms), turn = Math.atan2(Math.sin(after.yaw - before.yaw), Math.cos(after.yaw - before.yaw));
  return {x: before.x + part * (after.x - before.x), y: before.y + part * (after.y - before.y), yaw: before.yaw + part * turn};
}

// Of all robots where they are, of the chosen one all that is drawn.
function subscribe() {
  if (replay) return;                               // what is drawn now comes from the file
  const poses = new Set(USUAL_POSES);
  for (const robot of robots.values()) for (const [topic, kind] of Object.entries(robot.kinds)) if (kind === "pose" || kind === "tf") poses.add(topic);
  relay.subscribe("poses", `^/robots/[^/]+/(${[...poses].sort().map(escaped).join("|")})$`);
  const robot = robots.get(chosen);
  if (!robot) return;
  const first = kind => Object.keys(robot.kinds).find(topic => robot.kinds[topic] === kind);
  const topics = ["queue", first("picture"), first("scan")].filter(Boolean);
  relay.subscribe("chosen", `^/robots/${escaped(chosen)}/(${topics.map(escaped).join("|")})$`);
}

// --- the list, and the chosen robot ----------------------------------------------------------------------------------

function addCard(robot) {
  $("nobody")?.remove();
  const card = Object.assign(document.createElement("button"), {type: "button", className: "card"});
  card.innerHTML = `<b><i class="dot"></i><span></span></b><span class="soft"><span class="says"></span><span class="charge"></span></span><span class="bar" hidden><i></i></span>`;
  card.style.setProperty("--robot", robot.tint);
  card.querySelector("b span").textContent = robot.name;
  card.onclick = () => choose(robot.name);
  robot.card = card;
  const after = [...robots.values()].filter(other => other.card?.isConnected && other.name.localeCompare(robot.name, undefined, {numeric: true}) > 0)
    .sort((one, other) => one.name.localeCompare(other.name, undefined, {numeric: true}))[0];
  $("robots").insertBefore(card, after?.card ?? null);
}

function choose(name) {
  chosen = name;
  const robot = robots.get(name);
  for (const other of robots.values()) other.card.setAttribute("aria-pressed", other === robot);
  $("robot").hidden = false;
  $("name").textContent = name;
  $("robot").style.setProperty("--robot", robot.tint);
  $("told").textContent = "";
  robot.scanChanged = robot.queueChanged = robot.pictureChanged = true;
  textMs = -Infinity;
  wanted = "";
  map.forget();
  subscribe();
  offerPolicies();
}

function offerPolicies() {
  const robot = robots.get(chosen), policies = robot?.status?.policies ?? [], now = robot?.queue?.policy ?? "";
  const may = !replay && relay.mayCommand(`/robots/${chosen}/command`) && policies.length > 0;
  $("policy").disabled = !may;
  $("policy").title = may ? "" : "You may only watch";
  const offered = [...new Set([...policies, now])].filter(Boolean).join();
  if ($("policy").dataset.offered !== offered) {
    $("policy").dataset.offered = offered;
    $("policy").replaceChildren(...offered.split(",").map(policy => new Option(policy, policy)));
  }
  if (wanted === now) [wanted, $("told").textContent] = ["", ""];
  if (!wanted && document.activeElement !== $("policy")) $("policy").value = now;
}

$("policy").onchange = async () => {
  wanted = $("policy").value;
  $("told").textContent = "sent, until the robot answers";
  try {
    await relay.command(`/robots/${chosen}/command`, {command: "policy", policy: wanted});
  } catch (error) {
    $("told").textContent = "refused: " + error.message;
    wanted = "";
  }
  $("policy").blur();
};

function sayRelay(status) {
  const alone = (status.nats ?? "connected") === "connected" ? "" : `, without other relays: ${status.nats}`;
  $("relay").textContent = `${status.connections} connected, ${status.dropped} dropped here${alone}`;
}

function sayRobots() {
  for (const robot of robots.values()) {
    const silentMs = nowMs() - robot.heardMs, {battery} = robot.status ?? {};
    robot.away = silentMs > AWAY_MS;
    robot.card.classList.toggle("away", robot.away);
    say(robot.card.querySelector(".says"), robot.away ? `silent for ${seconds(silentMs / 1000)}` : bits(robot.queue?.rate_bps ?? 0));
    say(robot.card.querySelector(".charge"), battery == null ? "" : percent(battery));
    const bar = robot.card.querySelector(".bar");
    bar.hidden = battery == null;
    bar.classList.toggle("low", battery < 0.25);
    bar.firstChild.style.width = percent(battery ?? 0).replace(" ", "");
  }
}

// A map has one frame: the chosen robot's. A place without a frame is shown on each.
function shown() {
  const all = [...robots.values()], frame = robots.get(chosen)?.pose?.frame || all.find(robot => robot.pose?.frame)?.pose.frame;
  const here = all.filter(robot => !robot.pose?.frame || robot.pose.frame === frame), away = all.length - here.length;
  say($("frame"), [frame && `in ${frame}`, away && `${away} in other frames`].filter(Boolean).join(", "));
  return here;
}

function sayChosen(robot) {
  const {queue, status} = robot, agoS = Math.max(0, nowMs() - (robot.saidMs ?? nowMs())) / 1000;
  const {x, y, frame} = robot.pose ?? {}, rtt = status?.network?.rtt_ms;
  say($("facts"), [x === undefined ? "" : `at ${x.toFixed(1)}, ${y.toFixed(1)} m${frame && " in " + frame}`, rtt == null ? "" : `answers in ${Math.round(rtt)} ms`,
    status?.battery == null ? "" : `battery ${percent(status.battery)}`, status?.recording ?? ""].filter(Boolean).join(" · "));
  say($("scan-says"), robot.scan ? `laser, ${seconds((nowMs() - robot.scanMs) / 1000)} old` : "no laser");
  while (robot.frames.length && robot.frames[0] < nowMs() - 2000) robot.frames.shift();
  say($("camera-says"), robot.bitmap ? `camera, ${(robot.frames.length / 2).toFixed(1)} a second, ${seconds((nowMs() - robot.pictureMs) / 1000)} old` : "no picture");
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

// --- replay ----------------------------------------------------------------------------------------------------------

$("recordings").onclick = () => relay.say("recordings", {});

function listFiles(files) {
  $("files").querySelector("ul").replaceChildren(...files.map(file => {
    const item = document.createElement("li"), button = item.appendChild(Object.assign(document.createElement("button"), {type: "button"}));
    button.textContent = `${file.name}, ${(file.bytes / 1e6).toFixed(1)} MB, ${new Date(file.modified_us / 1000).toLocaleString()}`;
    button.onclick = () => { $("files").close(); play(file.name); };
    return item;
  }), ...(files.length ? [] : [Object.assign(document.createElement("li"), {textContent: "This relay has none."})]));
  $("files").showModal();
}

function forget() {
  for (const robot of robots.values()) robot.card.remove();
  robots.clear();
  chosen = null;
  $("robot").hidden = true;
  map.forget();
  map.fitted = false;
}

function play(file) {
  forget();
  for (const id of ["status", "poses", "chosen"]) relay.unsubscribe(id);
  replay = new Replay(relay, file, tried, () => {
    for (const robot of robots.values()) {
      Object.assign(robot, {trail: [], poses: [], history: [], skewMs: Infinity, poseMs: 0, queueMs: 0});
      robot.place.forget();
    }
    map.forget();
  });
  $("player").hidden = false;
  $("state").textContent = "replay";
  $("state").className = "state replay";
}

$("live").onclick = () => {
  replay = null;
  $("player").hidden = true;
  forget();
  begin();
  relay.on.state(relay.welcome ? "live" : "not connected", relay.welcome !== null);
};
$("play").onclick = () => {
  replay.playing = !replay.playing;
  $("play").textContent = replay.playing ? "Pause" : "Play";
};
$("speed").onchange = () => { replay.speed = Number($("speed").value); };
$("when").oninput = () => replay.seek(replay.firstMs + $("when").value / 1000 * (replay.lastMs - replay.firstMs));
$("fit").onclick = () => { map.follow = true; map.fitted = false; };
$("ask").onclose = () => relay.authorize($("token").value);

function sayReplay() {
  if (replay.firstMs === null) return;
  if (document.activeElement !== $("when")) $("when").value = 1000 * (replay.nowMs - replay.firstMs) / Math.max(1, replay.lastMs - replay.firstMs);
  $("clock").textContent = `${seconds((replay.nowMs - replay.firstMs) / 1000)} of ${seconds((replay.lastMs - replay.firstMs) / 1000)}`;
}

// --- drawing ---------------------------------------------------------------------------------------------------------

function showPicture(robot) {
  if (robot.coming && !robot.decoding) {
    const message = robot.coming;
    robot.coming = null;
    robot.decoding = true;
    picture(message).then(bitmap => {
      robot.bitmap?.close();
      Object.assign(robot, {bitmap, pictureMs: message.stampMs + robot.skewMs, pictureChanged: true});
    }, () => {}).finally(() => { robot.decoding = false; });
  }
  if (robot.pictureChanged) drawPicture($("camera"), robot.bitmap);
  robot.pictureChanged = false;
}

function frame(clockMs) {
  requestAnimationFrame(frame);
  replay?.frame(clockMs);
  map.draw(shown(), chosen, nowMs());
  const robot = robots.get(chosen);
  if (robot) {
    showPicture(robot);
    if (robot.scanChanged) drawScan($("scan"), robot.scan, robot.tint);
    if (robot.queueChanged) drawSlots($("slots"), robot.queue);
    robot.scanChanged = robot.queueChanged = false;
  }
  if (clockMs - textMs < TEXT_MS / 2) return;
  textMs = clockMs;
  texts = !texts;                                   // in turn: both in one frame are the longest of all
  if (!texts) {
    if (robot) drawHistory($("history"), robot.history, nowMs());
    return;
  }
  sayRobots();
  if (replay) sayReplay();
  if (robot) sayChosen(robot);
}
requestAnimationFrame(frame);

function redraw() {
  for (const robot of robots.values()) {
    robot.tint = hue(robot.number);
    robot.card.style.setProperty("--robot", robot.tint);
    robot.scanChanged = robot.queueChanged = robot.pictureChanged = true;
    if (robot.name === chosen) $("robot").style.setProperty("--robot", robot.tint);
  }
  for (const row of $("topics").rows) row.dataset.name = "";
  textMs = map.belowMs = -Infinity;
}
whenColoursChange(redraw);
addEventListener("resize", redraw);

// The page: connects the relay, the robots' states and what draws them. Messages only change the state; everything is drawn once for each
// frame of the screen.

import {Cameras} from "./cameras.js";
import {say, seconds, tint, whenColoursChange} from "./draw.js";
import {AWAY_MS, Fleet, GONE_MS, split, troubles} from "./fleet.js";
import {Hand} from "./hand.js";
import {Health} from "./health.js";
import {Layers} from "./layers.js";
import {List} from "./list.js";
import {Map2D} from "./map.js";
import {DRAWN, HEALTH, json} from "./messages.js";
import {Near} from "./near.js";
import {Notices} from "./notices.js";
import {Overview} from "./overview.js";
import {Player} from "./player.js";
import {Relay} from "./relay.js";
import {address, replace, route, TABS} from "./route.js";
import {SignIn} from "./sign_in.js";

const TEXT_MS = 250, GRACE_MS = 2000;               // texts are said so often; so long may a connection be away before the page says so
const ALL = "^/(robots|ut)/[^/]+/", RELEASED = ["velodyne_2dscan", "scan", "visualization", "image_compressed/main"];  // Robofleet's robots name no topics
const USUAL_POSES = ["odom", "odometry/raw", "odometry", "localization", "tf", "tf_static"];   // asked for before a robot's status, which comes once a second, names its own

/** @type {(id: string) => any} */
const $ = id => document.getElementById(id);
const escaped = text => text.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");

let fleet, chosen = null, tab = TABS[0], textMs = -Infinity, texts = false, stale = false, wants = false, space = null, onMs = null, awayMs = performance.now();

const nowMs = () => player.replay ? player.nowMs : relay.clock.now();
const isReplay = () => fleet === recorded;
const robot = () => fleet.get(chosen);

// How the page shows a fleet, while it is the one that is shown.
const shows = (own, now) => ({
  nowMs: now,
  drawn: one => own() === fleet && one.name === chosen,
  added(one) {
    one.troubles = [];
    if (own() !== fleet) return;
    list.add(one);
    if (one.name === chosen) show();
  },
  here(one) {
    if (own() !== fleet) return;
    if (route().name === null) replace(one.name, tab);  // the address may be newer than what is chosen
    if (chosen === null || one.name === chosen) show();
  },
  removed(name) {
    if (own() === live) notices.removed(name);
    if (own() !== fleet) return;
    list.remove(name);
    if (name === chosen) location.hash = address(null);
  },
  status(one) {
    wants = true;
    if (own() === live) hand.answered(one);
    if (one.name === chosen) hand.offerPolicies();
  },
  stopped(one) { if (own() === live) hand.stopped(one); },
  claimed(name, why) { if (own() === live) notices.told(`claim ${name}`, `${name}: ${why}`, relay.clock.now()); },
  reframed(one) { if (own() === fleet && one.name === chosen) map.forget(); },
  scanned(one, pose, scan) { if (own() === fleet) map.addScan(pose, scan); },
  moved(isLayer = false) {
    if (own() !== fleet) return;
    map.changed = true;
    if (space) space.changed = true;
    map.layersChanged ||= isLayer;
  },
});
// Alerts and stops are of the robots that are there, also while a recording is shown.
const live = fleet = new Fleet(shows(() => live, () => relay.clock.now())), recorded = new Fleet(shows(() => recorded, nowMs));
const list = new List($("list"), $("search"), $("count"));
const layers = new Layers($("layers"), () => {
  map.belowMs = -Infinity;
  subscribe();
});
const map = new Map2D($("map"), layers, name => { location.hash = address(name, tab); });
const notices = new Notices($("notices"), $("spoken")), near = new Near($("near")), overview = new Overview($), health = new Health($);
const cameras = new Cameras($("first"), $("cameras"), $("large"));
const relay = new Relay({
  state(text, isOn) {
    if (!isOn && onMs !== null) awayMs = performance.now();
    onMs = isOn ? performance.now() : null;
    sayState(text);
  },
  welcome() {
    signIn.welcomed(relay.welcome.identity);
    hand.offerPolicies();
    hand.draw();
  },
  rights() {
    hand.offerPolicies();
    hand.draw();
  },
  slept(ms) {
    hand.drive.open(false);
    notices.told("sleep", `This computer slept for ${seconds(ms / 1000)}: connecting anew`, relay.clock.now());
  },
  message(message) { tried(live, message); },
  said(said) {
    if (said.op === "recordings") player.list(said.files);
    else if (said.op === "replayed") player.replay?.take(said);
    else if (said.op === "refused") notices.refused(split(String(said.topic ?? "")).name ?? chosen ?? "", `${said.what}: ${said.why}`, relay.clock.now(), null, `${said.what} ${said.code} ${said.topic}`);
  },
  unauthorized(why, token) { signIn.refused(why, token); },
});
const signIn = new SignIn($, relay);
const player = new Player($, relay, {
  message: message => tried(recorded, message),
  begin() {
    turn(recorded);
    for (const id of ["poses", "chosen"]) relay.unsubscribe(id);
  },
  jump() {
    for (const one of recorded.all()) recorded.blank(one);
    map.forget();
  },
  end() { turn(live); },
});
const hand = new Hand($, relay, map, notices, {
  robot, isReplay, nowMs: () => relay.clock.now(), live: () => live.get(chosen), all: () => live.all(), frame: () => shown().frame, removed: name => live.remove(name),
});

function begin() {
  relay.subscribe("status", `${ALL}status$`);
  relay.subscribe("last", "^/robots/[^/]+/last$");
  relay.subscribe("stops", "^/robots/[^/]+/(stop|claim)$");
  relay.subscribe("relay", "^/relay/status$");
  subscribe();
}

const layered = () => tab === "3d" ? [...DRAWN, "cloud"] : DRAWN;  // kinds

// Of all robots where they are and what is wrong, of the chosen one all that is drawn.
function subscribe() {
  wants = false;
  const of = topics => `(${[...new Set(topics)].sort().map(escaped).join("|")})$`;
  relay.subscribe("health", ALL + of(["diagnostics", ...live.topics(HEALTH)]));
  if (isReplay()) return;                           // what is drawn now comes from the file
  relay.subscribe("poses", ALL + of([...USUAL_POSES, ...fleet.topics(["pose", "tf"])]));
  if (chosen === null) return;
  const own = kinds => robot() ? fleet.topics(kinds, [robot()]) : [];
  const pictures = own(["picture"]), topics = ["queue", ...own(["scan"]).slice(0, 1), ...own(layered()).filter(topic => layers.isOn(topic))];
  relay.subscribe("chosen", `^/${chosen.startsWith("ut/") ? "" : "robots/"}${escaped(chosen)}/` + of([...topics, ...(chosen.startsWith("ut/") ? RELEASED : []), ...(tab === "cameras" ? pictures : pictures.slice(0, 1))]));
}

// A message that is not what it says it is changes nothing.
function tried(those, message) {
  try {
    if (message.topic === "/relay/status") sayRelay(json(message));
    else those.take(message, relay.isLatched(message.topic) ?? true);
  } catch {
    return;
  }
}

// --- what is shown -----------------------------------------------------------------------------------------------------

// What the address says.
function show() {
  const before = chosen;
  ({name: chosen, tab} = route());
  const first = fleet.all().find(one => one.isHere);
  if (chosen === null && first) replace(chosen = first.name, tab);
  const one = robot();
  document.body.dataset.tab = tab;
  document.title = chosen === null ? "bufgym relay: robots" : `${chosen}, ${tab}: bufgym relay`;
  $("robot").hidden = chosen === null;
  $("absent").hidden = one !== undefined;
  say($("absent"), `${chosen} has not said anything yet.`);
  say($("name"), chosen ?? "");
  for (const link of $("tabs").children) {
    link.href = address(chosen, link.dataset.tab);
    link.ariaCurrent = link.dataset.tab === tab ? "page" : null;
  }
  for (const each of TABS) $("tab-" + each).hidden = each !== tab || one === undefined;
  if (chosen !== before) {
    hand.take(null);
    map.forget();
    map.follow = true;
    if (space) space.follow = true;
    if (one) Object.assign(one, {layers: new Map(), cameras: new Map(), scan: undefined, queueChanged: true, scanChanged: true});
  }
  if (one) $("robot").style.setProperty("--robot", tint(one.colour));
  cameras.redraw = true;
  textMs = -Infinity;
  if (tab === "3d") openSpace();
  redraw();
  subscribe();
  hand.offerPolicies();
  hand.draw();
}

// What the 3-D tab draws with comes when it is first opened.
async function openSpace() {
  try {
    const {Space} = await import("./space.js");
    space ??= new Space($, layers, nowMs);
  } catch (error) {
    say($("space").querySelector("figcaption"), error.message);
  }
}

function sayState(text = onMs === null ? "not connected" : "live") {
  say($("state"), isReplay() ? "replay" : text);
  $("state").className = "state" + (isReplay() ? " replay" : onMs === null ? "" : " on");
}

function sayRelay(status) {
  const alone = (status.nats ?? "connected") === "connected" ? "" : `, without other relays: ${status.nats}`;
  say($("relay"), `${status.connections} connected, ${status.dropped} dropped here${alone}`);
}

function sayAbsence() {
  const silentMs = performance.now() - awayMs, isAway = onMs === null && silentMs > GRACE_MS && !$("ask").open;
  $("cover").hidden = !isAway;
  $("main").inert = isAway;
  if (isAway) say($("cover-says"), `for ${seconds(silentMs / 1000)}. What is below is that old or older, and no command gets through. X stops the chosen robot as soon as it can be reached. It tries again by itself.`);
}

function sayRobots() {
  const now = relay.clock.now();
  near.mark(live.all().filter(one => now - one.heardMs < GONE_MS));
  near.mark(recorded.all());
  for (const [one, ms] of [...live.all().map(one => [one, now]), ...recorded.all().map(one => [one, nowMs()])]) {
    one.away = ms - one.heardMs > AWAY_MS;
    one.troubles = troubles(one, ms);
  }
  // Who was not heard while there was no connection is not known to be silent.
  if (onMs !== null && performance.now() - onMs > AWAY_MS) for (const one of live.all()) notices.troubles(one, now);
  list.update(fleet.all(), chosen, tab, nowMs());
  notices.draw(now);
}

// A map has one frame: the chosen robot's. A place without a frame is shown on each.
function shown() {
  const all = fleet.all().filter(one => one.isHere || one.troubles.length || one === robot()), frame = robot()?.pose?.frame || all.find(one => one.pose?.frame)?.pose.frame;
  const here = all.filter(one => !one.pose?.frame || one.pose.frame === frame), away = all.length - here.length;
  say($("frame"), [frame && `in ${frame}`, away && `${away} in other frames`].filter(Boolean).join(", "));
  $("no-map").hidden = !robot()?.pose || [...robot().layers.values()].some(layer => layer.kind === "grid");
  return {here, frame};
}

// Show a fleet: what robots say now, or what they said in a recording.
function turn(to) {
  fleet = to;
  recorded.clear();
  list.clear();
  for (const one of to.all()) list.add(one);
  chosen = null;
  replace(null);
  show();
  map.forget();
  map.fitted = false;
  sayState();
}

// An alert is of now.
$("notices").addEventListener("click", event => { if (isReplay() && event.target.matches("a")) player.end(); });

$("fit").onclick = () => { map.follow = true; map.fitted = false; };

// --- drawing ---------------------------------------------------------------------------------------------------------

function frame(clockMs) {
  requestAnimationFrame(frame);
  if (stale) redrawn();
  player.replay?.frame(clockMs);
  const one = robot(), {here, frame: its} = shown();
  map.draw(here, one, its, nowMs());
  if (one) {
    cameras.draw(one, tab);
    if (tab === "overview") overview.draw(one);
    else if (tab === "3d") space?.draw(here, one, its);
  }
  if (clockMs - textMs < TEXT_MS / 2) return;
  textMs = clockMs;
  texts = !texts;                                   // in turn: both in one frame are the longest of all
  if (!texts) {
    if (wants) subscribe();
    if (one && tab === "overview") overview.drawHistory(one, nowMs());
    return;
  }
  sayRobots();
  sayAbsence();
  if (isReplay()) player.say();
  hand.draw();
  if (one) sayChosen(one);
}

function sayChosen(one) {
  overview.facts(one, nowMs());
  layers.list(one, fleet.topics(layered(), [one]));
  cameras.say(one, fleet.topics(["picture", "video"], [one]), nowMs());
  if (tab === "overview") overview.say(one, nowMs());
  if (tab === "health") health.draw(one, nowMs());
  else if (tab === "3d") space?.say(one, nowMs());
}

function redraw() { stale = true; }

function redrawn() {
  stale = false;
  for (const one of fleet.all()) {
    list.colour(one);
    one.scanChanged = one.queueChanged = true;
  }
  if (robot()) $("robot").style.setProperty("--robot", tint(robot().colour));
  for (const row of $("topics").rows) row.dataset.name = "";
  cameras.redraw = true;
  if (space) space.changed = true;
  textMs = map.belowMs = -Infinity;
}

addEventListener("hashchange", show);
// Chromium sometimes drops the first navigation to a fragment after a load; a step made here is always taken.
addEventListener("click", event => {
  const link = event.target instanceof Element ? /** @type {HTMLAnchorElement} */ (event.target.closest('a[href^="#/"]')) : null;
  if (!link || event.button || event.ctrlKey || event.metaKey || event.shiftKey || event.altKey) return;
  event.preventDefault();
  if (location.hash === link.hash) return;
  history.pushState(null, "", link.hash);
  show();
});
addEventListener("resize", redraw);
whenColoursChange(redraw);
show();
begin();
requestAnimationFrame(frame);

// A relay client in JavaScript, written from packages/robot/bufgym_robot/wire/PROTOCOL.md alone. Needs Node 22, or a browser.
//
//     node relay_client.js ws://127.0.0.1:7420 NAME [TOPIC JSON]
// Prints what robots publish, publishes the time as /robots/NAME/clock, and sends one no_drop command, if given.

const FIRST_MS = 200, AWAY_MS = 1000, MOST_MS = 8000, HELD_MS = 5000, FOR_GOOD = ["unauthorized", "wrong"];
const [url, name, topic, data] = process.argv.slice(2);
const who = {version: 1, form: "json", name, robot: name, session: crypto.randomUUID()};
const commands = topic ? [{topic, data: JSON.parse(data)}] : [];  // the first is on its way
let live = null, mostMs = FIRST_MS;                 // the WebSocket once it is welcome; longest delay until the next try
let acked = 0, received = 0;                        // highest number of ours that the relay holds, and that came

function connect() {
  const socket = new WebSocket(`${url}/relay`, ["bufgym.relay.v1"]);
  let mayWaitMs = AWAY_MS, sinceMs = Infinity, isOver = false;
  socket.onopen = () => {
    mayWaitMs = MOST_MS;
    socket.send(JSON.stringify({op: "hello", ...who, received, acked}));
  };
  socket.onmessage = event => {
    const said = JSON.parse(event.data);
    if (said.op === "welcome") [live, sinceMs] = [socket, performance.now()];
    isOver = said.what === "hello" && FOR_GOOD.includes(said.code);
    hear[said.op]?.(said);
  };
  socket.onclose = socket.onerror = () => {         // in Node a connection that fails has no close
    socket.onclose = socket.onerror = live = null;
    if (performance.now() - sinceMs >= HELD_MS) mostMs = FIRST_MS;
    if (!isOver) setTimeout(connect, Math.random() * Math.min(mostMs, mayWaitMs));
    mostMs = Math.min(2 * mostMs, MOST_MS);
  };
}

const say = (op, fields) => live?.send(JSON.stringify({op, ...fields}));
const next = () => commands.length && say("publish", {...commands[0], no_drop: true, seq: acked + 1});
const hear = {
  welcome(said) {
    say("subscribe", {id: "all", topic: "^/robots/", durable: true});
    if (said.received > acked) hear.ack({seq: said.received}); else next();
  },
  ack(said) {
    acked = said.seq;
    console.log("held", JSON.stringify(commands.shift()));
    next();
  },
  delivered({seq, why}) { console.log("done", seq, why ?? ""); },
  message({topic, data, no_drop, seq}) {
    if (no_drop && seq <= received) return;
    console.log(topic, JSON.stringify(data));
    if (no_drop) say("ack", {seq: received = seq});
  },
  refused(said) {
    console.error("refused", JSON.stringify(said));
    if (said.what !== "publish" || said.topic !== commands[0]?.topic) return;
    commands.shift();
    next();
  },
};
connect();
setInterval(() => say("publish", {topic: `/robots/${name}/clock`, data: Date.now()}), 100);

// What the relay lets this page do, topic by topic. The page asks: rules are patterns, which the relay alone matches, in linear time.

const MOST = 100, KEPT = 20_000;                    // topics of one question, and of those that are known

export class Rights {
  // ``relay`` has welcome, or null while there is no connection, and say.
  constructor(relay) {
    this.relay = relay;
    this.known = new Map();                         // topic -> {send, command_s, no_drop, latched}
    this.asked = new Set();                         // on this connection
    this.wanted = [];
  }

  // Another connection, or other rules: what is known holds until the relay answers anew.
  begin() {
    this.asked.clear();
    this.wanted = [];
  }

  // Empty until the relay has answered.
  of(topic) {
    if (this.relay.welcome && !this.asked.has(topic)) {
      if (this.asked.size >= KEPT) this.begin();
      this.asked.add(topic);
      if (this.wanted.push(topic) === 1) queueMicrotask(() => this.ask());
    }
    return this.known.get(topic) ?? {};
  }

  ask() {
    while (this.wanted.length) this.relay.say("may", {topics: this.wanted.splice(0, MOST)});
  }

  heard(rights) {
    if (this.known.size >= KEPT) this.known.clear();
    for (const [topic, right] of Object.entries(rights)) this.known.set(topic, right);
  }
}

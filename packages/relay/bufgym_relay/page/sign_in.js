// Who looks: signs in by OpenID Connect (a code with PKCE, RFC 7636), renews the token before its end, signs out. Where the relay
// names no issuer, it asks for a token.

import {object} from "./cdr.js";
import {say} from "./draw.js";

const RENEW_AT = 0.8, AGAIN_MS = 5000, MOST_MS = 2 ** 31 - 1;  // a token is renewed at this part of its life; after a failure again

const packed = bytes => btoa(String.fromCharCode(...new Uint8Array(bytes))).replaceAll("+", "-").replaceAll("/", "_").replace(/=+$/, "");
const random = () => packed(crypto.getRandomValues(new Uint8Array(32)));
const nowMs = () => performance.timeOrigin + performance.now();
const here = () => location.origin + location.pathname;

// What a token says. Only the relay checks whether it is true.
function claims(token) {
  try {
    const bytes = Uint8Array.from(atob(token.split(".")[1].replaceAll("-", "+").replaceAll("_", "/")), letter => letter.charCodeAt(0));
    return object(JSON.parse(new TextDecoder().decode(bytes)));
  } catch {
    return {};
  }
}

function kept(name) {
  try {
    return object(JSON.parse(sessionStorage.getItem(name)));
  } catch {
    return {};
  }
}
const keep = (name, value) => sessionStorage.setItem(name, JSON.stringify(value));

export class SignIn {
  // $ finds an element; ``relay`` is told of each new token.
  constructor($, relay) {
    this.$ = $;
    this.relay = relay;
    this.issuer = fetch("sign-in.json").then(answer => answer.json()).catch(() => ({}));
    $("sign").onclick = () => relay.token ? this.out() : this.ask();
    $("to-issuer").onclick = () => this.leave().catch(error => { this.error = error.message; this.ask(); });
    $("ask").onclose = () => {
      const token = $("token").value || relay.token || "";
      $("token").value = "";
      if (token !== relay.token || !relay.welcome) relay.authorize(token);
    };
    const came = new URLSearchParams(location.search), asked = kept("asked");
    sessionStorage.removeItem("asked");
    this.came = Promise.resolve();                  // done when the code that came with the address was exchanged
    if (came.has("state")) {
      history.replaceState(null, "", location.pathname + (asked.hash ?? ""));
      this.came = this.enter(came, asked).catch(error => { this.error = error.message; });
    }
    this.wait();
  }

  // The relay says who is there.
  async welcomed({email, address}) {
    say(this.$("you"), `you are ${email || address}`);
    this.offer(Boolean((await this.issuer).issuer));
  }

  // When and how the relay's token is renewed; nothing of one that a person brought.
  life() { return kept("sign-in").token === this.relay.token ? kept("sign-in") : {}; }

  offer(hasIssuer) {
    this.$("sign").hidden = !hasIssuer && !this.relay.token;
    say(this.$("sign"), this.relay.token ? "Sign out" : "Sign in");
  }

  // The relay lets nobody in with this token: with the next one, if there is one without asking a person.
  async refused(why, token) {
    await this.came;
    if (this.relay.token !== token) return;         // the next one is on its way
    const {refresh, renewMs} = this.life(), isOver = nowMs() >= renewMs;  // the relay's clock may be ahead; one just fetched is not asked for again
    if (isOver && refresh && await this.renew()) return;
    if (isOver && !this.error) {
      sessionStorage.removeItem("sign-in");         // once: the next refusal asks the person
      if (await this.leave("none").then(() => true, () => false)) return;
    }
    this.ask(why);
  }

  async ask(why = "") {
    const {$} = this, {issuer} = await this.issuer, {email} = claims(this.relay.token ?? "");
    say($("ask-title"), why && this.relay.token ? "Not authorized" : "Who are you?");
    say($("why"), [email && `You are ${email}.`, why && `The relay says: ${why}.`, this.error].filter(Boolean).join(" "));
    $("to-issuer").hidden = !issuer;
    say($("to-issuer"), this.relay.token ? "Sign in again" : "Sign in");
    $("by-token").hidden = Boolean(issuer);
    this.offer(Boolean(issuer));
    if (!$("ask").open) $("ask").showModal();
  }

  async endpoints() {
    const {issuer} = await this.issuer, answer = await fetch(issuer.replace(/\/$/, "") + "/.well-known/openid-configuration");
    const found = object(await answer.json());
    if (!answer.ok || found.issuer !== issuer) throw new Error(`${issuer} does not say where to sign in.`);
    return found;
  }

  // Leave for the issuer, who sends the browser back; ``prompt`` "none" asks no person, and else who is refused may be another.
  async leave(prompt = this.relay.token ? "login" : "") {
    if (!crypto.subtle) throw new Error("Signing in needs https.");
    const {client, scope} = await this.issuer, {authorization_endpoint} = await this.endpoints();
    const asked = {state: random(), nonce: random(), verifier: random(), hash: location.hash};
    const challenge = packed(await crypto.subtle.digest("SHA-256", new TextEncoder().encode(asked.verifier)));
    keep("asked", asked);
    const address = new URL(authorization_endpoint);
    const fields = {response_type: "code", client_id: client, redirect_uri: here(), scope, state: asked.state, nonce: asked.nonce,
      code_challenge: challenge, code_challenge_method: "S256", ...(prompt ? {prompt} : {})};
    for (const [name, value] of Object.entries(fields)) address.searchParams.set(name, value);
    location.assign(address);
  }

  // The issuer has sent the browser back, with a code or an error.
  async enter(came, asked) {
    if (came.get("state") !== asked.state) throw new Error("Somebody else began to sign in.");
    if (!came.has("code")) throw new Error(came.get("error") === "login_required" ? "Your time is over." : `The issuer says: ${came.get("error_description") ?? came.get("error")}.`);
    await this.take({grant_type: "authorization_code", code: came.get("code"), redirect_uri: here(), code_verifier: asked.verifier}, asked.nonce);
  }

  // Fetch a token, keep it and tell the relay; ``nonce`` is the one that was asked with.
  async take(fields, nonce) {
    const {client} = await this.issuer, {token_endpoint} = await this.endpoints();
    const answer = await fetch(token_endpoint, {method: "POST", body: new URLSearchParams({client_id: client, ...fields})});
    const said = object(await answer.json()), {iat, exp, nonce: its} = claims(said.id_token ?? "");
    if (!answer.ok) throw Object.assign(new Error(`The issuer says: ${said.error_description ?? said.error}.`), {isFinal: true});
    if (!(exp > iat) || (nonce && its !== nonce)) throw Object.assign(new Error("The issuer does not say who this is."), {isFinal: true});
    // By the issuer's clock it lives so long, whatever the time is here.
    keep("sign-in", {token: said.id_token, refresh: said.refresh_token ?? fields.refresh_token, renewMs: nowMs() + RENEW_AT * 1000 * (exp - iat)});
    this.error = undefined;
    this.relay.authorize(said.id_token, nonce === undefined);
    this.wait();
  }

  wait() {
    const {refresh, renewMs} = this.life();
    clearTimeout(this.timer);
    if (refresh && this.relay.token) this.timer = setTimeout(() => this.renew(), Math.min(MOST_MS, Math.max(0, renewMs - nowMs())));
  }

  // True if there is a new token.
  async renew() {
    const before = this.life();
    try {
      await this.take({grant_type: "refresh_token", refresh_token: before.refresh});
      return true;
    } catch (error) {
      keep("sign-in", error.isFinal ? {...before, refresh: undefined} : {...before, renewMs: nowMs() + AGAIN_MS});
      this.wait();
      return false;
    }
  }

  // Forget the token, here and, where it has a page for that, at the issuer.
  async out() {
    const {token} = this.relay, {issuer, client} = await this.issuer;
    for (const name of ["token", "sign-in", "asked"]) sessionStorage.removeItem(name);
    const {end_session_endpoint} = issuer ? await this.endpoints().catch(() => ({})) : {};
    if (!end_session_endpoint) return location.reload();
    const address = new URL(end_session_endpoint);
    for (const [name, value] of Object.entries({id_token_hint: token, client_id: client, post_logout_redirect_uri: here()})) address.searchParams.set(name, value);
    location.assign(address);
  }
}

"""A made-up issuer of tokens: its keys in a file, and over HTTP all that a page needs to sign somebody in."""

import base64
import hashlib
import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import jwt
from cryptography.hazmat.primitives.asymmetric import ec

from bufgym_relay.config import Tokens


class Issuer:
    """Signs tokens; its key set is a file."""

    def __init__(self, folder: Path, name: str = "https://issuer.test") -> None:
        self.name = name
        self.file = folder / "jwks.json"
        self.keys: dict[str, Any] = {}
        self.rotate("one")

    def rotate(self, kid: str) -> None:
        """From now on only this key."""
        self.keys[kid] = ec.generate_private_key(ec.SECP256R1())
        public = json.loads(jwt.algorithms.ECAlgorithm.to_jwk(self.keys[kid].public_key()))
        self.file.write_text(json.dumps({"keys": [{**public, "kid": kid, "alg": "ES256", "use": "sig"}]}))
        self.kid = kid

    def token(self, kid: str = "", algorithm: str = "ES256", key: Any = None, **changed: Any) -> str:
        kid = kid or self.kid
        claims = {"iss": self.name, "aud": "fleet", "exp": time.time() + 60, "email": "anna@x.org"}
        claims |= {"email_verified": True, **changed}
        claims = {name: value for name, value in claims.items() if value is not None}
        key = None if algorithm == "none" else key or self.keys[kid]
        return str(jwt.encode(claims, key, algorithm, headers={"kid": kid}))

    @property
    def tokens(self) -> Tokens:
        return Tokens(self.name, "fleet", str(self.file))


class SignInServer:
    """An OpenID provider for one person at a time, ``email``, who is asked by a page with one link."""

    def __init__(self, folder: Path) -> None:
        self.email, self.life_s, self.renews = "anna@x.org", 3600.0, True
        self.is_known = False
        """Whether the browser needs no person to answer for it."""
        self.asked: list[dict[str, str]] = []
        """What the page has asked for tokens with."""
        self._codes: dict[str, dict[str, str]] = {}
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                parts = urlsplit(self.path)
                outer._get(self, parts.path, {name: values[0] for name, values in parse_qs(parts.query).items()})

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"])).decode()
                fields = {name: values[0] for name, values in parse_qs(body).items()}
                outer.asked.append(fields)
                status, said = outer._tokens_for(fields)
                answer(self, status, json.dumps(said))

            def log_message(self, *_: object) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self.issuer = Issuer(folder, self.url)

    def __enter__(self) -> "SignInServer":
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    @property
    def tokens(self) -> Tokens:
        return Tokens(self.url, "fleet", f"{self.url}/jwks", client="page", leeway_s=0.0)

    def _get(self, handler: BaseHTTPRequestHandler, path: str, asked: dict[str, str]) -> None:
        match path:
            case "/.well-known/openid-configuration":
                places = {"authorization": "/authorize", "token": "/token", "end_session": "/end"}
                urls = {f"{name}_endpoint": self.url + place for name, place in places.items()}
                answer(handler, 200, json.dumps({"issuer": self.url, **urls}))
            case "/jwks":
                answer(handler, 200, self.issuer.file.read_text())
            case "/authorize" if asked.get("prompt") == "none" and not self.is_known:
                back = {"error": "login_required", "state": asked["state"]}
                answer(handler, 302, "", f"{asked['redirect_uri']}?{urlencode(back)}")
            case "/authorize":
                code = f"code-{len(self._codes)}"
                self._codes[code] = asked
                back = f"{asked['redirect_uri']}?{urlencode({'code': code, 'state': asked['state']})}"
                if asked.get("prompt") == "none":
                    answer(handler, 302, "", back)
                else:
                    answer(
                        handler,
                        200,
                        f'<link rel="icon" href="data:,"><a id="yes" href="{back}">I am</a>',
                        None,
                        "text/html",
                    )
            case "/end":
                self.is_known = False
                answer(handler, 302, "", asked["post_logout_redirect_uri"])
            case _:
                answer(handler, 404, "")

    def _tokens_for(self, fields: dict[str, str]) -> tuple[int, dict[str, str]]:
        """Exchange a code, once and for whoever asked for it, or a refresh token."""
        now_s = time.time()
        claims: dict[str, Any] = {
            "aud": fields["client_id"],
            "email": self.email,
            "iat": now_s,
            "exp": now_s + self.life_s,
        }
        if fields["grant_type"] == "refresh_token":
            if not self.renews or fields["refresh_token"] != "again":
                return 400, {"error": "invalid_grant"}
        else:
            asked = self._codes.pop(fields["code"])
            digest = hashlib.sha256(fields["code_verifier"].encode()).digest()
            assert base64.urlsafe_b64encode(digest).decode().rstrip("=") == asked["code_challenge"]
            assert (fields["redirect_uri"], fields["client_id"]) == (asked["redirect_uri"], asked["client_id"])
            self.is_known, claims["nonce"] = True, asked["nonce"]
        return 200, {"id_token": self.issuer.token(**claims), **({"refresh_token": "again"} if self.renews else {})}


def answer(
    handler: BaseHTTPRequestHandler, status: int, body: str, location: str | None = None, type: str = "application/json"
) -> None:
    """Answer any page; one that is at another server may read it."""
    handler.send_response(status)
    handler.send_header("Access-Control-Allow-Origin", "*")
    handler.send_header("Content-Type", type)
    if location is not None:
        handler.send_header("Location", location)
    handler.end_headers()
    handler.wfile.write(body.encode())

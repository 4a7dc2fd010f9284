"""Who is at the other end: tokens of a local issuer whose keys change, certificates, TLS."""

from __future__ import annotations

import asyncio
import datetime
import json
import ssl
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from relay_cases import client, relay, run, settings
from websockets.exceptions import WebSocketException

from bufgym.errors import BufgymError
from bufgym.relay import identity
from bufgym.relay.config import Rule, Tls, Tokens

jwt = pytest.importorskip("jwt")
x509 = pytest.importorskip("cryptography.x509")
from cryptography.hazmat.primitives import hashes, serialization  # noqa: E402
from cryptography.hazmat.primitives.asymmetric import ec  # noqa: E402

ISSUER = "https://issuer.test"
ANNA = Rule(email="anna@x.org", send=True, receive=True)


class Issuer:
    """Signs tokens; its key set is a file."""

    def __init__(self, folder: Path) -> None:
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
        claims = {"iss": ISSUER, "aud": "fleet", "exp": time.time() + 60, "email": "anna@x.org", **changed}
        claims = {name: value for name, value in claims.items() if value is not None}
        return str(
            jwt.encode(claims, None if algorithm == "none" else key or self.keys[kid], algorithm, headers={"kid": kid})
        )

    @property
    def tokens(self) -> Tokens:
        return Tokens(ISSUER, "fleet", str(self.file))


@pytest.fixture
def issuer(tmp_path: Path) -> Issuer:
    return Issuer(tmp_path)


def test_a_token_names_who_it_is(issuer: Issuer) -> None:
    async def story() -> None:
        config = settings(rules=(ANNA,), tokens=issuer.tokens)
        async with relay(config) as server:
            async with client(server.port) as nobody:
                assert nobody.welcome["code"] == "unauthorized"
            async with client(server.port, token=issuer.token()) as anna:
                assert anna.welcome["identity"] == {"address": "127.0.0.1", "email": "anna@x.org"}
            async with client(server.port, token=issuer.token(email="bob@x.org")) as bob:
                assert bob.welcome["why"] == "no rule allows anything to this identity"
            # The key set is read again for a key that it did not have; the old key is no longer good.
            old = issuer.token()
            issuer.rotate("two")
            await asyncio.sleep(identity.AGAIN_S)
            async with client(server.port, token=issuer.token()) as anna:
                assert anna.welcome["op"] == "welcome"
            async with client(server.port, token=old) as anna:
                assert "unknown key 'one'" in anna.welcome["why"]
            # A token ends, and with it the connection.
            leeway_s = issuer.tokens.leeway_s
            async with client(server.port, token=issuer.token(exp=time.time() - leeway_s + 2)) as anna:
                await asyncio.wait_for(anna.socket.wait_closed(), 8)
                assert anna.socket.close_reason == "the token has expired"

    run(story)


SHARED = "a secret of thirty-two bytes and more"
BAD = {
    "expired": {"exp": 1.0},
    "no end": {"exp": None},
    "not yet": {"nbf": 2**33},
    "other issuer": {"iss": "https://other.test"},
    "other audience": {"aud": "shop"},
    "no audience": {"aud": None},
    "no email": {"email": None},
    "email is no text": {"email": ["anna@x.org"]},
    "unverified": {"email_verified": False},
    "shared secret": {"algorithm": "HS256", "key": SHARED},
    "unsigned": {"algorithm": "none"},
    "another's key": {"key": ec.generate_private_key(ec.SECP256R1())},
}


@pytest.mark.parametrize("why", BAD)
def test_what_is_no_proof(why: str, issuer: Issuer) -> None:
    verifier = identity.Verifier(issuer.tokens)
    assert asyncio.run(verifier.email(issuer.token()))[0] == "anna@x.org"
    with pytest.raises(BufgymError, match="token"):
        asyncio.run(verifier.email(issuer.token(**BAD[why])))


@pytest.mark.parametrize("token", ["", "a.b.c", "." * 3, "x" * 20_000, "e30.e30.", "\u0000"])
def test_what_is_no_token(token: str, issuer: Issuer) -> None:
    with pytest.raises(BufgymError, match="token"):
        asyncio.run(identity.Verifier(issuer.tokens).email(token))


def test_the_keys_come_over_http_no_more_often_than_they_may(issuer: Issuer) -> None:
    asked = []

    class Keys(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(issuer.file.read_bytes())

        def log_message(self, *_: object) -> None: ...

    with HTTPServer(("127.0.0.1", 0), Keys) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        tokens = Tokens(ISSUER, "fleet", f"http://127.0.0.1:{server.server_port}/jwks.json")

        async def story() -> None:
            verifier = identity.Verifier(tokens)
            for _ in range(5):
                assert await verifier.email(issuer.token())
            for k in range(20):
                issuer.keys[f"forged {k}"] = issuer.keys["one"]
                with pytest.raises(BufgymError, match="unknown key"):
                    await verifier.email(issuer.token(f"forged {k}"))

        asyncio.run(story())
        server.shutdown()
    assert asked == ["/jwks.json"]
    with pytest.raises(BufgymError, match="must be an https address"):
        identity.Verifier(Tokens(ISSUER, "fleet", "http://issuer.test/jwks.json"))
    with pytest.raises(BufgymError, match="algorithms"):
        Tokens(ISSUER, "fleet", "keys.json", algorithms=("HS256",))


# --- certificates ----------------------------------------------------------------------------------------------------


class Authority:
    """Signs certificates; all in one folder."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.certificate = self._signed(name, self.key.public_key(), x509.BasicConstraints(ca=True, path_length=None))
        self.file = folder / f"{name}.pem"
        self.file.write_bytes(self.certificate.public_bytes(serialization.Encoding.PEM))

    def _signed(self, name: str, public: Any, *extensions: Any) -> Any:
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        mine = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, self.name)])
        now = datetime.datetime.now(datetime.UTC)
        builder = x509.CertificateBuilder(mine, subject, public, x509.random_serial_number())
        builder = builder.not_valid_before(now - datetime.timedelta(hours=1)).not_valid_after(
            now + datetime.timedelta(hours=1)
        )
        for extension in extensions:
            builder = builder.add_extension(extension, critical=False)
        return builder.sign(self.key, hashes.SHA256())

    def issue(self, name: str, alternative: Any) -> tuple[str, str]:
        """(certificate, key), the paths."""
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = self._signed(name, key.public_key(), x509.SubjectAlternativeName([alternative]))
        paths = self.folder / f"{name}.pem", self.folder / f"{name}.key"
        paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        plain = serialization.NoEncryption()
        form = serialization.PrivateFormat.PKCS8
        paths[1].write_bytes(key.private_bytes(serialization.Encoding.PEM, form, plain))
        return str(paths[0]), str(paths[1])


def test_a_certificate_names_who_it_is(tmp_path: Path) -> None:
    import ipaddress

    authority, stranger = Authority(tmp_path, "authority"), Authority(tmp_path, "stranger")
    certificate, key = authority.issue("server", x509.IPAddress(ipaddress.ip_address("127.0.0.1")))

    def context(issuer: Authority | None) -> ssl.SSLContext:
        one = ssl.create_default_context(cafile=str(authority.file))
        if issuer is not None:
            one.load_cert_chain(*issuer.issue("anna", x509.RFC822Name("anna@x.org")))
        return one

    async def story() -> None:
        config = settings(rules=(ANNA,), tls=Tls(certificate, key, str(authority.file)))
        async with relay(config) as server:
            async with client(server.port, tls=context(authority)) as anna:
                assert anna.welcome["identity"]["email"] == "anna@x.org"
            async with client(server.port, tls=context(None)) as nobody:
                assert nobody.welcome["code"] == "unauthorized"
            with pytest.raises((OSError, WebSocketException)):
                async with client(server.port, tls=context(stranger)):
                    pass
            # Without TLS nothing is said at all.
            with pytest.raises((OSError, WebSocketException)):
                async with client(server.port):
                    pass

    run(story)
    with pytest.raises(BufgymError, match="tls"):
        identity.server_context(Tls(certificate, str(tmp_path / "missing.key")))

"""Who is at the other end: tokens of a local issuer whose keys change, certificates, TLS."""

import datetime
import inspect
import ipaddress
import ssl
import threading
import time
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from issuer_cases import Issuer
from loop_cases import beside
from msgspec.structs import replace
from needs import needs
from refusal_cases import refuse
from relay_cases import client, relay, settings, until, wait
from websockets.exceptions import WebSocketException

from bufgym.utils.errors import BufgymError
from bufgym_relay import identity
from bufgym_relay.config import Rule, Tls, Tokens
from bufgym_robot.wire.address import token
from bufgym_robot.wire.session import Session

jwt = pytest.importorskip("jwt", reason=needs("extras", "jwt"))
x509 = pytest.importorskip("cryptography.x509", reason=needs("extras", "cryptography.x509"))
from cryptography.hazmat.primitives import hashes, serialization  # noqa: E402
from cryptography.hazmat.primitives.asymmetric import ec  # noqa: E402

ANNA = Rule(email="anna@x.org", send=True, receive=True)


@pytest.fixture
def issuer(tmp_path: Path) -> Issuer:
    return Issuer(tmp_path)


async def test_a_token_names_who_it_is(issuer: Issuer) -> None:
    async with relay(settings(rules=(ANNA,), tokens=issuer.tokens)) as server:
        async with client(server.port) as nobody:
            assert nobody.welcome["code"] == "unauthorized"
        async with client(server.port, token=issuer.token()) as anna:
            assert anna.welcome["identity"] == {"address": "127.0.0.1", "email": "anna@x.org"}
        async with client(server.port, token=issuer.token(email="bob@x.org")) as bob:
            assert bob.welcome["why"] == "no rule allows anything to this identity"
        # A token ends, and with it the connection: this one is still let in, but only just.
        async with client(server.port, token=issuer.token(exp=time.time() - issuer.tokens.leeway_s / 2)) as anna:
            await wait("the token's end", anna.socket.wait_closed())
            assert anna.socket.close_reason == "the token has expired"


async def test_a_client_reads_its_file_again(issuer: Issuer, tmp_path: Path) -> None:
    """Its token ends, and so does the connection; it is let in again once the file has the next."""
    file = tmp_path / "token"
    async with relay(settings(rules=(ANNA,), tokens=replace(issuer.tokens, leeway_s=0.0))) as server:
        file.write_text(issuer.token(exp=time.time() + 3))  # a client that was never let in would end
        one = Session(f"ws://127.0.0.1:{server.port}", "anna", token=partial(token, file))
        async with beside(one.run()):
            await wait("the first connection", one.ready.wait())
            await until("a refusal", lambda: any("expired" in fault for fault in one.faults) and not one.ready.is_set())
            file.write_text(issuer.token())
            await wait("the second connection", one.ready.wait())


async def test_keys_change(issuer: Issuer) -> None:
    """The key set is read again once its file has changed; a key that has gone is no good."""
    now_s = 1_000.0
    verifier = identity.Verifier(issuer.tokens, clock=lambda: now_s)
    old = issuer.token()
    assert (await verifier.email(old))[0] == "anna@x.org"
    issuer.rotate("two")
    assert (await verifier.email(issuer.token()))[0] == "anna@x.org"
    with pytest.raises(BufgymError, match="unknown key 'one'"):
        await verifier.email(old)
    issuer.file.write_text("{}")
    with pytest.raises(BufgymError, match="the issuer's keys cannot be read"):
        await verifier.email(issuer.token())
    assert (await verifier.email(issuer.token()))[0] == "anna@x.org"  # half a file: the keys from before it
    now_s += 2 * identity.KEYS_AGE_S
    with pytest.raises(BufgymError, match="the issuer's keys cannot be read"):
        await verifier.email(issuer.token())


SHARED = "a secret of thirty-two bytes and more"


@pytest.mark.parametrize(
    "claims",
    [
        *({"exp": end} for end in (1.0, None)),
        *({"aud": audience} for audience in ("shop", None)),
        *({"email": email} for email in (None, ["anna@x.org"])),
        *({"email_verified": verified} for verified in (False, "false", "true", 1, None)),
        *({"nbf": 2**33}, {"iss": "https://other.test"}, {"algorithm": "none"}, {"algorithm": "HS256", "key": SHARED}),
        {"key": ec.generate_private_key(ec.SECP256R1())},
        *("", "a.b.c", "." * 3, "x" * 20_000, "e30.e30.", "\u0000"),
    ],
    ids=lambda claims: str(claims)[:30],
)
async def test_what_is_no_proof(claims: dict[str, Any] | str, issuer: Issuer) -> None:
    verifier = identity.Verifier(issuer.tokens)
    assert (await verifier.email(issuer.token()))[0] == "anna@x.org"
    with pytest.raises(BufgymError, match="token"):
        await verifier.email(claims if isinstance(claims, str) else issuer.token(**claims))


async def test_the_keys_come_over_http_no_more_often_than_they_may(issuer: Issuer) -> None:
    asked = []

    class Keys(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(issuer.file.read_bytes())

        def log_message(self, *_: object) -> None: ...

    with HTTPServer(("127.0.0.1", 0), Keys) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        tokens = Tokens(issuer.name, "fleet", f"http://127.0.0.1:{server.server_port}/jwks.json")
        verifier = identity.Verifier(tokens, clock=lambda: 0.0)
        for _ in range(5):
            assert await verifier.email(issuer.token())
        for k in range(20):
            issuer.keys[f"forged {k}"] = issuer.keys["one"]
            with pytest.raises(BufgymError, match="unknown key"):
                await verifier.email(issuer.token(f"forged {k}"))
        server.shutdown()
    assert asked == ["/jwks.json"]


def test_what_travels_in_the_open_is_refused() -> None:
    """Keys that are not a file, and whatever the page fetches; at this machine nobody listens."""
    safe, name = "https://issuer.test", "keys.json"
    for url in (
        "http://issuer.test/keys",
        "http://10.0.0.1/keys",
        "ftp://issuer.test",
        "https://",
        "https://a;b",
        "//a",
    ):
        refuse("must be an https address", Tokens, safe, "fleet", name, client="page", endpoints=(url,))
        refuse("issuer = .* must be an https address", Tokens, url, "fleet", name, client="page")
        assert Tokens(url, "fleet", name).origins == ()  # the page signs nobody in
    refuse("must be an https address", Tokens, safe, "fleet", "http://issuer.test/keys")
    here = ("http://localhost:1/token", "http://[::1]:2", "http://127.0.0.1:3/a")
    found = Tokens(f"{safe}/fleet", "fleet", name, client="page", endpoints=here).origins
    assert found == (safe, "http://localhost:1", "http://[::1]:2", "http://127.0.0.1:3")


async def test_a_page_s_token_has_its_client_as_audience(issuer: Issuer) -> None:
    proof = issuer.token(aud="page")
    with pytest.raises(BufgymError, match="token: Audience doesn't match"):
        await identity.Verifier(issuer.tokens).email(proof)
    verifier = identity.Verifier(replace(issuer.tokens, client="page"))
    assert (await verifier.email(proof))[0] == (await verifier.email(issuer.token()))[0] == "anna@x.org"


HERE = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))


class Authority:
    """Signs certificates; all in one folder."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.key = ec.generate_private_key(ec.SECP256R1())
        signs = dict.fromkeys(inspect.signature(x509.KeyUsage).parameters, False) | {"key_cert_sign": True}
        constraints = x509.BasicConstraints(ca=True, path_length=None)
        self.certificate = self._signed(name, self.key.public_key(), constraints, x509.KeyUsage(**signs))
        self.file = folder / f"{name}.pem"
        self.file.write_bytes(self.certificate.public_bytes(serialization.Encoding.PEM))

    def _signed(self, name: str, public: Any, *extensions: Any) -> Any:
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        mine = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, self.name)])
        now, hour = datetime.datetime.now(datetime.UTC), datetime.timedelta(hours=1)
        builder = x509.CertificateBuilder(mine, subject, public, x509.random_serial_number(), now - hour, now + hour)
        # Since Python 3.13 clients want what RFC 5280 does: keys' identifiers, critical extensions.
        own, issuer = x509.SubjectKeyIdentifier, x509.AuthorityKeyIdentifier
        identifiers = own.from_public_key(public), issuer.from_issuer_public_key(self.key.public_key())
        for extension in (*identifiers, *extensions):
            critical = isinstance(extension, (x509.BasicConstraints, x509.KeyUsage))
            builder = builder.add_extension(extension, critical=critical)
        return builder.sign(self.key, hashes.SHA256())

    def issue(self, name: str, alternative: Any) -> tuple[str, str]:
        """(certificate, key), the paths."""
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = self._signed(name, key.public_key(), x509.SubjectAlternativeName([alternative]))
        paths = self.folder / f"{name}.pem", self.folder / f"{name}.key"
        paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        form, plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        paths[1].write_bytes(key.private_bytes(serialization.Encoding.PEM, form, plain))
        return str(paths[0]), str(paths[1])


async def test_a_certificate_names_who_it_is(tmp_path: Path) -> None:
    authority, untrusted = Authority(tmp_path, "authority"), Authority(tmp_path, "untrusted")
    certificate, key = authority.issue("server", HERE)

    def context(issuer: Authority | None) -> ssl.SSLContext:
        one = ssl.create_default_context(cafile=str(authority.file))
        if issuer is not None:
            one.load_cert_chain(*issuer.issue("anna", x509.RFC822Name("anna@x.org")))
        return one

    async with relay(settings(rules=(ANNA,), tls=Tls(certificate, key, str(authority.file)))) as server:
        async with client(server.port, tls=context(authority)) as anna:
            assert anna.welcome["identity"]["email"] == "anna@x.org"
        async with client(server.port, tls=context(None)) as nobody:
            assert nobody.welcome["code"] == "unauthorized"
        for tls in (context(untrusted), None):  # without TLS nothing is said at all
            with pytest.raises((OSError, WebSocketException)):
                async with client(server.port, tls=tls):
                    pass
    refuse("tls", identity.server_context, Tls(certificate, str(tmp_path / "missing.key")))

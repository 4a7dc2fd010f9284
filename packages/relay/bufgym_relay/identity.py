"""Proofs of identity: JSON web tokens checked against an issuer's keys, and clients' certificates."""

import asyncio
import json
import ssl
import time
import urllib.request
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from bufgym.utils.errors import BufgymError
from bufgym.utils.files import read_utf8
from bufgym_relay.config import Tls, Tokens
from bufgym_robot.wire.messages import RefusedError

MAX_KEYS_BYTES: Final = 2**20
MAX_TOKEN_CHARACTERS: Final = 2**14
KEYS_AGE_S: Final = 300.0  # Longest time for which a key is still trusted after the issuer withdrew it
AGAIN_S: Final = 1.0  # Shortest time between two requests to the issuer because of tokens with unknown keys
_FETCH_S: Final = 5.0
_NO_KEYS: Final = (ValueError, RecursionError, AttributeError, TypeError)  # what a text that is no key set raises


_unauthorized: Final = partial(RefusedError, "unauthorized")


class Verifier:
    """Checks tokens of one issuer; its keys may change at any time."""

    def __init__(self, tokens: Tokens, clock: Callable[[], float] = time.monotonic) -> None:
        import jwt

        self._jwt: Any = jwt
        self._tokens, self._clock = tokens, clock
        self._keys: Mapping[str | None, Any] = {}
        self._fetched_s = -1e9
        self._fetching = asyncio.Lock()
        self._audiences = [name for name in (tokens.audience, tokens.client) if name]
        self._file = None if "://" in tokens.keys else Path(tokens.keys)
        self._state: tuple[int, ...] = ()

    async def email(self, token: str) -> tuple[str, float]:
        """Return the e-mail that the token proves and the token's end, s since 1970.

        Raises RefusedError: it proves none.
        """
        if len(token) > MAX_TOKEN_CHARACTERS:
            raise _unauthorized(f"token of {len(token)} characters: must be at most {MAX_TOKEN_CHARACTERS}")
        try:
            key = await self._key(self._jwt.get_unverified_header(token).get("kid"))
            known = {"audience": self._audiences, "issuer": self._tokens.issuer, "leeway": self._tokens.leeway_s}
            options = {"require": ["exp", "iss", "aud"]}
            claims = self._jwt.decode(token, key, list(self._tokens.algorithms), options, **known)
        except (self._jwt.PyJWTError, ValueError, TypeError, OverflowError, RecursionError) as error:
            raise error if isinstance(error, RefusedError) else _unauthorized(f"token: {error}") from None
        email = claims.get("email")
        if not isinstance(email, str) or not email or not email.isprintable():
            raise _unauthorized("token: names no email")
        if claims.get("email_verified") is not True:
            raise _unauthorized(f"token: email_verified must be true, not {claims.get('email_verified')!r:.20}")
        return email, float(claims["exp"])

    async def _key(self, kid: str | None) -> Any:
        async with self._fetching:
            state, age_s = self._state_of_file(), self._clock() - self._fetched_s
            asked = state != self._state or age_s > KEYS_AGE_S or (kid not in self._keys and age_s > AGAIN_S)
            if asked:
                self._state, self._fetched_s = state, self._clock()
                try:
                    text = await asyncio.to_thread(self._text)
                    self._keys = {key.key_id: key for key in self._jwt.PyJWKSet.from_dict(json.loads(text)).keys}
                except (OSError, BufgymError, self._jwt.PyJWTError, *_NO_KEYS) as error:
                    if age_s > KEYS_AGE_S:
                        self._keys = {}
                    raise RefusedError("unavailable", f"the issuer's keys cannot be read: {error}") from None
        if kid is None and len(self._keys) == 1:
            return next(iter(self._keys.values()))
        if kid not in self._keys:
            raise RefusedError("unauthorized" if asked else "unavailable", f"token: unknown key {str(kid)[:60]!r}")
        return self._keys[kid]

    def _state_of_file(self) -> tuple[int, ...]:
        """Tell one state of the file of keys from another; empty for a URL, and where there is no file."""
        try:
            found = self._file and self._file.stat()
        except OSError:
            found = None
        return (found.st_mtime_ns, found.st_size, found.st_ino) if found else ()

    def _text(self) -> str:
        if self._file is not None:
            return read_utf8(self._file, MAX_KEYS_BYTES)
        with urllib.request.urlopen(self._tokens.keys, timeout=_FETCH_S) as answer:
            return str(answer.read(MAX_KEYS_BYTES).decode())


def check_file(table: str, key: str, path: str) -> None:
    """Raise a BufgymError if there is no file of a path that a key of the configuration names."""
    if not Path(path).is_file():
        raise BufgymError(f"{table}: {key} = {path!r}: no such file")


def server_context(tls: Tls) -> ssl.SSLContext:
    """Set up TLS for the relay; clients are asked for certificates if an authority for them is given."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    renew(context, tls)
    return context


def renew(context: ssl.SSLContext, tls: Tls) -> None:
    """Read the files again, for connections from now on; if they cannot be read, all stays as it is."""
    for key in ("certificate", "key", "clients"):
        if path := getattr(tls, key):
            check_file("tls", key, path)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(tls.certificate, tls.key)
        context.load_cert_chain(tls.certificate, tls.key)
        if tls.clients:
            context.load_verify_locations(tls.clients)
            context.verify_mode = ssl.CERT_OPTIONAL  # else a token or an address may do
    except (OSError, ssl.SSLError) as error:
        raise BufgymError(f"tls: {tls.certificate}, {tls.key}, {tls.clients}: {error}") from None


def certificate_email(certificate: Mapping[str, Any] | None) -> str:
    """Read the e-mail from the subject alternative name or subject of a client's verified certificate, or ""."""
    found = certificate or {}
    pairs = [*found.get("subjectAltName", ()), *(pair for names in found.get("subject", ()) for pair in names)]
    texts = (value for kind, value in pairs if kind in ("email", "emailAddress") and isinstance(value, str))
    return next((text for text in texts if text.isprintable()), "")

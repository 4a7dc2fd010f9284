"""A connection to an http or https server. Its failures are sorted into final ones and those worth another attempt.

Proxies are taken from the environment, as usual. Redirections may lead to http and https addresses only.
"""

from __future__ import annotations

import errno
import http.client
import io
import math
import socket
import ssl
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit

from bufgym.ground.errors import BufgymError

MAX_HEAD_BYTES = 2**20
"""Most bytes of headers, or of trailers."""

_SHOWN_CHARACTERS = 200
# Request timeout, too early, too many requests, and errors inside the server: they may pass.
_PASSING_CODES = frozenset({408, 425, 429, 500, 502, 503, 504})


class BrokenError(Exception):
    """A failure that another attempt may put right."""

    def __init__(self, reason: str, wait_s: float = 0.0, stale: bool = False) -> None:
        """
        Args:
            reason: what happened.
            wait_s: how long the server asks to wait, s.
            stale: whether the part file no longer fits the server's file.
        """
        super().__init__(reason)
        self.wait_s = wait_s
        self.stale = stale


def in_words(said: object) -> str:
    """What a server or a library said, as one printable line of limited length."""
    text = " ".join(str(said).split())
    short = text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "..."
    return (short if short.isprintable() else ascii(short)) or type(said).__name__


class SafeRedirects(urllib.request.HTTPRedirectHandler):
    """Follows redirections to http and https alone, and never from https back to http."""

    def redirect_request(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: http.client.HTTPMessage,
        newurl: str,
    ) -> urllib.request.Request | None:
        scheme = urlsplit(newurl).scheme
        if scheme not in ("http", "https") or (scheme == "http" and req.type == "https"):
            raise HTTPError(newurl, code, f"redirects to {newurl}, which is not allowed", headers, fp)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


class _Metered(io.RawIOBase):
    """The bytes of a connection; while `most_s` is set, only so many and for so long."""

    def __init__(self, raw: io.RawIOBase) -> None:
        self._raw = raw
        self._until_s = math.inf
        self._left: float = math.inf

    def allow(self, most_s: float, most_bytes: float) -> None:
        """Set new limits from now on."""
        self._until_s, self._left = time.monotonic() + most_s, most_bytes

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        if time.monotonic() > self._until_s:
            raise TimeoutError("the server talks without saying anything")
        count = self._raw.readinto(buffer)
        self._left -= count or 0
        if self._left < 0:
            raise http.client.HTTPException(f"more than {MAX_HEAD_BYTES} bytes of headers or trailers")
        return count

    def close(self) -> None:
        self._raw.close()
        super().close()


class _Response(http.client.HTTPResponse):
    """A response whose headers and trailers end: `100 Continue` may come again and again, trailers without end."""

    def __init__(self, sock: socket.socket, *args: Any, **options: Any) -> None:
        super().__init__(sock, *args, **options)
        self.fp.close()
        self._metered = _Metered(sock.makefile("rb", buffering=0))
        self._most_s = sock.gettimeout() or math.inf
        self.fp = io.BufferedReader(self._metered)
        self._metered.allow(2 * self._most_s, MAX_HEAD_BYTES)

    def begin(self) -> None:
        super().begin()
        self._metered.allow(math.inf, math.inf)

    def _read_and_discard_trailer(self) -> None:
        self._metered.allow(2 * self._most_s, MAX_HEAD_BYTES)
        super()._read_and_discard_trailer()  # type: ignore[misc]


class _Http(http.client.HTTPConnection):
    response_class = _Response


class _Https(http.client.HTTPSConnection):
    response_class = _Response


class _HttpHandler(urllib.request.HTTPHandler):
    def http_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_Http, req)


class _HttpsHandler(urllib.request.HTTPSHandler):
    def https_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_Https, req)


@contextmanager
def opened(request: urllib.request.Request, silence_s: float) -> Iterator[http.client.HTTPResponse]:
    """The server's response with code 2xx, after redirections.

    Args:
        request: of an http or https address.
        silence_s: give up when the server sends nothing for so long, s.

    Raises:
        BrokenError: worth another attempt.
        BufgymError: not worth one.
    """
    try:
        response = urllib.request.build_opener(SafeRedirects, _HttpHandler, _HttpsHandler).open(
            request, timeout=silence_s
        )
    except HTTPError as error:
        error.close()
        raise _refused(request.full_url, error) from None
    except (OSError, http.client.HTTPException) as error:
        raise _unreachable(request, error) from None
    except ValueError as error:  # a redirection to something that is no host name
        raise BufgymError(f"{request.full_url}: redirects to an invalid address ({in_words(error)})") from None
    with response:
        yield response


def _refused(address: str, error: HTTPError) -> Exception:
    reason = in_words(error.reason)
    if error.code == 416:
        return BrokenError("the part on disk no longer fits the server's file", stale=True)
    if error.code in _PASSING_CODES:
        wait = error.headers.get("Retry-After", "")
        return BrokenError(f"the server says {error.code} {reason}", float(wait) if wait.isdecimal() else 0.0)
    if error.code == 404:
        return BufgymError(
            f"{address}: no such file on the server (404); it may have moved: fetch it by hand, then use --from"
        )
    return BufgymError(f"{address}: the server says {error.code} {reason}")


def _unreachable(request: urllib.request.Request, error: Exception) -> Exception:
    address = request.full_url
    reason = error.reason if isinstance(error, URLError) else error
    if isinstance(reason, socket.gaierror):
        return BufgymError(f"{address}: no network, or no such host as {request.host} ({reason.strerror})")
    if isinstance(reason, ssl.SSLCertVerificationError):
        return BufgymError(f"{address}: the server's certificate is not trusted ({reason.verify_message})")
    if isinstance(reason, OSError) and reason.errno in (errno.ENETUNREACH, errno.ENETDOWN):
        return BufgymError(f"{address}: no network ({reason.strerror})")
    if isinstance(reason, TimeoutError):
        return BrokenError("the server does not respond")
    failure = "no connection" if isinstance(error, URLError) else "the connection broke"
    return BrokenError(f"{failure} ({in_words(getattr(reason, 'strerror', None) or reason)})")

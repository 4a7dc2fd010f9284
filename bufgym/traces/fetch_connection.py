"""A connection to an http or https server, and its failures told apart: final ones, and those worth another attempt.

Proxies are taken from the environment, as usual. Redirections lead to http and https addresses only.
"""

from __future__ import annotations

import errno
import http.client
import socket
import ssl
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit

from bufgym.errors import BufgymError

_SHOWN_CHARACTERS = 200
_PASSING = frozenset({408, 425, 429, 500, 502, 503, 504})


class BrokenError(Exception):
    """What another attempt may put right.

    `wait_s` is what the server asked for; `stale` says that the part file does not fit the server's file any more.
    """

    def __init__(self, reason: str, wait_s: float = 0.0, stale: bool = False) -> None:
        super().__init__(reason)
        self.wait_s = wait_s
        self.stale = stale


def in_words(said: object) -> str:
    """What a server or a library said, fit for one line: without control characters, and no longer than a line."""
    text = " ".join(str(said).split())
    shown = text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "..."
    return (shown if shown.isprintable() else ascii(shown)) or type(said).__name__


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows to http and https alone, and never from https back to http."""

    def redirect_request(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: http.client.HTTPMessage,
        newurl: str,
    ) -> urllib.request.Request | None:
        to = urlsplit(newurl).scheme
        if to not in ("http", "https") or (to == "http" and req.type == "https"):
            raise HTTPError(newurl, code, f"redirects to {newurl}, which is not allowed", headers, fp)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _opener() -> urllib.request.OpenerDirector:
    """No handlers of file:, ftp: or data: addresses."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        urllib.request.HTTPHandler(),
        urllib.request.HTTPSHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
        _Redirects(),
    ):
        opener.add_handler(handler)
    return opener


@contextmanager
def opened(request: urllib.request.Request, silence_s: float) -> Iterator[http.client.HTTPResponse]:
    """The answer with code 2xx, redirections followed.

    Raises:
        BrokenError: worth another attempt.
        BufgymError: not worth one.
    """
    try:
        response = _opener().open(request, timeout=silence_s)
    except HTTPError as error:
        error.close()
        raise _refused(request.full_url, error) from None
    except URLError as error:
        raise _unreached(request, error.reason) from None
    except TimeoutError:
        raise BrokenError("the server does not answer") from None
    except (OSError, http.client.HTTPException) as error:
        raise BrokenError(f"the connection broke ({in_words(error)})") from None
    except ValueError as error:  # of a host's name that is none, in the address of a redirection
        raise BufgymError(f"{request.full_url}: leads to an address that is none ({in_words(error)})") from None
    with response:
        yield response


def _refused(address: str, error: HTTPError) -> Exception:
    reason = in_words(error.reason)
    if error.code == 416:
        return BrokenError("the part that is there does not fit the file any more", stale=True)
    if error.code in _PASSING:
        wait = error.headers.get("Retry-After", "")
        return BrokenError(f"the server says {error.code} {reason}", float(wait) if wait.isdecimal() else 0.0)
    if error.code == 404:
        return BufgymError(
            f"{address}: no such file on the server (404): it may have moved; fetch it by hand, then --from"
        )
    return BufgymError(f"{address}: the server says {error.code} {reason}")


def _unreached(request: urllib.request.Request, reason: object) -> Exception:
    if isinstance(reason, socket.gaierror):
        return BufgymError(f"{request.full_url}: no network, or no such host as {request.host} ({reason.strerror})")
    if isinstance(reason, ssl.SSLCertVerificationError):
        return BufgymError(f"{request.full_url}: the server's certificate is not trusted ({reason.verify_message})")
    if isinstance(reason, OSError) and reason.errno in (errno.ENETUNREACH, errno.ENETDOWN):
        return BufgymError(f"{request.full_url}: no network ({reason.strerror})")
    if isinstance(reason, TimeoutError):
        return BrokenError("the server does not answer")
    return BrokenError(f"no connection ({in_words(getattr(reason, 'strerror', None) or reason)})")

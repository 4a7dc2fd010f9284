"""Signing in at the page, in a browser: at a made-up issuer, renewed before the token's end, and out again."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from loop_cases import compiled
from needs import needs

for library in ("websockets", "re2", "jwt", "cryptography", "rosbags"):
    pytest.importorskip(library, reason=needs("extras", library))

from issuer_cases import SignInServer  # noqa: E402
from page_cases import Fleet  # noqa: E402
from test_page import until  # noqa: E402

from bufgym_relay.config import Rule  # noqa: E402

pytestmark = compiled
RULES = tuple(Rule(email=f"{name}@x.org", send=True, receive=True) for name in ("anna", "fleet"))
SIGNED_IN, ASKED = "#state:text-is('live') ~ #you:text-is('you are anna@x.org')", "#ask[open]"
TOKEN = "sessionStorage.getItem('token')"


@pytest.fixture
def issuer(tmp_path: Path) -> Iterator[SignInServer]:
    with SignInServer(tmp_path) as one:
        yield one


@contextmanager
def visiting(browser: Any, issuer: SignInServer) -> Iterator[Any]:
    """The page of a relay that lets in by email alone, before anybody has signed in; the page may say no error."""
    with Fleet(issuer.issuer.token(email="fleet@x.org"), rules=RULES, tokens=issuer.tokens) as fleet:
        fleet.robots["r1"] = ({}, ())
        page = browser.new_page()
        page.set_default_timeout(120_000)
        said: list[str] = []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(f"http://127.0.0.1:{fleet.port}/#/robot/r1/health")
        page.wait_for_selector(ASKED)
        yield page
        page.close()
        assert said == []


def sign_in(page: Any) -> None:
    page.click("#to-issuer")
    page.click("#yes")


def text(page: Any, selector: str) -> str:
    return str(page.text_content(selector))


def test_somebody_signs_in_and_out(browser: Any, issuer: SignInServer) -> None:
    """The address stays what it was, a reload asks nobody, and whoever is out stays out."""
    with visiting(browser, issuer) as page:
        assert text(page, "#ask-title") == "Who are you?"
        before = page.url
        sign_in(page)
        page.wait_for_selector(SIGNED_IN)
        page.wait_for_selector(".called:text-is('r1')")
        assert page.url == before and page.is_hidden(ASKED)
        page.reload()
        page.wait_for_selector(SIGNED_IN)
        assert [fields["grant_type"] for fields in issuer.asked] == ["authorization_code"]
        page.click("#sign")
        page.wait_for_selector(ASKED)
        assert page.evaluate("[...Object.keys(sessionStorage)].filter(key => key !== 'layers').length") == 0
        assert text(page, "#ask-title") == "Who are you?" and not issuer.is_known


def test_a_code_that_this_page_did_not_ask_for_is_not_used(browser: Any, issuer: SignInServer) -> None:
    with visiting(browser, issuer) as page:
        page.goto(page.url.replace("#", "?code=code-0&state=theirs#"))
        page.wait_for_selector(ASKED)
        assert text(page, "#why").endswith("Somebody else began to sign in.")
        assert "code" not in page.url and issuer.asked == []


def test_who_may_nothing_is_told_who_the_relay_takes_him_for(browser: Any, issuer: SignInServer) -> None:
    issuer.email = "bob@x.org"
    with visiting(browser, issuer) as page:
        sign_in(page)
        page.wait_for_selector(ASKED)
        assert text(page, "#ask-title") == "Not authorized"
        assert text(page, "#why") == "You are bob@x.org. The relay says: no rule allows anything to this identity."
        issuer.email = "anna@x.org"
        sign_in(page)  # as somebody else
        page.wait_for_selector(SIGNED_IN)


def test_a_token_is_renewed_before_its_end(browser: Any, issuer: SignInServer) -> None:
    """The connection ends with each token, and the next one has the next token; nobody is asked."""
    issuer.life_s = 2.0
    with visiting(browser, issuer) as page:
        sign_in(page)
        page.wait_for_selector(SIGNED_IN)
        page.evaluate("void (document.querySelector('#ask').showModal = () => { window.was_asked = true; })")
        for _ in range(2):
            before = page.evaluate(TOKEN)
            until(page, f"{TOKEN} !== {before!r}")
        page.wait_for_selector(SIGNED_IN)
        assert not page.evaluate("window.was_asked === true")
        assert {fields["grant_type"] for fields in issuer.asked[1:]} == {"refresh_token"}


def test_a_token_that_cannot_be_renewed_is_asked_for_unseen(browser: Any, issuer: SignInServer) -> None:
    """The issuer still knows the browser, until it does not: then a person is asked."""
    issuer.life_s, issuer.renews = 2.0, False
    with visiting(browser, issuer) as page:
        sign_in(page)
        while len(issuer.asked) < 2:
            page.wait_for_timeout(20)
        page.wait_for_selector(SIGNED_IN)
        issuer.is_known = False
        page.wait_for_selector(ASKED)
        assert text(page, "#why").endswith("Your time is over.")
        assert {fields["grant_type"] for fields in issuer.asked} == {"authorization_code"}

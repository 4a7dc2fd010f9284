"""A relay's configuration: permissions and limits. ``examples/relay.toml`` has every table.

Whatever no rule allows is denied, so a configuration without rules serves nobody.
"""

import ipaddress
import re
from pathlib import Path
from typing import Annotated, Any, Final
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from bufgym.model.checks import MAX_WINDOW
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import read_toml
from bufgym_robot.wire.orders import COMMAND_S
from bufgym_robot.wire.patterns import pattern

PORT: Final = 7420
NO_DROP: Final = ("/robots/[^/]+/command",)
LATCHED: Final = ("/robots/[^/]+/(.+/)?(map|tf_static)",)
SKIP_PENDING: Final = "skip-pending"  # Robofleet's server rule, a policy of the relay alone
POLICIES: Final = ("robofleet", SKIP_PENDING, "drop-oldest", "drop-newest", "afr", "min-motion-gap", "ros-native")
"""Policies that a viewer may choose; each is compiled at its first use."""
DEFAULT_CAPACITY: Final = 32
ALGORITHMS: Final = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA")
"""Accepted signatures, all by private key; with a shared secret every verifier could sign."""

Text = Annotated[str, Meta(min_length=1, pattern="^[^\\x00-\\x1f\\x7f]*$")]
Count = Annotated[int, Meta(ge=1, le=2**40)]
Seconds = Annotated[float, Meta(gt=0, le=1e12)]
Port = Annotated[int, Meta(ge=0, le=65_535)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A section of the configuration; ``load`` checks the types and ranges of its fields."""


class Rule(Section, frozen=True, kw_only=True):
    """Robofleet's rule: an identity, send or receive, and a pattern that matches whole topics."""

    address: str = ""
    """An IP address, or a range as ``10.0.0.0/8``."""
    email: str = ""
    """E-mail of a token or of a client's certificate, in any case of ASCII letters."""
    recorder: bool = False
    """For the relay's recorder, which writes what it may receive."""
    foxglove: bool = False
    """For everybody who connects to the port of ``[foxglove]``."""
    nats: bool = False
    """For other relays: what they may send here, and receive from here."""
    send: bool = False
    """May publish on the topics."""
    receive: bool = False
    """May get messages of the topics."""
    topic: str = ".*"
    """Pattern of topics."""
    command_s: Seconds = COMMAND_S
    """Time for which a command of this sender may be executed, s."""
    speed: Annotated[float, Meta(gt=0, le=100)] = 3.0
    """Largest velocity on ``drive`` and in a ``Twist``, m/s and rad/s."""

    def __post_init__(self) -> None:
        if sum(map(bool, (self.address, self.email, self.recorder, self.foxglove, self.nats))) != 1:
            who = "an address, an email, recorder = true, foxglove = true, or nats = true"
            raise BufgymError(f"rule: needs one identity: {who}")
        if not (self.send or self.receive):
            raise BufgymError("rule: must allow send or receive")
        if self.address:
            try:
                ipaddress.ip_network(self.address)
            except ValueError:
                raise BufgymError(f"rule: address = {self.address!r}: {_address_rule(self.address)}") from None
        if not self.email.isprintable():
            raise BufgymError(f"rule: email = {self.email!r}: must be a text")
        _check_pattern("topic", self.topic)

    @property
    def own(self) -> str:
        """The relay's own part that the rule is for, "recorder", "foxglove" or "nats"; empty for a client."""
        return next((part for part in ("recorder", "foxglove", "nats") if getattr(self, part)), "")


def _address_rule(text: str) -> str:
    """Say what an address must be that is none."""
    try:
        network = ipaddress.ip_network(text, strict=False)
    except ValueError:
        return "must be an IP address or a range as 10.0.0.0/8"
    return f"is within a range; did you mean the range '{network}' or the address {text.partition('/')[0]!r}?"


def _check_pattern(name: str, text: str) -> None:
    """Refuse what RE2 or a client cannot read, naming the key."""
    try:
        pattern(text)
    except BufgymError as error:
        raise BufgymError(f"{name}: {error}") from None


class Limits(Section, frozen=True):
    """Limits of one identity over all its connections, unless a field says otherwise.

    The defaults admit 60 robots behind one address, with ten topics of 10 messages a second each.
    """

    message_bytes: Annotated[int, Meta(ge=1, le=2**25)] = 2**23
    """Size of one message."""
    topics: Count = 1_024
    """Topics it publishes on."""
    subscriptions: Count = 512
    """Subscriptions at a time, and durable ones kept. A long pattern counts as several."""
    queues: Count = 1_024
    """Queues of its subscriptions. Beyond, topics share. A queue of capacity 1,000 takes 0.1 MB."""
    sessions: Count = 256
    """Sessions kept. A new one replaces the one away for longest."""
    connections: Count = 128
    """Connections at a time; of one address, also those without a hello."""
    messages_per_s: Count = 10_000
    """Messages a second, and as many pings, pongs and fragments."""
    bytes_per_s: Count = 10**8
    """Bytes of payloads a second."""
    json_bytes_per_s: Count = 2**22
    """Bytes of JSON parsed a second. Beyond, its frames wait."""
    incoming_bytes: Count = 2**26
    """Bytes not taken yet. Beyond, the connection that waits longest ends."""
    identities: Count = 4
    """Factor on incoming bytes, queues, sessions and JSON for all identities of one address together."""
    all_connections: Count = 4_096
    """Connections of all identities together."""
    hello_s: Seconds = 5.0
    """Time from the connection to its hello, s."""

    def __post_init__(self) -> None:
        if self.incoming_bytes < 2 * self.message_bytes:
            least = f"must be at least {2 * self.message_bytes}, two messages of message_bytes"
            raise BufgymError(f"limits: incoming_bytes = {self.incoming_bytes}: {least}")


class StoreLimits(Section, frozen=True):
    """Limits of the store, which holds no_drop messages until their receivers have acked them."""

    messages: Count = 1_000
    """Messages held for one receiver. A further one is refused, or replaces the oldest where another has room."""
    bytes: Count = 2**26
    """Bytes held in total. Beyond, who has the most loses its oldest, or the sender is refused."""
    keep_s: Seconds = 86_400.0
    """Absence after which a session is forgotten, s. A restart begins the count again."""
    window: Annotated[int, Meta(ge=1, le=MAX_WINDOW)] = 5
    """n_T: most unacked no_drop messages on their way, each direction."""


class Tls(Section, frozen=True):
    """Certificates, PEM files."""

    certificate: Text
    """The relay's certificate, a PEM file, as the others."""
    key: Text
    """Its private key."""
    clients: str = ""
    """Authority that signs clients' certificates. Empty: clients are not asked for one."""


class Tokens(Section, frozen=True):
    """JSON web tokens, as an OpenID provider issues them."""

    issuer: Text
    """Issuer that a token must name (``iss``)."""
    audience: Text
    """Audience that a token must name (``aud``)."""
    keys: Text
    """The issuer's key set (JWKS): an https URL, or a file."""
    algorithms: tuple[str, ...] = ("RS256", "ES256", "EdDSA")
    """Accepted signatures, with public keys only."""
    leeway_s: Annotated[float, Meta(ge=0, le=1e6)] = 10.0
    """Allowed difference between clocks, s."""
    client: str = ""
    """The page's client id at the issuer, and an accepted audience. Empty: the page asks for a token."""
    scope: Text = "openid email"
    """Scope that the page asks for. Many issuers renew a token only with ``offline_access``."""
    endpoints: tuple[str, ...] = ()
    """Origins of the issuer's token endpoint, if not the issuer's own."""

    def __post_init__(self) -> None:
        unknown = sorted(set(self.algorithms) - set(ALGORITHMS))
        if unknown or not self.algorithms:
            raise BufgymError(f"tokens: algorithms = {list(self.algorithms)}: must be of {', '.join(ALGORITHMS)}")
        urls = [("keys", self.keys)] if "://" in self.keys else []
        if self.client:
            urls += [("issuer", self.issuer), *(("endpoints", url) for url in self.endpoints)]
        for name, url in urls:
            if not _is_safe(url):
                raise BufgymError(f"tokens: {name} = {url!r}: must be an https address")

    @property
    def origins(self) -> tuple[str, ...]:
        """Servers from which the page fetches what it needs to sign in."""
        urls = map(urlsplit, (self.issuer, *self.endpoints) if self.client else ())
        return tuple(f"{url.scheme}://{url.netloc}" for url in urls)


def _is_safe(url: str) -> bool:
    """Whether nobody can listen on the way to this address; nor does it say more to a header that it stands in."""
    try:
        parts = urlsplit(url)
        host = parts.hostname or ""
        if parts.scheme == "http" and host != "localhost":
            return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and host != "" and not set(parts.netloc) & set(" ;,'*@")


class Nats(Section, frozen=True):
    """A NATS server with JetStream, over which relays share messages (extra ``mesh``)."""

    url: str
    """``nats://HOST:PORT`` or ``tls://HOST:PORT``, with JetStream."""
    name: str
    """This relay's name, which no other relay has."""
    credentials: str = ""
    """File of a user's credentials (``.creds``)."""
    authority: str = ""
    """PEM file of who signs the server's certificate. Empty: the system's."""
    late_s: Seconds = 2.0
    """Delay beyond the usual after which an ordinary message is dropped, s."""

    def __post_init__(self) -> None:
        if re.fullmatch("(nats|tls)://[^/ ]+", self.url) is None:
            raise BufgymError(f"nats: url = {self.place!r}: must be nats://HOST:PORT or tls://HOST:PORT")
        if re.fullmatch("[A-Za-z0-9_-]{1,32}", self.name) is None:
            raise BufgymError(f"nats: name = {self.name!r}: must be 1 to 32 letters, digits, _ or -")
        try:
            _ = urlsplit(self.url).port
        except ValueError:
            rule = "must be nats://HOST:PORT, with %23 and the like for signs in a password"
            raise BufgymError(f"nats: url = {self.place!r}: {rule}") from None

    @property
    def place(self) -> str:
        """The URL without its user and password."""
        scheme, mark, rest = self.url.rpartition("://")
        return f"{scheme}{mark}{rest.rpartition('@')[2]}"


class Foxglove(Section, frozen=True):
    """Address for Foxglove and Lichtblick (extra ``foxglove``); they see what rules with ``foxglove`` allow."""

    host: Text = "127.0.0.1"
    """Address to listen at. It asks nobody for an identity."""
    port: Port = 8765
    """Port."""


class Rotation(Section, frozen=True):
    """Rotation of a log: a full file is followed by the next, and the oldest is deleted."""

    bytes: Annotated[int, Meta(ge=1_000, le=2**40)] = 2**26
    """Size of a file."""
    files: Annotated[int, Meta(ge=1, le=10**6)] = 16
    """Files kept."""


class Config(Section, frozen=True, kw_only=True):
    """The whole configuration."""

    host: Text = "127.0.0.1"
    """Address to listen at. ``0.0.0.0`` is every network: then use ``[tls]``."""
    port: Port = PORT
    """Port. 0: any free one."""
    rules: tuple[Rule, ...] = ()
    no_drop: tuple[str, ...] = NO_DROP
    """Patterns of topics whose messages may not be lost."""
    latched: tuple[str, ...] = LATCHED
    """Patterns of topics whose last message a new subscriber gets. 64 MiB in memory."""
    policies: Annotated[tuple[str, ...], Meta(min_length=1)] = POLICIES
    """Policies for subscribers' queues. The first is the default."""
    origins: tuple[str, ...] = ()
    """Web pages that may connect beside the relay's own, as ``https://example.org``. Behind a proxy: its own, too."""
    robofleet: bool = False
    """Robofleet's released clients may connect, under the same rules."""
    folder: Path | None = None
    """Folder of held messages, stops, audit log and recordings. Without it, they end with the relay."""
    small_buffers: bool = True
    """Little waits unsent in the system's buffers, where no policy can drop it."""
    limits: Limits = Limits()
    store: StoreLimits = StoreLimits()
    audit: Rotation = Rotation()
    recording: Rotation = Rotation(bytes=2**30)
    """Rotation of the recorder's MCAP files."""
    tls: Tls | None = None
    tokens: Tokens | None = None
    nats: Nats | None = None
    foxglove: Foxglove | None = None

    def __post_init__(self) -> None:
        for name in ("no_drop", "latched"):
            for text in getattr(self, name):
                _check_pattern(name, text)
        for origin in self.origins:
            scheme, _, place = origin.partition("://")
            if scheme not in ("http", "https") or not place or set(place) & set("/ ,*"):
                raise BufgymError(f"origins = {origin!r}: must be as https://example.org, without a path")


def load(path: str | Path) -> Config:
    """Read the configuration from a TOML file; paths in it are relative to its folder.

    Raises BufgymError with one line that names the file if it can't be read or breaks a rule.
    """
    folder = Path(path).parent

    def read(kind: Any, value: Any) -> Any:
        if kind is Path and isinstance(value, str):
            return folder / value
        raise BufgymError("must be a text in quotes")

    table = read_toml(path)
    try:
        config = msgspec.convert(table, Config, dec_hook=read)
    except msgspec.ValidationError as error:
        from bufgym_relay.faults import fault  # not at start-up: few files have one

        raise fault(path, table, error) from None
    return replace(
        config,
        tls=_beside(folder, config.tls, "certificate", "key", "clients"),
        nats=_beside(folder, config.nats, "credentials", "authority"),
        tokens=_beside(folder, config.tokens, "keys"),
    )


def _beside(folder: Path, table: Any, *names: str) -> Any:
    """Resolve the table's file names in this folder; a URL stays as it is."""
    files = {name: getattr(table, name, "") for name in names}
    own = {name: str(folder / file) for name, file in files.items() if file and "://" not in file}
    return table and replace(table, **own)

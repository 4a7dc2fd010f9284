"""A relay's configuration: permissions and limits. ``examples/relay.toml`` has every table.

Whatever no rule allows is denied, so a configuration without rules serves nobody.
"""

import ipaddress
from pathlib import Path
from typing import Annotated, Any, Final
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from bufgym.model.checks import MAX_WINDOW
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import read_toml
from bufgym_live.relay.orders import COMMAND_S
from bufgym_live.relay.patterns import pattern

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
    """E-mail of a token or of a client's certificate."""
    recorder: bool = False
    """Whether the rule is for the relay's own recorder."""
    foxglove: bool = False
    """Whether the rule is for everybody who connects to the relay's Foxglove server."""
    nats: bool = False
    """Whether the rule is for the other relays: what they may send to this one, and receive from it."""
    send: bool = False
    receive: bool = False
    topic: str = ".*"
    command_s: Seconds = COMMAND_S
    """Time after which a robot does not execute a command sent under this rule; its sender may say less."""
    speed: Annotated[float, Meta(gt=0, le=100)] = 3.0
    """Largest velocity that is sent on to a robot under this rule, m/s and rad/s."""

    def __post_init__(self) -> None:
        if sum(map(bool, (self.address, self.email, self.recorder, self.foxglove, self.nats))) != 1:
            who = "an address, an email, recorder = true, foxglove = true, or nats = true"
            raise BufgymError(f"rule: needs one identity: {who}")
        if not (self.send or self.receive):
            raise BufgymError("rule: must allow send or receive")
        if self.address:
            try:
                ipaddress.ip_network(self.address)
            except ValueError as error:
                raise BufgymError(f"rule: address = {self.address!r}: {error}") from None
        if not self.email.isprintable():
            raise BufgymError(f"rule: email = {self.email!r}: must be a text")
        pattern(self.topic)

    @property
    def own(self) -> str:
        """The relay's own part that the rule is for, "recorder", "foxglove" or "nats"; empty for a client."""
        return next((part for part in ("recorder", "foxglove", "nats") if getattr(self, part)), "")


class Limits(Section, frozen=True):
    """Limits of one identity over all its connections, unless a field says otherwise.

    The defaults admit 60 robots behind one address, with ten topics of 10 messages a second each.
    """

    message_bytes: Annotated[int, Meta(ge=1, le=2**25)] = 2**23
    """Size of a frame."""
    topics: Count = 1_024
    """Topics that it publishes on."""
    subscriptions: Count = 512
    """Subscriptions at a time, and durable ones that the relay keeps. A long pattern counts as several."""
    queues: Count = 1_024
    """Queues of its subscriptions; beyond, topics of a subscription share. One of capacity 1,000 takes 0.1 MB."""
    sessions: Count = 256
    """Sessions that the relay keeps, with the messages held for them."""
    connections: Count = 128
    messages_per_s: Count = 10_000
    """Messages; and as many pings, pongs and pieces of messages."""
    bytes_per_s: Count = 10**8
    json_bytes_per_s: Count = 2**22
    """Bytes of JSON that it may have parsed; beyond, its frames wait. A text frame counts for 500 bytes more."""
    incoming_bytes: Count = 2**26
    """Bytes that have come and are not a whole message yet, or not taken. Beyond, the connection ends that waits
    longest."""
    identities: Count = 4
    """How many times the incoming bytes, queues, sessions and JSON (so replays, too) of one identity all identities of
    one address may have."""
    all_connections: Count = 4_096
    """Connections of all identities together."""
    hello_s: Seconds = 5.0
    """Time from the connection to its hello."""

    def __post_init__(self) -> None:
        if self.incoming_bytes < 2 * self.message_bytes:
            least = f"must be at least {2 * self.message_bytes}, two messages of message_bytes"
            raise BufgymError(f"limits: incoming_bytes = {self.incoming_bytes}: {least}")


class StoreLimits(Section, frozen=True):
    """Limits of the store, which holds no_drop messages until their receivers have acked them."""

    messages: Count = 1_000
    """Messages held for one session. A further one is refused, unless others can take it: then the oldest here goes."""
    bytes: Count = 2**26
    """Bytes held in total. The identity for which the most is held loses its oldest, or gets no more."""
    keep_s: Seconds = 86_400.0
    """Absence after which a session is forgotten, with the messages held for it. Only time in which the relay runs
    counts, and a restart begins it again; the system's clock may jump."""
    window: Annotated[int, Meta(ge=1, le=MAX_WINDOW)] = 5
    """n_T, no_drop messages on their way to or from a client and not acked, at most."""


class Tls(Section, frozen=True):
    """Certificates, PEM files."""

    certificate: Text
    key: Text
    clients: str = ""
    """Authority that signs clients' certificates; if empty, clients are not asked for certificates."""


class Tokens(Section, frozen=True):
    """JSON web tokens, as an OpenID provider issues them."""

    issuer: Text
    audience: Text
    keys: Text
    """The issuer's key set (JWKS), a URL or a file. It is read again when a token names an unknown key or the file has
    changed."""
    algorithms: tuple[str, ...] = ("RS256", "ES256", "EdDSA")
    leeway_s: Annotated[float, Meta(ge=0, le=1e6)] = 10.0
    """Allowed difference between clocks."""
    client: str = ""
    """The page's client id at the issuer, with which it signs people in; empty if it asks for a token. Identity tokens
    have it as their audience, so it is one that the relay takes."""
    scope: Text = "openid email"
    """What the page asks the issuer for; many renew a token only with ``offline_access``."""
    endpoints: tuple[str, ...] = ()
    """Origins of the issuer's token endpoint, as ``https://tokens.example.org``, if it is not the issuer's own."""

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

    url: Annotated[str, Meta(pattern="^(nats|tls)://[^/ ]+$")]
    """``nats://HOST:PORT`` or ``tls://HOST:PORT``."""
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,32}$")]
    """This relay's name among the others. Its place in their commands is kept under it."""
    credentials: str = ""
    """The server's file of a user's credentials (``.creds``); empty if it wants none."""
    authority: str = ""
    """PEM file of the authority that signs the server's certificate; empty for the system's."""
    late_s: Seconds = 2.0
    """Time beyond its relay's usual delay after which a message, other than a no_drop one, is dropped as late."""

    def __post_init__(self) -> None:
        try:
            _ = urlsplit(self.url).port
        except ValueError:
            rule = "must be nats://HOST:PORT, with %23 and the like for signs in a password"
            raise BufgymError(f"nats: url = {self.place!r}: {rule}") from None

    @property
    def place(self) -> str:
        """The URL without its user and password."""
        scheme, _, rest = self.url.partition("://")
        return f"{scheme}://{rest.rpartition('@')[2]}"


class Foxglove(Section, frozen=True):
    """Address for Foxglove and Lichtblick (extra ``foxglove``); they see what rules with ``foxglove`` allow."""

    host: Text = "127.0.0.1"
    port: Port = 8765


class Rotation(Section, frozen=True):
    """Rotation of a log: a full file is followed by the next, and the oldest is deleted."""

    bytes: Annotated[int, Meta(ge=1_000, le=2**40)] = 2**26
    files: Annotated[int, Meta(ge=1, le=10**6)] = 16


class Config(Section, frozen=True, kw_only=True):
    """The whole configuration."""

    host: Text = "127.0.0.1"
    port: Port = PORT
    """Port; 0 for any that is free."""
    rules: tuple[Rule, ...] = ()
    no_drop: tuple[str, ...] = NO_DROP
    """Patterns of lossless topics; each must match the whole topic."""
    latched: tuple[str, ...] = LATCHED
    """Patterns of topics whose last message a new subscriber gets, too; as ROS does for latched topics."""
    policies: Annotated[tuple[str, ...], Meta(min_length=1)] = POLICIES
    """Policies of subscribers' queues; the first is the default."""
    origins: tuple[str, ...] = ()
    """Web pages of other servers that may connect, as ``https://example.org``."""
    robofleet: bool = False
    """Whether Robofleet's released clients may connect, on any path but ours, under the same rules."""
    folder: Path | None = None
    """Folder for held messages, the audit log and recordings; without it they end with the relay."""
    small_buffers: bool = True
    """Whether little waits unsent in the system's buffers to clients, where no policy can drop it."""
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
        for text in self.no_drop + self.latched:
            pattern(text)


def load(path: str | Path) -> Config:
    """Read the configuration from a TOML file; paths in it are relative to its folder.

    Raises BufgymError with one line that names the file if it can't be read or breaks a rule.
    """
    folder = Path(path).parent

    def read(kind: Any, value: Any) -> Any:
        if kind is Path and isinstance(value, str):
            return folder / value
        raise BufgymError(f"{value!r}: must be a text")

    try:
        config = msgspec.convert(read_toml(path), Config, dec_hook=read)
    except msgspec.ValidationError as error:
        raise BufgymError(f"{path}: {error}") from None
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

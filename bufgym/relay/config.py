"""A relay's configuration: permissions and limits. ``examples/relay.toml`` has every table.

Whatever no rule allows is denied, so a configuration without rules serves nobody.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from bufgym.ground.errors import BufgymError
from bufgym.ground.files import check_keys, read_toml
from bufgym.model.checks import above_0, check_window, whole
from bufgym.relay.patterns import pattern

PORT: Final = 7420
NO_DROP: Final = ("/robots/[^/]+/command",)
POLICIES: Final = ("robofleet", "skip-pending", "drop-oldest", "drop-newest", "afr", "min-motion-gap", "ros-native")
"""Policies that a viewer may choose; each is compiled at its first use."""
DEFAULT_CAPACITY: Final = 32
ALGORITHMS: Final = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA")
"""Accepted signatures, all by private key; with a shared secret every verifier could sign."""


@dataclass(frozen=True)
class Rule:
    """Robofleet's rule: an identity, send or receive, and a pattern that matches whole topics."""

    address: str = ""
    """An IP address, or a range as ``10.0.0.0/8``."""
    email: str = ""
    """E-mail of a token or of a client's certificate."""
    recorder: bool = False
    """Whether the rule is for the relay's own recorder."""
    foxglove: bool = False
    """Whether the rule is for everybody who connects to the relay's Foxglove server."""
    send: bool = False
    receive: bool = False
    topic: str = ".*"

    def __post_init__(self) -> None:
        own = (self.recorder is True) + (self.foxglove is True)
        if (self.address != "") + (self.email != "") + own != 1:
            raise BufgymError("rule: needs one identity: an address, an email, recorder = true, or foxglove = true")
        for name in ("send", "receive", "recorder", "foxglove"):
            if not isinstance(getattr(self, name), bool):
                raise BufgymError(f"rule: {name} = {getattr(self, name)!r}: must be true or false")
        if not (self.send or self.receive):
            raise BufgymError("rule: must allow send or receive")
        if self.address:
            try:
                ipaddress.ip_network(self.address)
            except ValueError as error:
                raise BufgymError(f"rule: address = {self.address!r}: {error}") from None
        elif self.email and (not isinstance(self.email, str) or not self.email.isprintable()):
            raise BufgymError(f"rule: email = {self.email!r}: must be a text")
        pattern(self.topic)

    @property
    def own(self) -> str:
        """The relay's own part that the rule is for, "recorder" or "foxglove"; empty for a client."""
        return "recorder" if self.recorder else "foxglove" if self.foxglove else ""


@dataclass(frozen=True)
class Limits:
    """Limits of one identity over all its connections, unless a field says otherwise."""

    message_bytes: int = 2**23
    """Size of a frame."""
    topics: int = 256
    """Topics that it publishes on."""
    subscriptions: int = 64
    sessions: int = 64
    """Sessions that the relay keeps, with the messages held for them."""
    connections: int = 32
    messages_per_s: int = 2_000
    bytes_per_s: int = 10**8
    all_connections: int = 4_096
    """Connections of all identities together."""
    hello_s: float = 5.0
    """Time from the connection to its hello."""

    def __post_init__(self) -> None:
        for each in fields(self):
            if each.type == "int":
                whole(f"limits: {each.name}", getattr(self, each.name), 1, 2**40)
        above_0("limits: hello_s", self.hello_s)


@dataclass(frozen=True)
class Store:
    """Limits of the store, which holds no_drop messages until their receivers have acked them."""

    messages: int = 1_000
    """Messages held for one session; further messages are refused to their sender."""
    bytes: int = 2**26
    """Bytes held in total."""
    keep_s: float = 86_400.0
    """Absence after which a session is forgotten, with the messages held for it."""
    window: int = 5
    """n_T, no_drop messages on their way to or from a client and not acked, at most."""

    def __post_init__(self) -> None:
        whole("store: messages", self.messages, 1, 2**31)
        whole("store: bytes", self.bytes, 1, 2**40)
        above_0("store: keep_s", self.keep_s)
        check_window(self.window)


@dataclass(frozen=True)
class Tls:
    """Certificates, PEM files."""

    certificate: str
    key: str
    clients: str = ""
    """Authority that signs clients' certificates; if empty, clients are not asked for certificates."""


@dataclass(frozen=True)
class Tokens:
    """JSON web tokens, as an OpenID provider issues them."""

    issuer: str
    audience: str
    keys: str
    """The issuer's key set (JWKS), a URL or a file. It is read again when a token names an unknown key."""
    algorithms: tuple[str, ...] = ("RS256", "ES256", "EdDSA")
    leeway_s: float = 10.0
    """Allowed difference between clocks."""

    def __post_init__(self) -> None:
        for name in ("issuer", "audience", "keys"):
            if not isinstance(getattr(self, name), str) or not getattr(self, name):
                raise BufgymError(f"tokens: {name} = {getattr(self, name)!r}: must be a text")
        unknown = sorted(set(self.algorithms) - set(ALGORITHMS))
        if unknown or not self.algorithms:
            raise BufgymError(f"tokens: algorithms = {list(self.algorithms)}: must be of {', '.join(ALGORITHMS)}")


@dataclass(frozen=True)
class Mesh:
    """Other relays that share topics with this one (extra ``zenoh``)."""

    listen: str
    """HOST:PORT for other relays. Whoever connects there is trusted as a relay."""
    connect: tuple[str, ...] = ()
    """Addresses where others listen; each relay needs to know one."""
    certificate: str = ""
    """PEM files: own certificate and key, and the authority that signs the others' certificates; empty for no TLS."""
    key: str = ""
    authority: str = ""

    def __post_init__(self) -> None:
        for address in (self.listen, *self.connect):
            host, colon, port = address.rpartition(":") if isinstance(address, str) else ("", "", "")
            if not (host and colon and port.isdecimal() and 0 < int(port) <= 65_535):
                raise BufgymError(f"mesh: address {address!r}: must be HOST:PORT")
        files = self.certificate, self.key, self.authority
        if not all(isinstance(name, str) for name in files) or any(files) != all(files):
            raise BufgymError("mesh: certificate, key and authority: must be given together")


@dataclass(frozen=True)
class Foxglove:
    """Address for Foxglove and Lichtblick (extra ``foxglove``); they see what rules with ``foxglove`` allow."""

    host: str = "127.0.0.1"
    port: int = 8765

    def __post_init__(self) -> None:
        if not isinstance(self.host, str) or not self.host:
            raise BufgymError(f"foxglove: host = {self.host!r}: must be a text")
        whole("foxglove: port", self.port, 0, 65_535)


@dataclass(frozen=True)
class Rotation:
    """Rotation of a log: a full file is followed by the next, and the oldest is deleted."""

    bytes: int = 2**26
    files: int = 16

    def __post_init__(self) -> None:
        whole("bytes", self.bytes, 1_000, 2**40)
        whole("files", self.files, 1, 10**6)


@dataclass(frozen=True)
class Config:
    """The whole configuration."""

    host: str = "127.0.0.1"
    port: int = PORT
    """Port; 0 for any that is free."""
    rules: tuple[Rule, ...] = ()
    no_drop: tuple[str, ...] = NO_DROP
    """Patterns of lossless topics; each must match the whole topic."""
    policies: tuple[str, ...] = POLICIES
    """Policies of subscribers' queues; the first is the default."""
    origins: tuple[str, ...] = ()
    """Web pages of other servers that may connect, as ``https://example.org``."""
    robofleet: bool = False
    """Whether Robofleet's released clients may connect, on any path but ours, under the same rules."""
    folder: Path | None = None
    """Folder for held messages, the audit log and recordings; without it they end with the relay."""
    small_buffers: bool = True
    """Whether the system's buffers to clients are small; no policy can drop the messages in them."""
    limits: Limits = Limits()
    store: Store = Store()
    audit: Rotation = Rotation()
    recording: Rotation = field(default_factory=lambda: Rotation(bytes=2**30))
    """Rotation of the recorder's MCAP files."""
    tls: Tls | None = None
    tokens: Tokens | None = None
    mesh: Mesh | None = None
    foxglove: Foxglove | None = None

    def __post_init__(self) -> None:
        whole("port", self.port, 0, 65_535)
        for name in ("robofleet", "small_buffers"):
            if not isinstance(getattr(self, name), bool):
                raise BufgymError(f"{name} = {getattr(self, name)!r}: must be true or false")
        for name in ("no_drop", "policies", "origins"):
            texts = getattr(self, name)
            if not isinstance(texts, tuple) or not all(isinstance(text, str) for text in texts):
                raise BufgymError(f"{name} = {texts!r}: must be a list of texts")
        for text in self.no_drop:
            pattern(text)
        if not self.policies:
            raise BufgymError("policies: needs at least one, the default")


_TABLES: Final[Mapping[str, Any]] = {
    "limits": Limits,
    "store": Store,
    "audit": Rotation,
    "recording": Rotation,
    "tls": Tls,
    "tokens": Tokens,
    "mesh": Mesh,
    "foxglove": Foxglove,
}


def load(path: str | Path) -> Config:
    """Read the configuration from a TOML file; paths in it are relative to its folder.

    Raises BufgymError with one line that names the file if it can't be read or breaks a rule.
    """
    beside = Path(path).parent
    try:
        tables = read_toml(path)
        settings: dict[str, Any] = {}
        for key, value in tables.items():
            if key == "rules":
                settings[key] = tuple(_made(Rule, "rules", one) for one in _listed(key, value))
            elif key in _TABLES:
                settings[key] = _made(_TABLES[key], key, value)
            else:
                settings[key] = tuple(value) if isinstance(value, list) else value
        if "folder" in settings:
            settings["folder"] = beside / _text("folder", settings["folder"])
        config: Config = _made(Config, "", settings)
        if config.tls is not None:
            config = replace(config, tls=_beside(beside, config.tls, "certificate", "key", "clients"))
        if config.mesh is not None:
            config = replace(config, mesh=_beside(beside, config.mesh, "certificate", "key", "authority"))
        if config.tokens is not None and "://" not in config.tokens.keys:
            config = replace(config, tokens=replace(config.tokens, keys=str(beside / config.tokens.keys)))
        return config
    except BufgymError as error:
        raise error if str(error).startswith(f"{path}") else BufgymError(f"{path}: {error}") from None


def _beside(folder: Path, table: Any, *names: str) -> Any:
    """Resolve the table's file names in this folder."""
    files = {name: _text(name, getattr(table, name)) for name in names}
    return replace(table, **{name: str(folder / file) if file else "" for name, file in files.items()})


def _made(kind: Any, name: str, table: Any) -> Any:
    """Make the dataclass of a table."""
    if not isinstance(table, Mapping):
        raise BufgymError(f"{name} = {table!r}: must be a table")
    where = name and f"{name}: "
    try:
        check_keys(table, {each.name for each in fields(kind)})
        return kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in table.items()})
    except TypeError as error:
        raise BufgymError(f"{where}{str(error).partition('__() ')[2] or error}") from None
    except BufgymError as error:
        raise BufgymError(str(error) if str(error).startswith(name.rstrip("s")) else f"{where}{error}") from None


def _listed(name: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise BufgymError(f"{name}: must be [[{name}]] tables")
    return value


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str):
        raise BufgymError(f"{name} = {value!r}: must be a text")
    return value

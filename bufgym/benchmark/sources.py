"""Policies from a model's file or a module's function. Loading a policy registers it.

    mine.zip           a model of stable-baselines3 or sb3-contrib (``bufgym.sb3.as_policy``); it can run any code
    mine.safetensors   a learned policy (``bufgym.policies.load``); no code is run
    module:function    a policy function, a ``Policy``, or a function without arguments that makes either; the module
                       is imported, from the current folder too

A file's policy is named after the file's stem, a function's after the function. ``bufgym.policies.get`` reads no files,
because names also come from other people's leaderboards and results.
"""

import hashlib
import os
import sys
from collections.abc import Iterable
from dataclasses import fields, replace
from pathlib import Path

from bufgym import policies
from bufgym.jit.fingerprint import fingerprint
from bufgym.oracle import cached
from bufgym.policies import Policy, registry
from bufgym.policies.registry import OnArrival
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError

PolicyLike = Policy | str | Path | OnArrival

_FILES = (".zip", ".safetensors")


def is_source(spec: str) -> bool:
    """Whether ``spec`` must be loaded; otherwise it is a name, perhaps with settings."""
    return spec.endswith(_FILES) or (modules.is_named(spec) and spec.partition(":")[0] not in policies.names())


_NAMES: dict[tuple[str, str], str] = {}
"""(folder, source) -> name of the policy, for policies that this process has loaded."""


def load(source: str, folder: str | None = None) -> str:
    """Register the policy in ``source`` and return its name; a registered policy stays as it is.

    ``folder`` is where relative paths begin and where modules are found, besides Python's own places. None means the
    current folder.
    """
    place = folder or os.getcwd()
    known = _NAMES.get((place, source))
    if known is not None and known in policies.names():
        return known
    read = _from_file if source.endswith(_FILES) else _from_module
    name = _NAMES[place, source] = _registered(read(source, place), source)
    return name


def _registered(policy: Policy, source: str) -> str:
    """The policy's name, once it is registered."""
    if registry.registered_as(policy.on_arrival) is not policy:
        if policy.name in policies.names():
            raise BufgymError(f"{source}: there is a policy named {policy.name!r} already; give this one another name")
        given = {f.name: getattr(policy, f.name) for f in fields(Policy) if f.name not in ("name", "on_arrival")}
        registry.register(policy.name, **given)(policy.on_arrival)
    return policy.name


def make_policy(spec: PolicyLike) -> Policy:
    """A policy from its name, a function, or a file.

    Args:
        spec: a registered name (``"afr"``, ``"decimate:every=2"``), a function (buffer, arrival, memory),
            ``"module:function"``, a model of stable-baselines3 (``.zip``, which can run any code), or a learned policy
            (``.safetensors``, which runs none). A ``Policy`` comes back as it is.

    Raises:
        BufgymError: there is no such policy, or the file holds none.
    """
    if isinstance(spec, Path) or (isinstance(spec, str) and is_source(spec)):
        spec = load(os.fspath(spec))
    return policies.get(spec)


def loaded(names: Iterable[str], folder: str | None = None) -> tuple[str, ...]:
    """The sources in ``folder`` from which this process loaded policies of these names."""
    place, wanted = folder or os.getcwd(), {name.partition(":")[0] for name in names}
    return tuple(source for (home, source), name in _NAMES.items() if home == place and name in wanted)


def made_of(spec: str | Policy) -> str:
    """Hash of what a policy decides by: its functions with all that they call and read, and its settings.

    The version of Python comes first, as its bytecode is part of the hash: only hashes of the same version compare. A
    name that is not registered here has none.
    """
    try:
        policy = policies.get(spec)
    except BufgymError:
        return ""
    functions = policy.on_arrival, policy.on_departure, policy.on_dequeue, policy.on_send
    fingerprints = [
        fingerprint(getattr(function, "py_func", function)) for function in functions if function is not None
    ]
    owner = getattr(policy.on_arrival, "__self__", None)  # a model in torch, whose numbers are not in its functions
    fingerprints += [] if owner is None else [owner.fingerprint]
    if policy.privileged is not None:  # an oracle, by the texts of its files, as its plans are cached
        fingerprints.append(cached.sources())
    numbers = dict(policy.parameters), policy.weights, dict(policy.memory), policy.work, policy.client
    digest = hashlib.sha256(repr((fingerprints, numbers)).encode()).hexdigest()
    return f"{sys.implementation.cache_tag}-{digest[:12]}"


def prepare(policy_file: str | None, sources: Iterable[str], home: str) -> None:
    """Make policies of this file and these sources known in another process, once."""
    if policy_file is not None and policy_file not in modules.FILES:
        modules.run_file(policy_file, "--policy-file")
    for source in sources:
        load(source, home)


def known_elsewhere(policy: Policy) -> bool:
    """Whether other processes make the same policy of its name: a built-in one, or one that ``load`` has loaded."""
    if not (policy.built_in or loaded([policy.name])):
        return False
    try:
        return policies.get(policy.name) == policy
    except BufgymError:
        return False


def digests(sources: Iterable[str], folder: str) -> dict[str, str]:
    """Digest of each source's file or module, which identifies its version."""
    files = {
        source: Path(folder, source) if source.endswith(_FILES) else _module_file(source, folder) for source in sources
    }
    return {source: hashlib.sha256(file.read_bytes()).hexdigest()[:16] for source, file in files.items()}


def _from_file(source: str, folder: str) -> Policy:
    # A path in the current folder stays as it was written, for messages.
    path = Path(source) if folder == os.getcwd() else Path(folder, source)
    if not source.endswith(".zip"):
        return replace(policies.load(path), name=path.stem)
    from bufgym.sb3 import as_policy

    return as_policy(path, path.stem)


def _from_module(source: str, folder: str) -> Policy:
    found = modules.made(source, folder, also="a policy")
    if isinstance(found, Policy):
        return found
    if not callable(found) or modules.needs(found) != 3:
        rule = "must be a policy, a function (buffer, arrival, memory), or one without arguments that makes either"
        raise BufgymError(f"{source}: {rule}")
    return registry.registered_as(found) or Policy(source.partition(":")[2], found)


def _module_file(source: str, folder: str) -> Path:
    file = modules.imported(source, folder).__file__
    if file is None:
        raise BufgymError(f"{source}: a module without a file")
    return Path(file)

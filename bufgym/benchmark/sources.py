"""Policies that are not registered: a model's file, or a function of a module. Loading one registers it.

    mine.zip           a model of stable-baselines3 or sb3-contrib (``bufgym.sb3.as_policy``); it can run any code
    mine.safetensors   a learned policy (``bufgym.policies.load``); no code is run
    module:function    a policy function, a ``Policy``, or a function without arguments that makes either; the module
                       is imported, from the current folder too

A file's policy is called by the file's stem, a function's by its own name. ``bufgym.policies.get`` itself reads no
file: names also come from leaderboards and results of strangers.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
import re
import sys
from collections.abc import Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from bufgym import policies
from bufgym.errors import BufgymError, line_in
from bufgym.policies import Policy, registry

_FILES = (".zip", ".safetensors")
_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""``module:function``; a setting has a "=" behind the colon."""


def is_source(spec: str) -> bool:
    """Whether ``spec`` is to be loaded; else it is a name, perhaps with settings."""
    return spec.endswith(_FILES) or (
        _FUNCTION.fullmatch(spec) is not None and spec.partition(":")[0] not in policies.names()
    )


_NAMES: dict[str, str] = {}
"""Name of the policy by source, for those that this process has loaded."""


def load(source: str) -> str:
    """Register the policy in ``source``; its name. What is registered already stays as it is.

    Raises:
        BufgymError: there is none, or another policy has its name.
    """
    if source in _NAMES and _NAMES[source] in policies.names():
        return _NAMES[source]
    policy = _from_file(source) if source.endswith(_FILES) else _from_module(source)
    if registry.registered_as(policy.on_arrival) is not policy:
        if policy.name in policies.names():
            raise BufgymError(f"{source}: there is a policy named {policy.name!r} already; give this one another name")
        given = {f.name: getattr(policy, f.name) for f in fields(Policy) if f.name not in ("name", "on_arrival")}
        registry.register(policy.name, **given)(policy.on_arrival)
    _NAMES[source] = policy.name
    return policy.name


def line_of(error: Exception, policy_file: str | None) -> str | None:
    """Where in the caller's code the error came from, that file or a module loaded here; None for nowhere there."""
    modules = [str(_module_file(source)) for source in _NAMES if not source.endswith(_FILES)]
    places = (line_in(error, file) for file in [*filter(None, [policy_file]), *modules])
    return next(filter(None, places), None)


def digests(sources: Iterable[str]) -> dict[str, str]:
    """What tells one version of each from another: of its file, or of its module's."""
    files = {source: Path(source) if source.endswith(_FILES) else _module_file(source) for source in sources}
    return {source: hashlib.sha256(file.read_bytes()).hexdigest()[:16] for source, file in files.items()}


def _from_file(source: str) -> Policy:
    name = Path(source).stem
    if not source.endswith(".zip"):
        return replace(policies.load(source), name=name)
    from bufgym.sb3 import as_policy

    return as_policy(source, name)


def _from_module(source: str) -> Policy:
    place, _, name = source.partition(":")
    found = getattr(_imported(source, place), name, None)
    if found is None:
        raise BufgymError(f"{source}: the module {place} has no {name}")
    if isinstance(found, Policy):
        return found
    if callable(found) and _needs(found) == 0:
        found = found()
        if isinstance(found, Policy):
            return found
    if not callable(found) or _needs(found) != 3:
        rule = "must be a policy, a function (buffer, arrival, memory), or one without arguments that makes either"
        raise BufgymError(f"{source}: {rule}")
    return registry.registered_as(found) or Policy(name, found)


def _imported(source: str, place: str) -> Any:
    # The installed command, unlike python -m bufgym, does not look for modules in the current folder.
    if os.getcwd() not in map(os.path.abspath, sys.path):
        sys.path.append(os.getcwd())
    try:
        return importlib.import_module(place)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{place}.".startswith(f"{error.name}."):
            raise BufgymError(f"{source}: {place} imports {error.name}, which is not there") from None
        known = ", ".join(policies.names())
        raise BufgymError(
            f"{source}: no policy {place.partition('.')[0]!r}, and no module of that name in {os.getcwd()} or "
            f"among those installed; known policies: {known}"
        ) from None
    except Exception as error:  # whatever the module does when it is run
        raise BufgymError(f"{source}: cannot be imported: {type(error).__name__}: {error}") from None


def _module_file(source: str) -> Path:
    file = _imported(source, source.partition(":")[0]).__file__
    if file is None:
        raise BufgymError(f"{source}: a module without a file")
    return Path(file)


def _needs(function: Any) -> int:
    """Arguments without a default."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return -1
    kinds = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return sum(parameter.kind in kinds and parameter.default is parameter.empty for parameter in parameters)

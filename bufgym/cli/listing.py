"""``bufgym list``: environments, scenarios, suites, policies and more, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

from bufgym.cli.options import PolicyFile, columns, load_policies
from bufgym.ground.modules import first_line

Kind = Literal["environments", "scenarios", "suites", "policies", "values", "rewards", "observations", "traces"]


def listing(what: Kind | None = None, /, *, policy_file: PolicyFile = None) -> None:
    """List what there is: environments, scenarios, policies and more.

    Args:
        what: Only these.
    """
    load_policies(policy_file)
    print("\n\n".join(f"{kind}\n{LISTS[kind]()}" for kind in LISTS if what in (None, kind)))


def environments() -> dict[str, str]:
    """Map the id of every environment that bufgym registers with Gymnasium to its scenario."""
    import gymnasium

    specs = [spec for spec in gymnasium.registry.values() if spec.namespace == "bufgym"]
    return {spec.id: str(spec.kwargs.get("scenario", "")) for spec in specs}


def _list_environments() -> str:
    from bufgym.scenario import SCENARIOS

    return columns(
        [
            (id, f"scenario {scenario}", SCENARIOS[scenario][1] if scenario in SCENARIOS else "")
            for id, scenario in sorted(environments().items())
        ]
    )


def _list_scenarios() -> str:
    from bufgym.scenario import SCENARIOS

    return columns([(name, meaning) for name, (_, meaning) in SCENARIOS.items()])


def _list_suites() -> str:
    from bufgym.scenario.suites import SUITES

    return columns([(s.name, s.kind, s.about + (f"; needs {s.needs}" if s.needs else "")) for s in SUITES.values()])


def _list_policies() -> str:
    from bufgym import oracle, policies  # noqa: F401  (the oracle registers the clairvoyant)

    parts = {
        "": policies.names(for_topics=False),
        "only where it is named": policies.names(named_only=True),
        "made for several topics side by side": policies.names(for_topics=True),
    }
    width = max(map(len, policies.names()))
    lines = []
    for title, names in parts.items():
        if title:
            lines.append(f"  -- {title} --")
        for name in names:
            policy = policies.get(name)
            lines.append(f"  {name:<{width}}  {policy.summary[:1].upper()}{policy.summary[1:]}".rstrip())
            settings = ", ".join(f"{setting}={number:g}" for setting, number in policy.parameters.items())
            if settings:
                lines.append(f"  {'':<{width}}  settings: {settings}")
            lines.append(f"  {'':<{width}}  from: {policy.source or 'a policy file'}")
    return "\n".join(lines)


def _list_values() -> str:
    from bufgym.model import qoi

    return columns(
        [
            ("exponential:BASE", first_line(qoi.exponential)),
            ("saturating:DISTANCE", first_line(qoi.saturating)),
            ("tabulated:D=V,...", first_line(qoi.tabulated)),
            ("module:function", first_line(qoi.of_function)),
        ]
    )


def _list_rewards() -> str:
    from bufgym.model.observe import OWN_TERMS, REWARD_TERMS, TOPIC_REWARD_TERMS

    parts = {
        "": REWARD_TERMS,
        _SEVERAL: TOPIC_REWARD_TERMS,
        "where `reward` names it, on every environment": [t for t in OWN_TERMS.values() if not t.one_queue],
        "the same, on those of one queue": [t for t in OWN_TERMS.values() if t.one_queue],
    }
    return _in_parts({title: [(t.name, t.unit, t.meaning) for t in terms] for title, terms in parts.items()})


def _list_observations() -> str:
    from bufgym.model.observe import FIELDS, OWN_FIELDS, TOPIC_FIELDS

    parts = {"": FIELDS, _SEVERAL: TOPIC_FIELDS, "where `fields` names it": tuple(OWN_FIELDS.values())}
    return _in_parts({title: [(f.name, f.per, f.group, f.unit, f.meaning) for f in parts[title]] for title in parts})


_SEVERAL = "with several topics besides"


def _in_parts(parts: Mapping[str, Sequence[Sequence[str]]]) -> str:
    """Print each part under its title in shared columns, first the rows that every environment has."""
    lines = columns([row for rows in parts.values() for row in rows]).split("\n")
    text: list[str] = []
    for title, rows in parts.items():
        if title and rows:
            text.append(f"  -- {title} --")
        text += [lines.pop(0) for _ in rows]
    return "\n".join(text)


def _list_traces() -> str:
    from bufgym.traces import shipped
    from bufgym.traces.generate.shipped import shipped_calls

    kinds = {"lte": "bandwidth, synthetic LTE", "drive": "motion of a driving robot, synthetic"}
    calls = shipped_calls()
    rows = [(name, kinds.get(name.split("-")[0], ""), calls.get(name, "")) for name in shipped()]
    return columns(rows) if rows else "  none found"


LISTS: dict[str, Callable[[], str]] = {
    "environments": _list_environments,
    "scenarios": _list_scenarios,
    "suites": _list_suites,
    "policies": _list_policies,
    "values": _list_values,
    "rewards": _list_rewards,
    "observations": _list_observations,
    "traces": _list_traces,
}
"""Arguments of ``list``, in the order of its full output."""

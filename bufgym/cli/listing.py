"""``bufgym list``: environments, scenarios, suites, policies and more, by name."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, get_args

from bufgym.cli.options import columns
from bufgym.utils.modules import first_line

Kind = Literal["environments", "scenarios", "suites", "policies", "values", "rewards", "observations", "traces"]


def listing(what: Kind | None = None, /) -> None:
    """List what there is: environments, scenarios, policies and more.

    Args:
        what: Only these.
    """
    print("\n\n".join(f"{kind}\n{LISTS[kind]()}" for kind in LISTS if what in (None, kind)))


def environments() -> dict[str, str]:
    """Map the id of every environment that bufgym registers with Gymnasium, in its newest version, to its scenario."""
    import gymnasium

    specs = [spec for spec in gymnasium.registry.values() if spec.namespace == "bufgym" and "scenario" in spec.kwargs]
    newest = {spec.name: spec for spec in sorted(specs, key=lambda spec: spec.version or 0)}
    return {spec.id: str(spec.kwargs["scenario"]) for spec in newest.values()}


def _list_environments() -> str:
    from bufgym.scenario import SCENARIOS

    known = sorted(environments().items())
    return columns([(id, f"scenario {name}", SCENARIOS[name][1] if name in SCENARIOS else "") for id, name in known])


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
    return _in_parts({title: [row for name in names for row in _about(name)] for title, names in parts.items()})


def _about(name: str) -> list[tuple[str, str]]:
    from bufgym.policies import get

    policy = get(name)
    settings = ", ".join(f"{setting}={number:g}" for setting, number in policy.parameters.items())
    rows = [(policy.name, f"{policy.summary[:1].upper()}{policy.summary[1:]}")]
    rows += [("", f"settings: {settings}")] if settings else []
    return [*rows, ("", f"from: {policy.source or 'a policy file'}")]


def _list_values() -> str:
    from bufgym.model import qoi

    forms = {
        "exponential:BASE": qoi.exponential,
        "saturating:DISTANCE": qoi.saturating,
        "tabulated:D=V,...": qoi.tabulated,
        "module:function": qoi.of_function,
    }
    return columns([(form, first_line(function)) for form, function in forms.items()])


def _list_rewards() -> str:
    from bufgym.model.observe import OWN_TERMS, REWARD_TERMS, TOPIC_REWARD_TERMS

    parts = {
        "": REWARD_TERMS,
        _SEVERAL: TOPIC_REWARD_TERMS,
        "where `reward` names it, on every environment": [t for t in OWN_TERMS.values() if not t.one_queue],
        "the same, on those of one queue": [t for t in OWN_TERMS.values() if t.one_queue],
    }
    return _in_parts({title: [(t.name, t.unit, t.meaning) for t in terms] for title, terms in parts.items()})


SYMBOLS = (
    "s is the number of messages queued, e the even spacing (x_new - x_dequeued) / (L + 1), "
    "r the link's rate over 2 s, and p the time between arrivals"
)
"""What the letters in the formulas of candidates' fields mean."""


def _list_observations() -> str:
    from bufgym.model import observe

    named = (*observe.ON_BOARD_FIELDS, *observe.ON_BOARD_SLOT_FIELDS, *observe.OWN_FIELDS.values())
    parts = {
        SYMBOLS: (*observe.CANDIDATE_FIELDS, *observe.QUEUE_FIELDS),
        "in place of these, where actions are slots": observe.FIELDS,
        _SEVERAL: observe.TOPIC_FIELDS,
        "where `fields` names it": named,
    }
    return _in_parts({title: [(f.name, f.per, f.group, f.unit, f.meaning) for f in parts[title]] for title in parts})


_SEVERAL = "with several topics besides"


def _in_parts(parts: Mapping[str, Sequence[Sequence[str]]]) -> str:
    """Print each part under its title, if it has one, in shared columns."""
    lines = columns([row for rows in parts.values() for row in rows]).split("\n")
    text: list[str] = []
    for title, rows in parts.items():
        if title and rows:
            text.append(f"  -- {title} --")
        text += [lines.pop(0) for _ in rows]
    return "\n".join(text)


def _list_traces() -> str:
    from bufgym.traces import shipped
    from bufgym.traces.shipped import shipped_calls

    kinds = {"lte": "bandwidth, synthetic LTE", "drive": "motion of a driving robot, synthetic"}
    calls = shipped_calls()
    rows = [(name, kinds.get(name.split("-")[0], ""), calls.get(name, "")) for name in shipped()]
    return columns(rows) if rows else "  none found"


LISTS: dict[str, Callable[[], str]] = {kind: globals()[f"_list_{kind}"] for kind in get_args(Kind)}
"""Arguments of ``list``, in the order of its full output."""

"""The scheduler that comes with bufgym: small, with its command, as good as its file says, and above Robofleet."""

from __future__ import annotations

import pytest

from bufgym import files, policies
from bufgym.benchmark.run import by_trace, run
from bufgym.policies import weights
from bufgym.scenario import suites

SHIPPED = files.shipped("agents/topics", "agents/pretrained/topics", "*.safetensors")
SUITE = suites.get("topics-v1")


def test_its_file_is_small_and_tells_how_it_was_made() -> None:
    assert set(SHIPPED) == {"learned-scheduler"}
    for name, path in SHIPPED.items():
        _, told = weights.read_any(path)
        assert path.stat().st_size < 8_000
        assert told["name"] == name and told["seeds"]
        assert told["training"].startswith("python train.py --suite topics-v1 --algo evolution")
        assert policies.get(name).summary == told["about"] and policies.get(name).for_topics
        assert name in policies.names(for_topics=True) and name not in policies.names(for_topics=False)


@pytest.mark.slow
def test_on_the_first_test_episode_of_each_setting_it_is_what_its_file_says_and_above_robofleet() -> None:
    """Weighted QoI as noted and larger; the first topics no older; no message lost that may not be."""
    rivals = [policies.get("learned-scheduler"), policies.get("robofleet")]
    first = {label: by_trace(setting.scenario)[0][1] for label, setting in SUITE.settings("test").items()}
    rows = [row for label, client in first.items() for row in run(rivals, client, (32,), [0], label=label)]
    noted = weights.read_any(SHIPPED["learned-scheduler"])[1]["weighted_qoi"]
    ages = dict.fromkeys(("learned-scheduler", "robofleet"), 0.0)
    for scenario in first:
        here = {name: [r for r in rows if (r["scenario"], r["policy"]) == (scenario, name)] for name in ages}
        ours, theirs = here["learned-scheduler"], here["robofleet"]
        assert ours[0]["weighted_qoi"] == pytest.approx(noted[scenario], abs=1e-5)
        assert ours[0]["weighted_qoi"] > theirs[0]["weighted_qoi"]
        assert sum(row["lost"] for row in ours if row["no_drop"]) == 0
        for name in ages:
            ages[name] += sum(row["mean_age_s"] for row in here[name] if row["priority"] == 20)
    assert ages["learned-scheduler"] < ages["robofleet"]

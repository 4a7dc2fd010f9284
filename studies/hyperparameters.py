"""What each algorithm of ``train.py`` reaches after some seconds, with its settings.

python -m studies.hyperparameters --env bufgym/Uplink-v1 --seconds 10 60 --algorithms hindsight ppo

Each run has as many steps as fit into its seconds, because the learning rate falls over the steps of a run: a pilot
says how many. The score is that of the kept weights, which are the best on validation, on the held-out episodes.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

BESIDE = ("chance", "afr", "always 0", "always 1", "target-gap")
PILOTS = {"hindsight": 40_000, "ppo": 20_000, "dqn": 20_000}
"""Algorithm, a command of ``train.py`` -> the steps of its pilot."""
ENVS = ("bufgym/Uplink-v1", "bufgym/Interruption-v1")


def trained(env: str, algorithm: str, steps: int, seeds: int) -> tuple[float, dict[str, Any]]:
    """The seconds that training one seed took, and the results by policy, with the agents as ``agent``."""
    folder = Path("runs") / "hyperparameters"
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "train.py", algorithm, "--env", env, "--steps", str(steps), "--name", folder.name]
    command += ["--seeds", str(seeds)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr[-500:]}")
    found = json.loads((folder / "results.json").read_text())
    by_name = {entry["policy"]: entry for entry in found["scores"]}
    one, several = by_name[found["agent"]], found["together"].get(algorithm)
    agent = (one["score"], *one["score_95"]) if several is None else several["score"]
    return found["training_s"]["0"], {**by_name, "agent": agent}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default=ENVS[0], choices=ENVS)
    parser.add_argument("--seconds", type=float, nargs="+", default=[10.0, 60.0])
    parser.add_argument("--algorithms", nargs="+", default=list(PILOTS), choices=list(PILOTS))
    parser.add_argument("--seeds", type=int, default=1, help="trainings; their interval is over these and the links")
    options = parser.parse_args()
    print(f"{options.env}: score of the kept weights on held-out episodes; 0 is Drop Oldest, 1 the clairvoyant")
    for name in options.algorithms:
        pilot = PILOTS[name]
        took_s, _ = trained(options.env, name, pilot, 1)
        rate = pilot / took_s
        for seconds in options.seconds:
            took_s, scores = trained(options.env, name, round(rate * seconds), options.seeds)
            score, low, high = scores["agent"]
            beside = ", ".join(
                f"{rule} {scores[rule]['score']:.3f}"
                for rule in ("chance", "afr", "always 0", "always 1", "target-gap")
            )
            print(
                f"{name:13} {seconds:4.0f} s: {score:6.3f} [{low:.3f}, {high:.3f}] after {rate * seconds:,.0f} steps, "
                f"{took_s:.0f} s; {beside}",
                flush=True,
            )


if __name__ == "__main__":
    main()

"""Install what tests need and is not here: ``missing.py install SKIPPED INSTALLED``, as far as this machine can.

SKIPPED is a file in which pytest wrote test -> why it was skipped, or "all" for the whole table. INSTALLED gets the
groups of ``tests/needs.py`` that were installed. ``missing.py left SKIPPED INSTALLED`` fails where a test was skipped
for one of these groups.
"""

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPO / "tests"))

from needs import NEEDS, Need, group_of  # noqa: E402

WITHOUT_ONE = "compiled"
"""Its tests run in another stage."""


def read(skipped: Path) -> dict[str, str]:
    """Test -> why it was skipped, but for those that another stage runs."""
    found = json.loads(skipped.read_text(encoding="utf-8"))
    return {test: why for test, why in found.items() if group_of(why) != WITHOUT_ONE}


def message(skipped: Path) -> str:
    """A line for each group: how many tests, of what, and what brings it."""
    groups = Counter(group_of(why) or why for why in read(skipped).values())
    if not groups:
        return ""
    lines = ["", "Not tested here, and what brings it (`make everything` has what this machine can have, and runs it):"]
    for group, count in groups.most_common():
        need = NEEDS.get(group, Need(group, by_hand="no group of tests/needs.py"))
        lines.append(f"{count:5}  {need.what:46} {need.command}")
    return "\n".join(lines)


def run(*command: str) -> bool:
    """Whether the command ended well; its last line is printed where not."""
    settings = {"DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(command, cwd=REPO, env=os.environ | settings, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"{' '.join(command)}: {(done.stderr + done.stdout).strip().splitlines()[-1:]}", flush=True)
    return done.returncode == 0


def install(groups: list[str]) -> list[str]:
    """Install what the groups need; those that are here now."""
    debian = shutil.which("apt-get") is not None and os.geteuid() == 0
    if any(NEEDS[group].apt for group in groups):
        if debian:
            run("apt-get", "update", "-qq")
        else:
            print("not root, or no apt-get: Debian's packages are left out")
    here = []
    for group in groups:
        need = NEEDS[group]
        if need.apt and debian:
            done = run("apt-get", "install", "-y", "-qq", "--no-install-recommends", *need.apt)
        elif need.pip:
            pip = "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-compile"
            done = run(sys.executable, *pip, "-c", "constraints.txt", *need.pip)
        elif need.npm and shutil.which("npm"):
            done = run("npm", "install", "--silent", "--no-fund", "--no-audit", "--prefix", ".venv", need.npm)
        else:
            print(f"{need.what}: left out; {need.command}")
            continue
        print(f"{need.what}: {'installed' if done else 'could not be installed: its tests are skipped'}", flush=True)
        here += [group] * done
    return here


def main(verb: str, skipped: str, installed: str) -> int:
    """Install, or look at what is still skipped; 1 where something is that this machine could run."""
    if verb == "install":
        wanted = {group_of(why) for why in read(Path(skipped)).values()} if skipped != "all" else set(NEEDS)
        groups = [group for group in NEEDS if group in wanted | {"typescript"} and group != WITHOUT_ONE]
        Path(installed).write_text(json.dumps(install(groups)), encoding="utf-8")
        return 0
    here = json.loads(Path(installed).read_text(encoding="utf-8"))
    left = {test: why for test, why in read(Path(skipped)).items() if group_of(why) in (None, "extras", *here)}
    print("\n".join(f"{test} is still skipped: {why}" for test, why in left.items()) or "none that could run")
    return int(bool(left))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

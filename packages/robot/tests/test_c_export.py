"""The header in C: compiled with gcc, it decides as Python does, on a million decisions; a robot in C++ uses it."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_cases import fails, shown
from needs import needs
from refusal_cases import refuse

from bufgym import policies
from bufgym.jit import JIT
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.policies import Policy
from bufgym.policies.learned import NAMES
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.sim.metrics import received
from bufgym.traces import Trace
from bufgym_robot.c import CALL, header, random_episode, recorded, supported
from bufgym_robot.c.header import why_not
from tests.core.weight_cases import random_choices, random_ruled, random_weights

REPO = Path(__file__).resolve().parents[3]
EXPONENTIAL = qoi.exponential()
SETTINGS = [
    (8, EXPONENTIAL, None),
    (15, qoi.saturating(4.0), None),
    (5, qoi.tabulated([0, 1, 3, 10], [0, 0.5, 0.8, 1]), None),
    (12, EXPONENTIAL, 400_000),
]
"""L, V, B"""
FLAGS = ["-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]

DRIVER = """
#define BUFGYM_PARITY
#include "policy.h"
#include <stdio.h>

/* Plays the calls in a file; prints bufgym_parity(), how many decisions there were, and how many differ. */
int main(int words, char **files)
{
    static struct bufgym_call calls[4096];
    static struct bufgym_queue q;
    FILE *file = words > 1 ? fopen(files[1], "rb") : 0;
    size_t k, n;
    int decisions = 0, differ = 0;
    while (file && (n = fread(calls, sizeof calls[0], 4096, file)) > 0)
        for (k = 0; k < n; k++) {
            differ += bufgym_play(&q, &calls[k]) != calls[k].decision;
            decisions += calls[k].kind == BUFGYM_ARRIVAL;
        }
    printf("%d %d %d", bufgym_parity(), decisions, differ);
    return 0;
}
"""


def compiled(folder, compiler, standard, source, text, *flags):
    """The program of this source and this header; skips where there is no compiler."""
    if shutil.which(compiler) is None:
        pytest.skip(needs("compiler", compiler))
    (folder / "policy.h").write_text(text, encoding="utf-8")
    program = folder / "program"
    words = [compiler, f"-std={standard}", *FLAGS, *flags, "-I", folder, source, "-o", program, "-lm"]
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return program


def assert_equal(text, expected):
    """Without pytest's own search for what differs, which takes minutes."""
    assert [pair for pair in zip(text.splitlines(), expected.splitlines(), strict=True) if pair[0] != pair[1]] == []


def output(program, *words, text=""):
    return subprocess.run([program, *words], input=text, capture_output=True, text=True, check=True).stdout


def driver(folder, text, *flags):
    (folder / "driver.c").write_text(DRIVER, encoding="utf-8")
    return compiled(folder, "gcc", "c99", folder / "driver.c", text, *flags)


def every_field() -> Policy:
    """A random agent of two layers that reads every field."""
    return random_weights(NAMES, 7, 5, seed=3).policy("every-field")


AGENTS = {"learned": policies.get("learned")}
AGENTS |= {"every-field": every_field()}
AGENTS |= {
    "among-candidates": random_choices(2, False, 64, 64, seed=7).policy("among-candidates"),
    "at-arrivals": random_choices(3, True, 6, 5, 4, activation="relu", seed=13, accept=4.0).policy("at-arrivals"),
    "masked": random_choices(5, True, masks=True, seed=16, accept=4.0).policy("masked"),
    "ruled": random_ruled(3, 12, 7, seed=18, accept=1.0).policy("ruled"),
}


def play_in_c(folder, policy, L, episodes, value=EXPONENTIAL, B=None, flags=("-O0",)):
    """(parity, decisions, how many differ) of a recorded run that is played again in C."""
    calls = recorded(policy, episodes, L, value, B)
    assert calls.dtype == CALL
    calls.tofile(folder / "calls")
    program = driver(folder, header(policy, L, value, B), *flags)
    return tuple(map(int, output(program, folder / "calls").split()))


def check(folder, policy, decisions, settings, flags):
    for k, (L, value, B) in enumerate(settings):
        rng = np.random.default_rng(k)
        n = 1_000 if JIT else 40
        episodes = [random_episode(rng, n, B) for _ in range(decisions // n if JIT else 2)]
        parity, made, differ = play_in_c(folder, policy, L, episodes, value, B, flags=flags)
        assert (parity, differ) == (0, 0), (L, value.name, B, made)
        assert made >= n * len(episodes)


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", [*supported(), *AGENTS])
def test_it_decides_in_c_as_in_python(name, whole, tmp_path):
    """A million decisions nightly."""
    most = (250_000 if name in AGENTS else 20_000, SETTINGS, []) if whole else (2_000, SETTINGS[3:], ["-O0"])
    check(tmp_path, AGENTS.get(name) or policies.get(name), *most)


@pytest.mark.parametrize("L", [1, 2, 3])
def test_short_queues_too_decide_in_c_as_in_python(L, tmp_path):
    """What they do on a steady link is theirs alone: each link of an episode holds for some seconds."""
    check(tmp_path, policies.get("target-gap"), 20_000, [(L, EXPONENTIAL, None)], ["-O0"])


def test_with_a_window_several_messages_are_in_the_socket(tmp_path):
    """Three in flight, acks 50 ms late: the socket holds more than one message, and the header knows of all."""
    rng = np.random.default_rng(5)
    drawn = [random_episode(rng, 40) for _ in range(30 if JIT else 2)]
    episodes = [Episode(e.arrivals, e.link, window=3, ack_delay_us=50_000) for e in drawn]
    assert play_in_c(tmp_path, AGENTS["every-field"], 6, episodes) == (0, 40 * len(episodes), 0)


@pytest.mark.parametrize(
    ("name", "number", "other"),
    [
        ("afr", "((double)2) / ((double)3)", "0.2"),
        ("learned", "bufgym_v[] = {0.0, -0.48", "bufgym_v[] = {0.0, -0.08"),
        ("codel", "1000.0 * buffer.parameters", "9000.0 * buffer.parameters"),
    ],
)
def test_parity_finds_another_number(name, number, other, tmp_path):
    text = header(AGENTS.get(name) or policies.get(name), 8, EXPONENTIAL)
    assert number in text
    assert output(driver(tmp_path, text)).startswith("0 ")
    assert not output(driver(tmp_path, text.replace(number, other))).startswith("0 ")


@pytest.mark.parametrize("name", ["afr", "learned"])
def test_the_robot_delivers_what_the_simulator_says(name, tmp_path):
    """8 MB/s but for a standstill from second 4 to 8; 230 kB frames at 30 Hz."""
    policy = policies.get(name)
    robot = compiled(tmp_path, "g++", "c++17", REPO / "examples" / "robot.cpp", header(policy, 8, EXPONENTIAL))
    frames = 360 if JIT else 150
    at_us = 33_333 * np.arange(frames)
    arrivals = "".join(f"{us} 230000 {k}\n" for k, us in enumerate(at_us))
    link = Link(Trace.steps([(4, 8e6), (4, 0), (12, 8e6)], after="stop"))
    senders = run(policy, [Episode(messages(at_us, 230_000), link)], 8, EXPONENTIAL)
    came = received(senders, 0)
    lines = output(robot, "-", text=arrivals).splitlines()
    assert len(lines) == frames + 1
    x = senders.episodes[0].arrivals["x"][came["seq"]] if came.dtype.names else senders.episodes[0].arrivals["x"][came]
    assert lines[-1] == f"delivered {len(came)}, H = {EXPONENTIAL.information(x):.3f}"
    if frames == 360:
        assert output(robot) == "\n".join(lines) + "\n"  # what it makes up by itself
    assert (REPO / "examples" / "robot.cpp").read_text(encoding="utf-8").count("\n") <= 75


def test_the_command_writes_the_header(tmp_path, capsys):
    out, agent = tmp_path / "policy.h", REPO / "agents" / "pretrained" / "learned.safetensors"
    words = ["even-reject:beta=1.25", "--to", "c", "--out", out, "--capacity", 6, "--value", "saturating:4"]
    assert shown(["export", *words], capsys) == f"wrote {out}\n"
    text = out.read_text(encoding="utf-8")
    assert_equal(text, header(policies.get("even-reject:beta=1.25"), 6, qoi.saturating(4)))
    assert "#define BUFGYM_CAPACITY 6 " in text and "bufgym_parameters[] = {1.25}" in text and "@" not in text
    shown(["export", agent, out, "--to", "c"], capsys)
    assert_equal(out.read_text(encoding="utf-8"), header(policies.get("learned"), 16, EXPONENTIAL))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "rosbridge --to c --out {}",
            "policy rosbridge: has no C: its queue is unbounded; known: afr, afr-paper, codel, ",
        ),
        ("gap-priority {} --to c", "is made for several topics, and the queue in C has one"),
        ("afr --to c", "export needs --out"),
        ("afr {} --to c --name mine", "--name belongs to --to safetensors"),
        ("model.zip {} --capacity 4 --name a", "--capacity belongs to --to c"),
        ("model.zip {}", "--name must be given"),
        ("afr {}/nowhere/policy.h --to c", "policy.h: cannot be written: No"),
    ],
)
def test_a_mistake_is_told_in_one_line(words, message, tmp_path, capsys):
    fails(["export", *words.replace("{}", str(tmp_path / "policy.h")).split()], message, capsys)
    assert list(tmp_path.iterdir()) == []


PARITY = """
#define BUFGYM_PARITY
#include "policy.h"
#include <stdio.h>
int main(void) { printf("%d", bufgym_parity()); return 0; }
"""


@pytest.mark.nightly
@pytest.mark.parametrize("name", supported())
def test_on_arm64_too_it_decides_as_python(name, tmp_path):
    """Compiled by zig with musl's libm, and run by qemu's user mode."""
    pytest.importorskip("ziglang", reason=needs("zig"))
    if shutil.which("qemu-aarch64") is None:
        pytest.skip(needs("qemu"))
    (tmp_path / "policy.h").write_text(header(policies.get(name), 8, EXPONENTIAL), encoding="utf-8")
    (tmp_path / "main.c").write_text(PARITY, encoding="utf-8")
    zig = [sys.executable, "-m", "ziglang", "cc", "-target", "aarch64-linux-musl", "-static"]
    words = [*zig, "-std=c99", "-O2", "-ffp-contract=off", "main.c", "-o", "main", "-lm"]
    subprocess.run(words, cwd=tmp_path, check=True)
    assert output("qemu-aarch64", tmp_path / "main") == "0"


TWO = """
static const double own_v[] = {1.0, 1.0}; /* saturating:1 */
#define OLD_V own_v
#define OLD_V_SIZE 2
#include "old.h"
#include "policy.h"
#include <stdio.h>

/* Five messages into room for two of eight: what is dropped by each policy, and V of a program's own. */
int main(void)
{
    struct old_queue old;
    struct bufgym_queue new;
    int k;
    old_init(&old, 0);
    bufgym_init(&new, 0);
    old.capacity = new.capacity = 2;
    for (k = 0; k < 5; k++) {
        const struct old_message a = {1000 * k, 10, k, 0.0, 0, 0, 0.0, 0};
        const struct bufgym_message b = {1000 * k, 10, k, 0.0, 0, 0, 0.0, 0};
        printf("%d %d;", old_arrival(&old, a, 0), bufgym_arrival(&new, b, 0));
    }
    printf("%g", old_value(0.5));
    return 0;
}
"""


def test_two_policies_in_one_program_with_a_capacity_of_its_run(tmp_path):
    (tmp_path / "old.h").write_text(header(policies.get("drop-oldest"), 8, EXPONENTIAL, prefix="old"), encoding="utf-8")
    (tmp_path / "two.c").write_text(TWO, encoding="utf-8")
    text = header(policies.get("drop-newest"), 8, EXPONENTIAL)
    program = compiled(tmp_path, "gcc", "c99", tmp_path / "two.c", text)
    assert output(program) == "-2 -2;-2 -2;0 -1;0 -1;0 -1;0.5"
    refuse("prefix 'A-b': must be small letters", header, policies.get("afr"), 8, EXPONENTIAL, prefix="A-b")


def test_every_policy_of_one_queue_has_c_and_others_say_why_not():
    """What has none knows the future, has no bound, is for several topics, or is plain Python."""
    for policy in map(policies.get, policies.names()):
        if policy.compile and policy.ranked and not policy.for_topics:
            assert policy.name in supported()
    for name, why in (
        ("clairvoyant", "it knows the future"),
        ("rosbridge", "its queue is unbounded"),
        ("fifo", "is made for several topics"),
    ):
        refuse(f"policy {name}: has no C: it", header, policies.get(name), 8, EXPONENTIAL)
        assert why in why_not(policies.get(name))
    refuse("policy afr: has no C: it is plain", header, Policy("afr", lambda b, a, m: -1), 8, EXPONENTIAL)


def test_a_policy_of_ones_own_has_c(tmp_path):
    """Its functions are translated as bufgym's own are."""

    def mine(buffer, arrival, memory):
        memory[0] += 1.0
        if len(buffer.slots) < buffer.capacity:
            return -2
        return int(memory[0]) % buffer.capacity if arrival.x > buffer.slots[0].x + 2.0 else -1

    check(tmp_path, Policy("mine", mine, compile=True, memory={"n": 0.0}), 2_000, SETTINGS[:1], ["-O0"])

"""Rules that see bytes: the advantage of dropping a message, the price of bytes, the newcomer under a byte limit."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from cases import VALUES, cases, newcomer, queue_of, same
from hypothesis import assume, given
from hypothesis import strategies as st

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.policies import chains
from bufgym.policies.price_dp import LOG_BYTES, PARAMETERS, REMEMBERED, VARIANCE, remember_sizes, share
from bufgym.scenario import messages

kernels = pytest.mark.kernels
NUMBERS = np.array(list(PARAMETERS.values()))


def queue(*slots, sent=0.0, now=10.0, now_bytes=100, capacity=8, **known):
    """Messages (x, bytes) wait behind the one dequeued at ``sent``; another arrives at ``now``; V = 1 - 2^-d."""
    buffer = queue_of(len(slots), capacity)
    for k, (x, size) in enumerate(slots):
        buffer.slots["x"][k], buffer.slots["size_bytes"][k], buffer.slots["arrival_us"][k] = x, size, 1e5 * x
    arrival = newcomer()
    arrival["x"], arrival["size_bytes"], arrival["arrival_us"] = now, now_bytes, int(1e5 * now)
    known = {"previous_x": now - 1, "previous_us": int(1e5 * (now - 1)), "dequeued_x": sent, "busy": 1} | known
    known |= {"backlog_bytes": sum(size for _, size in slots), "period_us": 1e5, "left_bytes": 10**6}
    return buffer._replace(**known), arrival


def advantages(buffer, arrival, price, end_x):
    scratch = np.full(sum(chains.SCRATCH) + chains.COLUMNS * buffer.capacity, np.nan)
    chains.weigh(buffer, arrival, price, end_x, scratch)
    return [chains.advantage(scratch, k) for k in range(len(buffer.slots) + 1)]


def by_hand(buffer, arrival, price, end_x):
    """Every chain, one by one."""
    v = qoi.exponential(0.5)
    places = [(float(m["x"]), int(m["size_bytes"])) for m in (*buffer.slots, arrival)]
    best = {True: [-np.inf] * len(places), False: [-np.inf] * len(places)}
    for length in range(len(places) + 1):
        for chosen in combinations(range(len(places)), length):
            xs = [buffer.dequeued_x, *(places[k][0] for k in chosen), end_x]
            worth = sum(v(b - a) for a, b in pairwise(xs)) - price * sum(places[k][1] for k in chosen)
            for k in range(len(places)):
                best[k in chosen][k] = max(best[k in chosen][k], worth)
    return [without - through for without, through in zip(best[False], best[True], strict=True)]


@kernels
@given(st.integers(0, 2**32), st.integers(0, 6))
def test_advantages_are_those_of_all_chains(seed, s):
    rng = np.random.default_rng(seed)
    xs, sizes = np.cumsum(rng.exponential(1.0, s + 1)), rng.integers(1, 1000, s + 1)
    buffer, arrival = queue(*zip(xs[:-1], sizes[:-1], strict=True), now=float(xs[-1]), now_bytes=int(sizes[-1]))
    price, end_x = rng.uniform(0, 2e-3), float(xs[-1] + rng.exponential())
    assert advantages(buffer, arrival, price, end_x) == pytest.approx(by_hand(buffer, arrival, price, end_x), abs=1e-12)


def test_a_step_leads_on_by_so_many_messages_at_most():
    # Thirty messages at one place, free: every chain has to rest on one of each SPAN of them, none is worth a thing.
    buffer, arrival = queue(*[(1.0, 1)] * 30, now=1.0, capacity=40)
    assert advantages(buffer, arrival, 0.0, 1.0) == pytest.approx([0.0] * 31)


def decided(name, *slots, **known):
    policy = policies.get(name)
    buffer, arrival = queue(*slots, **known)
    memory = policy.new_memory(1, buffer.capacity)[0]
    return policy.on_arrival(buffer._replace(parameters=policy.parameter_array), arrival, memory)


@kernels
def test_of_equal_gaps_the_largest_goes():
    even = [(float(k), 100) for k in range(1, 9)]
    large = [(x, 400 if x == 4 else 100) for x, _ in even]
    assert decided("price-dp", *large, now=9.0) == 3
    assert decided("target-gap", *large, now=9.0) == 0  # the oldest: it sees no bytes
    assert decided("price-dp", *even, now=9.0, now_bytes=900) == REJECT


@kernels
def test_under_a_byte_limit_the_newcomer_goes_unless_enough_of_no_larger_a_gap_make_room():
    # B is 300 bytes, and 250 must go. Of 1, 2 and 3 each leaves a gap of 2, as does the newcomer at 4.
    even, uneven = [(1.0, 100), (2.0, 100), (3.0, 100)], [(1.0, 100), (1.2, 100), (3.0, 100)]
    room = {"max_bytes": 300, "now": 4.0, "now_bytes": 250}
    assert decided("min-motion-gap", *even, **room) == 0
    # Of 1, 1.2 and 3 two leave 1.2 and 2, but the last 2.8: 200 bytes are not enough, and none goes in vain.
    assert decided("min-motion-gap", *uneven, **room) == REJECT
    assert decided("min-motion-gap", *uneven, evictions=1, **room) == 0  # too late to turn back
    large = room | {"now_bytes": 299}
    assert decided("price-dp", *even, **large) == REJECT
    assert decided("price-dp", *even, evictions=1, **large) == 0


@kernels
def test_an_idle_socket_or_an_empty_queue_takes_what_comes():
    assert decided("price-dp", (1.0, 100), busy=0) == ACCEPT
    assert decided("price-dp", now_bytes=10**6) == ACCEPT


@kernels
def test_the_spread_of_sizes_sets_the_share():
    memory = np.zeros(len(REMEMBERED))
    for size in (100, 400, 100, 400):
        buffer, arrival = queue(now_bytes=size)
        remember_sizes(buffer, arrival, memory)
    assert memory[LOG_BYTES] == pytest.approx(np.log(200)) and memory[VARIANCE] == pytest.approx(np.log(2) ** 2)
    assert share(memory, NUMBERS) == pytest.approx(1)
    memory[VARIANCE] = 0.1**2
    assert share(memory, NUMBERS) == pytest.approx(1 / (1 + np.exp(-1)))  # 5 - 60 x .1
    remember_sizes(buffer._replace(evictions=1), arrival, memory)  # the same arrival once more
    assert memory[VARIANCE] == 0.1**2
    memory[VARIANCE] = 0.037**2  # 1 / (1 + exp(5 - 2.22)) = .0584, less than LEAST_SHARE
    assert share(memory, NUMBERS) == 0


def equal(case):
    arrivals = case.episode.arrivals
    same_size = messages(arrivals["arrival_us"], 2_000, arrivals["x"])
    same_size["uniform"] = arrivals["uniform"]
    return replace(case, episode=replace(case.episode, arrivals=same_size))


@kernels
@given(cases(max_messages=25), VALUES)
def test_with_equal_sizes_the_one_rule_is_target_gap(case, v):
    case = equal(case)
    assert same(case.run(policies.get("gap-price"), v), case.run(policies.get("target-gap"), v))


@kernels
@given(cases(max_messages=25), VALUES)
def test_with_a_whole_share_it_is_price_dp_compiled_or_not(case, v):
    sizes = case.episode.arrivals["size_bytes"]
    assume(case.capacity > 1 and sizes.std() > 0)
    whole = policies.get("gap-price").with_parameters(share_low=1e-9, share_steep=1e9)
    assert same(case.run(whole, v), case.run(replace(whole, compile=False), v))


ASKED = [n for n in policies.names(for_topics=False) if (p := policies.get(n)).privileged is None and not p.unbounded]


@pytest.mark.parametrize("name", ASKED)
@given(cases(max_messages=30), VALUES)
def test_no_newcomer_is_lost_for_which_a_message_has_gone(name, case, v):
    """Sizes differ a thousandfold under B, so one newcomer often takes the place of several messages."""
    policy, refused = policies.get(name), []

    def watched(buffer, arrival, memory):
        decision = policy.on_arrival(buffer, arrival, memory)
        if decision == REJECT and buffer.evictions > 0:
            refused.append(int(arrival["seq"]))
        return decision

    replace(case, max_bytes=case.max_bytes or 6_000).run(replace(policy, on_arrival=watched, compile=False), v)
    assert refused == []

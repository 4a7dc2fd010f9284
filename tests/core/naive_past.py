"""Slow, obvious reference model of what a robot remembers of its link and its camera: from lists of all that came.

Written from the fields' meanings; it calls no kernel. Arguments are the arrivals so far, [(us, x)], the newest last,
and ``measured``: what ``naive.Sender`` measured at each of them.
"""

import math
from itertools import pairwise


def squash(g, r):
    return g / (g + r) if g > 0 else 0.0


def rates(arrivals, measured):
    """[(now, rate, seconds of sending)] of each time that at least 5 ms of sending lay behind the last one."""
    found, sent, us = [], 0, 0
    for (now, _), m in zip(arrivals, measured, strict=True):
        if m["us"] - us >= 5_000:
            found.append((now, (m["sent"] - sent) / (m["us"] - us), m["us"] - us, m))
            sent, us = m["sent"], m["us"]
    return found


def last_change(found):
    """When the rate was last over 1.1 times that at the change before, or under 1 / 1.1 of it; None for never."""
    at, base = None, 0.0
    for now, rate, _, _ in found:
        if max(rate, base) > 1.1 * min(rate, base):
            at, base = now, rate
    return at


def stalls(found):
    """(How long the link stalls now, [(length, end)] of all stalls of a quarter of a second), us."""
    ended, run = [], 0
    for now, rate, us, m in found:
        if m["us"] > 1_000_000 and rate < 0.03 * m["sent"] / m["us"]:
            run += us
        else:
            if run >= 250_000:
                ended.append((run, now))
            run = 0
    return run, ended


def samples(found):
    """Logarithms of the mean rates, bytes/s, of stretches of at least a second of the clock."""
    levels, at, sent, us = [], 0, 0, 0
    for now, _, _, m in found:
        if now - at >= 1_000_000 and m["sent"] > 0:
            rate = max((m["sent"] - sent) / (m["us"] - us), m["sent"] / m["us"] / 100)
            levels.append(math.log(max(1e6 * rate, 2.0)))
            at, sent, us = now, m["sent"], m["us"]
    return levels


def correlation(levels):
    """Of each with the one before; the newest weighs .08 in the mean, in the variance and in the covariance."""
    if not levels:
        return 0.0
    mean, variance, covariance = levels[0], 0.0, 0.0
    for before, level in pairwise([None, *levels]):
        mean += 0.08 * (level - mean)
        variance = 0.92 * variance + 0.08 * (level - mean) ** 2
        if before is not None:
            covariance = 0.92 * covariance + 0.08 * (level - mean) * (before - mean)
    return max(-1.0, min(1.0, covariance / variance)) if variance >= 1e-6 else 0.0


def stops(arrivals):
    """When the camera's pace was at most a twentieth of its mean until then."""
    (us_0, x_0), found = arrivals[0], []
    for (us_a, x_a), (us_b, x_b) in pairwise(arrivals):
        if us_b > us_a and (x_b - x_a) / (us_b - us_a) <= 0.05 * (x_b - x_0) / (us_b - us_0):
            found.append(us_b)
    return found


def fields(arrivals, measured):
    """Name -> number at the newest arrival."""
    found, (began, x_0), (now, x) = rates(arrivals, measured), arrivals[0], arrivals[-1]
    at, (run, ended), stood = last_change(found), stalls(found), stops(arrivals)
    counted = found[-1][3] if found else {"sent": 0, "us": 0}
    long = measured[-1]["long"]
    top = max((m["medium"] for _, _, _, m in found if m["us"] > 200_000), default=0.0)
    pace = 0.5
    if len(arrivals) > 1 and now > arrivals[-2][0]:
        pace = squash((x - arrivals[-2][1]) / (now - arrivals[-2][0]), (x - x_0) / (now - began))
    last, before = [*(us for us, _ in reversed(ended)), 0, 0][:2]
    return {
        "since_change": 0.0 if at is None else squash(now - at, 2e6),
        "rate_over_mean": squash(long * counted["us"], counted["sent"]),
        "top_rate": squash(top, long),
        "stall_now": squash(run, 5e5),
        "stall_last": squash(last, 1e6),
        "stall_before": squash(before, 1e6),
        "since_stall": squash(now - ended[-1][1], 4e6) if ended else 1.0,
        "stalls_per_minute": squash(60e6 * len(ended) / max(now - began, 15e6), 4),
        "rate_correlation": 0.5 + correlation(samples(found)) / 2,
        "pace_now": pace,
        "since_stop": squash(now - stood[-1], 4e6) if stood else 1.0,
    }

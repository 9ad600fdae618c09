"""Ticks in real time: on the grid, without gaps, honest about lateness; and the statistics of it."""

import random
import time
from itertools import islice

import numpy as np
import pytest

from rtlog_server.devices.device import TickGrid
from rtlog_server.ticker import LEAD_NS, Lateness, TickTime, aligned_grid, ticks, utc_offset_ns

PERIOD_NS = 20_000_000


def never() -> bool:
    return False


def test_the_first_tick_is_the_next_whole_multiple_in_utc() -> None:
    draw = random.Random(1)
    for _ in range(100):
        now_ns, offset_ns = draw.randrange(10**15), draw.randrange(10**18)
        period_ns = draw.choice([10_000_000, 100_000_000, 1_000_000_000])
        grid = aligned_grid(period_ns, offset_ns, now_ns)
        assert (grid.start_ns + offset_ns) % period_ns == 0
        assert LEAD_NS <= grid.start_ns - now_ns < LEAD_NS + period_ns


def test_utc_offset_leads_to_the_wall_clock() -> None:
    assert time.monotonic_ns() + utc_offset_ns() == pytest.approx(time.time_ns(), abs=5e6)


def test_ticks_are_on_the_grid_and_never_early() -> None:
    grid = TickGrid(time.monotonic_ns() + PERIOD_NS, PERIOD_NS)
    taken = list(islice(ticks(grid, never), 10))
    assert [tick.index for tick in taken] == list(range(10))
    assert [tick.scheduled_ns for tick in taken] == [grid.start_ns + k * PERIOD_NS for k in range(10)]
    assert all(tick.lateness_ns >= 0 for tick in taken)
    assert time.monotonic_ns() >= grid.start_ns + 9 * PERIOD_NS


def test_what_was_missed_comes_at_once_late_and_the_grid_stays() -> None:
    grid = TickGrid(time.monotonic_ns() + PERIOD_NS, PERIOD_NS)
    taken = []
    for tick in islice(ticks(grid, never), 12):
        taken.append(tick)
        if tick.index == 2:
            time.sleep(3.5 * PERIOD_NS * 1e-9)
            held_up_until_ns = time.monotonic_ns()
    assert [tick.scheduled_ns - grid.start_ns for tick in taken] == [k * PERIOD_NS for k in range(12)]
    missed = [tick for tick in taken[3:] if tick.scheduled_ns < held_up_until_ns]
    assert len(missed) >= 3
    assert all(tick.began_ns >= held_up_until_ns for tick in missed)
    assert missed[-1].began_ns - missed[0].began_ns < PERIOD_NS
    assert all(tick.lateness_ns == tick.began_ns - tick.scheduled_ns for tick in taken)
    assert taken[-1].lateness_ns < PERIOD_NS


def test_a_request_to_stop_is_heeded_between_ticks_far_apart() -> None:
    began = time.monotonic()
    grid = TickGrid(time.monotonic_ns() + 5_000_000_000, 10_000_000_000)
    assert list(ticks(grid, lambda: time.monotonic() > began + 0.05)) == []
    assert time.monotonic() - began < 1.0


def test_lateness_quantiles_agree_with_the_sorted_values() -> None:
    values_s = np.exp(np.random.default_rng(3).normal(np.log(1e-4), 1.5, 5000))
    lateness = Lateness(PERIOD_NS)
    for index, value_s in enumerate(values_s):
        lateness.add(TickTime(index, 0, int(value_s * 1e9)))
    summary = lateness.summary()
    for ours_s, q in [(summary.p50_s, 0.5), (summary.p99_s, 0.99)]:
        exact_s = np.quantile(values_s, q)
        assert exact_s * 0.99 < ours_s < exact_s * 1.27
    assert summary.max_s == pytest.approx(values_s.max(), abs=1e-9)
    assert summary.count == 5000 == sum(count for _, count in summary.histogram)
    assert summary.overruns == np.count_nonzero(values_s >= PERIOD_NS * 1e-9) > 0


def test_lateness_before_the_first_tick_and_beyond_the_last_bin() -> None:
    lateness = Lateness(PERIOD_NS)
    assert lateness.summary().count == 0
    lateness.add(TickTime(0, 0, 60_000_000_000))
    assert lateness.summary().histogram == [(60.0, 1)]
    assert lateness.summary().p50_s == 60.0

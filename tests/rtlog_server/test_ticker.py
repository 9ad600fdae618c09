"""Ticks in real time: on the grid, without gaps, honest about lateness; and the statistics of it."""

import random
import time
from itertools import islice

import numpy as np
import pytest

from rtlog_server import ticker
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
    before_ns = time.time_ns()
    here_ns = time.monotonic_ns() + utc_offset_ns()
    assert before_ns - 1_000_000 < here_ns < time.time_ns() + 1_000_000


def test_ticks_are_on_the_grid_and_never_early() -> None:
    grid = TickGrid(time.monotonic_ns() + PERIOD_NS, PERIOD_NS)
    taken = list(islice(ticks(grid, never), 10))
    assert [tick.index for tick in taken] == list(range(10))
    assert [tick.scheduled_ns for tick in taken] == [grid.start_ns + k * PERIOD_NS for k in range(10)]
    assert all(tick.lateness_ns >= 0 for tick in taken)
    assert time.monotonic_ns() >= grid.start_ns + 9 * PERIOD_NS


class FakeTime:
    """A clock that stands still but for sleeps."""

    def __init__(self) -> None:
        self.now_ns = 10**15

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@pytest.fixture
def fake_time(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    fake_time = FakeTime()
    monkeypatch.setattr(ticker, "time", fake_time)
    return fake_time


def test_what_was_missed_comes_at_once_late_and_the_grid_stays(fake_time: FakeTime) -> None:
    grid = TickGrid(fake_time.now_ns + PERIOD_NS, PERIOD_NS)
    taken = []
    for tick in islice(ticks(grid, never), 12):
        taken.append(tick)
        if tick.index == 2:
            fake_time.sleep(3.5 * PERIOD_NS * 1e-9)
    assert [tick.scheduled_ns - grid.start_ns for tick in taken] == [k * PERIOD_NS for k in range(12)]
    assert [tick.lateness_ns / PERIOD_NS for tick in taken] == [0, 0, 0, 2.5, 1.5, 0.5, *[0] * 6]


def test_a_tick_far_off_is_not_early(fake_time: FakeTime) -> None:
    grid = TickGrid(fake_time.now_ns + 5_000_000_000, 10_000_000_000)
    assert [tick.lateness_ns for tick in islice(ticks(grid, never), 3)] == [0, 0, 0]


def test_a_request_to_stop_is_heeded_between_ticks_far_apart(fake_time: FakeTime) -> None:
    began_ns = fake_time.now_ns
    grid = TickGrid(began_ns + 5_000_000_000, 10_000_000_000)
    assert list(ticks(grid, lambda: fake_time.now_ns > began_ns + 50_000_000)) == []
    assert fake_time.now_ns - began_ns < 1_000_000_000


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

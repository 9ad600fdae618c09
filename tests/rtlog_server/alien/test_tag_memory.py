"""Reads that count once, and when they were read."""

import random
import time

import pytest

from rtlog_server.devices.alien.tag_line import TagRead
from rtlog_server.devices.alien.tag_memory import MAX_TAGS, ReaderClock, TagMemory

SECOND_NS = 1_000_000_000


def line(count: int, seen_ms: int, discovered_ms: int = 0, epc: str = "E2", antenna: int = 0) -> TagRead:
    return TagRead(epc, antenna, count, -40.0, discovered_ms, seen_ms)


def reads(memory: TagMemory, tag: TagRead) -> int:
    sample = memory.take(tag, time.monotonic_ns())
    return 0 if sample is None else sample.count


def test_what_the_stream_and_a_poll_tell_counts_once() -> None:
    memory = TagMemory()
    told = [line(3, 30), line(3, 30), line(4, 40), line(6, 60), line(4, 40), line(6, 60), line(7, 60)]
    assert [reads(memory, tag) for tag in told] == [3, 0, 1, 2, 0, 0, 1]


def test_a_tag_that_came_back_onto_the_list_counts_anew() -> None:
    memory = TagMemory()
    assert reads(memory, line(9, 90, discovered_ms=10)) == 9
    assert reads(memory, line(2, 700, discovered_ms=650)) == 2


def test_antennas_are_kept_apart() -> None:
    memory = TagMemory()
    assert [reads(memory, line(5, 50, antenna=antenna)) for antenna in (0, 1, 0)] == [5, 5, 0]


def test_so_many_tags_are_remembered_and_no_more() -> None:
    memory = TagMemory()
    for number in range(2 * MAX_TAGS):
        reads(memory, line(1, number, epc=f"{number:X}"))
    assert len(memory._told) == MAX_TAGS


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 100e-6])
@pytest.mark.parametrize("error_ms", [-900, 0, 1400])
def test_a_right_clock_gives_the_time_of_the_read_from_late_deliveries(drift: float, error_ms: int) -> None:
    clock, rng = ReaderClock(), random.Random(1)
    start_ns, utc_ns = 10**15, 1_800_000_000 * SECOND_NS
    errors_ms = []
    for tenth in range(3000):  # five minutes
        read_s = tenth / 10
        reader_ms = int(utc_ns / 1e6 + read_s * 1000 * (1 + drift) + error_ms)
        receive_ns = start_ns + int((read_s + rng.expovariate(20.0)) * 1e9)
        measured_ns = clock.measured_ns(reader_ms, receive_ns, utc_ns + receive_ns - start_ns)
        assert measured_ns <= receive_ns
        errors_ms.append((measured_ns - start_ns) * 1e-6 - read_s * 1000)
    assert clock.right
    assert sorted(map(abs, errors_ms[50:]))[-1] < 8.0


def test_a_wrong_clock_is_not_believed() -> None:
    clock = ReaderClock()
    utc_ns = 1_800_000_000 * SECOND_NS
    assert clock.measured_ns(5000, 77, utc_ns) == 77
    assert not clock.right
    assert clock.measured_ns(None, 78, utc_ns) == 78
    assert clock.measured_ns(utc_ns // 1_000_000 + 60_000, 79, utc_ns) == 79

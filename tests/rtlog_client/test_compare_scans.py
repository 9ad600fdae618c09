"""Scans that come out of a replay are found among those that went in, by what they hold and when."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compared_drive import (
    MS,
    OFFSET,
    PERIOD,
    PROFILE,
    SCAN,
    START,
    TICKS,
    Compare,
    Rows,
    found,
    report,
    rows,
    scan,
    write,
)

from rtlog_client.compare import compare_recordings
from rtlog_client.log_file import LogWriter
from rtlog_server.messages import encode, to_ns
from rtlog_server.topics import PRIMARY_SCAN


@pytest.mark.parametrize(
    ("by_m", "what"), [(0.0004, []), (0.002, [("changed", 10, "")]), (np.inf, [("changed", 10, "")])]
)
def test_ranges_are_compared_to_the_millimetre_of_the_wire(compare: Compare, by_m: float, what: list[Any]) -> None:
    def change(out: Rows) -> None:
        out[SCAN, 10].ranges[3] += np.float32(by_m)

    assert found(compare(change), "laser/primary") == what


def test_a_scan_that_turned_is_not_the_same(compare: Compare) -> None:
    def change(out: Rows) -> None:
        out[SCAN, 10].angle_min += 0.01

    assert found(compare(change), "laser/primary") == [("changed", 10, "")]


@pytest.mark.parametrize(("off_ms", "what"), [(4, []), (8, [("stamp", 10, "")]), (-8, [("stamp", 10, "")])])
def test_stamps_have_a_tolerance(compare: Compare, off_ms: int, what: list[Any]) -> None:
    def change(out: Rows) -> None:
        out[SCAN, 10] = scan(10, START + OFFSET + 10 * PERIOD + (off_ms - 30) * MS)

    assert found(compare(change), "laser/primary") == what


def test_a_scan_in_a_later_tick_is_late(compare: Compare) -> None:
    def change(out: Rows) -> None:
        del out[SCAN, 11]
        out[SCAN, 11] = out.pop((SCAN, 10))

    assert found(compare(change), "laser/primary") == [("late", 10, ""), ("lost", 11, "")]


def test_what_never_went_in_is_extra(compare: Compare) -> None:
    def change(out: Rows) -> None:
        out[SCAN, 10] = scan(99, START + OFFSET + 10 * PERIOD - 60 * MS)

    assert found(compare(change), "laser/primary") == [("lost", 10, ""), ("extra", 10, "")]


def test_a_tick_takes_the_newest_of_many_scans(tmp_path: Path) -> None:
    write(tmp_path / "out.mcap", rows(OFFSET), OFFSET)
    with LogWriter(tmp_path / "in.mcap", {}, PROFILE) as log:
        for k in range(TICKS):
            for ahead in (4, 3, 2, 1, 0):
                tick_ns = START + k * PERIOD
                message = scan(k if ahead == 0 else 1000 + 7 * k + ahead, tick_ns - 30 * MS - ahead * 10 * MS)
                log.write(SCAN, PRIMARY_SCAN.msgtype, encode(message), tick_ns, to_ns(message.header.stamp))
    comparison = compare_recordings(tmp_path / "in.mcap", tmp_path / "out.mcap", report())
    (scanner,) = comparison.devices
    assert (scanner.went_in, scanner.same, scanner.superseded, scanner.differences) == (300, 60, 240, [])

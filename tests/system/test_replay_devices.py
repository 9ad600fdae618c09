"""The whole way round, with the real commands: recording → emulators → server → zenoh → recording. What comes out is
what went in, but for what a pulled cable takes. How soon a scanner is back, and that nothing else differs by more than
some milliseconds, is measured in the long tests.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtlog_client.log_file import read_info, read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import PRIMARY_SCAN, TAGS, TICK

sys.path.insert(0, str(Path(__file__).parents[1] / "hil"))
from drives import BEFORE_TICK_NS, EPCS, PERIOD_NS, START_NS, SWEEP_NS, Drive, ranges_m
from rig import Played, Rig, write_profile

TICKS = 50
FIRST_RAY_NS = BEFORE_TICK_NS + SWEEP_NS  # before the tick
CUT = '[[fault]]\ndevice = "laser/primary"\nkind = "cut"\nat_s = 1.5\nfor_s = 0.8\n'
CLOCKS_NS = 1_000_000  # by which wall clock and monotonic clock may part, and stamps are cut


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    folder = tmp_path_factory.mktemp("round_trip")
    Drive(TICKS * PERIOD_NS * 1e-9).write(folder / "drive.mcap")
    return Rig(folder, write_profile(folder)).play(folder / "drive.mcap", CUT)


def messages(played: Played, topic: Any) -> list[tuple[int, Any]]:
    """With the times of their ticks."""
    rows = read_messages(played.came_out, [topic.name])
    return [(message.log_time_ns, decode(message.data, message.msgtype)) for message in rows]


def test_nothing_is_lost_on_the_link(played: Played) -> None:
    assert (played.report["scans"], played.report["tag_reads"]) == (TICKS, 10)
    assert played.summary["lost"] == {}
    assert read_info(played.came_out).metadata["vehicle"] == "bench"
    assert played.comparison["missing_ticks"] == 0


def test_what_the_cut_took_is_told(played: Played) -> None:
    [cut] = played.report["faults"]
    scanner = played.device("laser/primary")
    taken = [d for d in scanner["differences"] if d["cause"].startswith("cut of laser/primary at ")]
    assert taken
    assert all(d["stamp_ns"] + FIRST_RAY_NS + played.report["offset_ns"] > cut["from_ns"] for d in taken)
    assert scanner["same"] + scanner["superseded"] + len(scanner["differences"]) >= TICKS
    assert played.device("encoders")["went_in"] == TICKS


def test_scans_come_back_to_the_millimetre(played: Played) -> None:
    """Looked at without the help of `compare`."""
    [cut] = played.report["faults"]
    scheduled_ns = {tick_ns: to_ns(tick.scheduled) for tick_ns, tick in messages(played, TICK)}
    stamps_ns, numbers = [], []
    begin_ns = START_NS - FIRST_RAY_NS + played.report["offset_ns"]
    for tick_ns, scan in messages(played, PRIMARY_SCAN):
        if to_ns(scan.header.stamp) < begin_ns - PERIOD_NS // 2:
            continue  # before the drive, while the vehicle stands at its first scan
        k = round(float(scan.ranges[0]) * 1000) - 1000  # the drive writes the scan's number there
        stamps_ns.append(to_ns(scan.header.stamp))
        numbers.append(k)
        np.testing.assert_allclose(scan.ranges, ranges_m(k), atol=1e-6)
        assert scan.angle_min == pytest.approx(np.radians(-135.0), abs=1e-6)
        assert scan.angle_increment == pytest.approx(np.radians(0.5), abs=1e-6)
        assert begin_ns + k * PERIOD_NS - CLOCKS_NS < stamps_ns[-1]
        assert stamps_ns[-1] + SWEEP_NS < scheduled_ns[tick_ns] + CLOCKS_NS
    assert numbers == sorted(set(numbers))
    assert stamps_ns[0] < cut["from_ns"] < cut["to_ns"] < stamps_ns[-1]  # it was lost, and is back


def test_tags_are_read_as_often_as_they_were(played: Played) -> None:
    reads = [read for _, message in messages(played, TAGS) for read in message.reads]
    assert {read.epc for read in reads} == {EPCS[0]}
    assert {read.rssi for read in reads} <= {-40.0 - k for k in range(10)}
    assert sum(read.count for read in reads) == sum(1 + k % 3 for k in range(10))

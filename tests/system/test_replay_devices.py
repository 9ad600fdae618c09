"""The whole way round, with the real commands: recording → emulators → server → zenoh → recording. What comes out is
what went in, but for what a pulled cable takes."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtlog_client.log_file import read_info, read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import PRIMARY_SCAN, TAGS

sys.path.insert(0, str(Path(__file__).parents[1] / "hil"))
from drives import BEFORE_TICK_NS, EPCS, PERIOD_NS, START_NS, SWEEP_NS, Drive, ranges_m
from rig import Played, Rig, write_profile

TICKS = 50
FIRST_RAY_NS = BEFORE_TICK_NS + SWEEP_NS  # before the tick
CUT = '[[fault]]\ndevice = "laser/primary"\nkind = "cut"\nat_s = 1.5\nfor_s = 0.8\n'
CUT_TICKS = range(15, 23)
BACK_TICKS = 20  # within which a scanner is back


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    folder = tmp_path_factory.mktemp("round_trip")
    Drive(TICKS * PERIOD_NS * 1e-9).write(folder / "drive.mcap")
    return Rig(folder, write_profile(folder)).play(folder / "drive.mcap", CUT)


def messages(played: Played, topic: Any) -> list[Any]:
    return [decode(message.data, message.msgtype) for message in read_messages(played.came_out, [topic.name])]


def test_nothing_is_lost_on_the_link(played: Played) -> None:
    assert (played.report["scans"], played.report["tag_reads"]) == (TICKS, 10)
    assert played.summary["lost"] == {}
    assert read_info(played.came_out).metadata["vehicle"] == "bench"
    assert played.comparison["missing_ticks"] == 0


def test_what_the_cut_took_is_told_and_nothing_else_is_missing(played: Played) -> None:
    assert played.unexplained() == []
    scanner = played.device("laser/primary")
    taken = [d for d in scanner["differences"] if d["cause"] == "cut of laser/primary at 1.5–2.3 s"]
    ticks = {round((d["stamp_ns"] + FIRST_RAY_NS - START_NS) / PERIOD_NS) for d in taken if d["what"] == "lost"}
    assert set(list(CUT_TICKS)[1:-1]) <= ticks <= set(range(CUT_TICKS.start, CUT_TICKS.stop + BACK_TICKS))
    assert scanner["same"] + scanner["superseded"] + len(scanner["differences"]) >= TICKS
    assert played.device("encoders")["went_in"] == TICKS


def test_scans_come_back_to_the_millimetre(played: Played) -> None:
    """Looked at without the help of `compare`."""
    found = 0
    for scan in messages(played, PRIMARY_SCAN):
        ticks = (to_ns(scan.header.stamp) + FIRST_RAY_NS - played.report["offset_ns"] - START_NS) / PERIOD_NS
        if ticks > -0.5:
            found += 1
            np.testing.assert_allclose(scan.ranges, ranges_m(round(ticks)), atol=1e-6)
            assert abs(ticks - round(ticks)) * PERIOD_NS < 20e6
            assert scan.angle_min == pytest.approx(np.radians(-135.0), abs=1e-6)
            assert scan.angle_increment == pytest.approx(np.radians(0.5), abs=1e-6)
    assert found >= TICKS - len(CUT_TICKS) - BACK_TICKS


def test_tags_are_read_as_often_as_they_were(played: Played) -> None:
    reads = [read for message in messages(played, TAGS) for read in message.reads]
    assert {read.epc for read in reads} == {EPCS[0]}
    assert {read.rssi for read in reads} <= {-40.0 - k for k in range(10)}
    assert sum(read.count for read in reads) == sum(1 + k % 3 for k in range(10))

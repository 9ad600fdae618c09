"""Every way in which what comes out can differ from what went in is found, and told with its cause."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hw_profiles.errors import BadInputError
from rtlog_client.cli import main
from rtlog_client.compare import Comparison, compare_recordings
from rtlog_client.log_file import LogWriter
from rtlog_client.replay_report import PlayedFault, ReplayReport, Stall, load_report
from rtlog_server.messages import JointState, LaserScan, TagRead, TagReads, Tick, encode, header, to_ns, to_time
from rtlog_server.topics import JOINT_STATES, PRIMARY_SCAN, TAGS, TICK, Topic

MS = 1_000_000
PERIOD = 100 * MS
START = 1_700_000_000_000_000_000
OFFSET = 95_000_000_000_000_000
TICKS = 60
BEAMS = 11
NOTHING = np.empty(0)
PROFILE = """
schema = 1
name = "bench"
vehicle = { kinematics = "differential", track_width_m = 1.6 }
encoder_bus = { kind = "sei", port = "/tmp/x" }
rfid = { device = { host = "127.0.0.1" } }
[lasers.primary]
device = { host = "127.0.0.1" }
[[encoders]]
name = "left"
role = "left_wheel"
wheel_radius_m = 0.35
address = 0
[[encoders]]
name = "right"
role = "right_wheel"
wheel_radius_m = 0.35
address = 1
"""

Message = tuple[Topic, Any, int]  # topic, content, log time
Rows = dict[tuple[str, int], Any]  # topic and tick: content


def scan(k: int, stamp_ns: int) -> Any:
    ranges = np.float32(1 + (np.arange(BEAMS) * 7 + k * 13) % 101 / 10)
    return LaserScan(header(stamp_ns, ""), -1.0, 0.0, 0.1, 0.0, 0.02, 0.016, 20.0, ranges, np.float32(NOTHING))


def joints(elapsed_s: float, stamp_ns: int, turns: int = 0) -> Any:
    angles = np.array([4 * elapsed_s, 3 * elapsed_s + math.tau * turns])
    return JointState(header(stamp_ns, ""), ["left", "right"], angles, NOTHING, NOTHING)


def rows(offset_ns: int = 0, turns: int = 0) -> Rows:
    """A drive, as it was (offset 0) and as it is replayed."""
    found: Rows = {}
    for k in range(TICKS):
        tick_ns = START + offset_ns + k * PERIOD
        reads = [TagRead(to_time(tick_ns - 30 * MS), "E200", 0, 2, -40.0)] if 20 <= k < 30 else []
        found[TICK.name, k] = Tick(header(tick_ns, ""), k, to_time(tick_ns), 1e-5, [])
        found[PRIMARY_SCAN.name, k] = scan(k, tick_ns - 30 * MS)
        found[JOINT_STATES.name, k] = joints(k * 0.1 - 0.01, tick_ns - 10 * MS, turns)
        found[TAGS.name, k] = TagReads(header(tick_ns, ""), reads)
    return found


def write(path: Path, found: Rows, offset_ns: int, sequences: dict[tuple[str, int], int] | None = None) -> None:
    path.unlink(missing_ok=True)
    topics = {topic.name: topic for topic in (TICK, PRIMARY_SCAN, JOINT_STATES, TAGS)}
    with LogWriter(path, {"vehicle": "bench"}, PROFILE) as log:
        for (name, k), message in sorted(found.items(), key=lambda row: row[0][1]):
            tick_ns, stamp_ns = START + offset_ns + k * PERIOD, to_ns(message.header.stamp)
            number = None if sequences is None else sequences[name, k]
            log.write(name, topics[name].msgtype, encode(message), tick_ns, stamp_ns, number)


def report(*faults: PlayedFault, stalls: tuple[Stall, ...] = ()) -> ReplayReport:
    end_ns = START + (TICKS - 1) * PERIOD
    return ReplayReport(OFFSET, START, end_ns, TICKS, 0, 10, faults=list(faults), stalls=list(stalls))


def fault(kind: str, device: str, first: int, last: int) -> PlayedFault:
    """From tick to tick."""
    host_ns = START + OFFSET
    return PlayedFault(device, kind, host_ns + first * PERIOD, host_ns + last * PERIOD)


Compare = Callable[..., Comparison]


@pytest.fixture
def compare(tmp_path: Path) -> Compare:
    """Changes what came out and compares."""
    write(tmp_path / "in.mcap", rows(), 0)

    def run(change: Callable[[Rows], object], told: ReplayReport | None = None, **more: Any) -> Comparison:
        came_out = rows(OFFSET, turns=3)  # of the right wheel, which stands elsewhere in its turn when it is found
        change(came_out)
        write(tmp_path / "out.mcap", came_out, OFFSET, **more)
        return compare_recordings(tmp_path / "in.mcap", tmp_path / "out.mcap", told or report())

    return run


def found(comparison: Comparison, name: str) -> list[tuple[str, int, str]]:
    """What, tick, cause."""
    device = next(device for device in comparison.devices if device.device == name)
    return [(difference.what, difference.tick, difference.cause) for difference in device.differences]


def test_the_same_is_the_same(compare: Compare) -> None:
    comparison = compare(len)
    assert comparison.same
    assert (comparison.ticks, comparison.missing_ticks, comparison.overruns) == (TICKS, 0, 0)
    figures = {device.device: (device.went_in, device.same, device.superseded) for device in comparison.devices}
    assert figures == {"laser/primary": (60, 60, 0), "encoders": (60, 60, 0), "rfid": (10, 10, 0)}
    assert not any(device.differences for device in comparison.devices)


SCAN = PRIMARY_SCAN.name


def lose(topic: str, *ticks: int) -> Callable[[Rows], None]:
    def change(out: Rows) -> None:
        for k in ticks:
            del out[topic, k]

    return change


def test_a_scan_that_nobody_can_explain_is_a_failure(compare: Compare) -> None:
    comparison = compare(lose(SCAN, 30))
    assert found(comparison, "laser/primary") == [("lost", 30, "")]
    assert not comparison.same


def test_what_a_fault_took_has_its_name_and_tick(compare: Compare) -> None:
    told = report(fault("cut", "laser/primary", 30, 33))
    cause = "cut of laser/primary at 3.0–3.3 s"
    comparison = compare(lose(SCAN, 30, 31, 32, 33, 50), told)  # a device is back within two seconds
    assert found(comparison, "laser/primary") == [("lost", k, cause) for k in (30, 31, 32, 33, 50)]
    assert comparison.same
    comparison = compare(lose(SCAN, 29, 55), told)
    assert found(comparison, "laser/primary") == [("lost", 29, ""), ("lost", 55, "")]
    comparison = compare(lose(SCAN, 31), report(fault("cut", "encoders", 30, 33)))
    assert not comparison.same


def test_both_devices_of_a_swap_feel_it(compare: Compare) -> None:
    swap = PlayedFault("laser/auxiliary", "swap", START + OFFSET, START + OFFSET + PERIOD, "laser/primary")
    comparison = compare(lose(SCAN, 1), report(swap))
    assert found(comparison, "laser/primary") == [
        ("lost", 1, "swap of laser/auxiliary with laser/primary at 0.0–0.1 s")
    ]


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


def test_before_recording_began_nothing_is_lost(compare: Compare) -> None:
    comparison = compare(lambda out: [out.pop(key) for key in list(out) if key[1] < 15])
    assert comparison.same
    assert found(comparison, "laser/primary") == [("lost", k, "before recording began") for k in range(15)]
    assert {cause for _, _, cause in found(comparison, "encoders")} == {"before recording began"}
    comparison = compare(lambda out: [out.pop(key) for key in list(out) if key[1] > 50])
    assert comparison.same
    assert {cause for _, _, cause in found(comparison, "laser/primary")} == {"after recording ended"}


def test_a_hole_in_the_sequence_numbers_is_the_link(compare: Compare) -> None:
    comparison = compare(lose(SCAN, 30, 31), sequences={key: key[1] for key in rows()})
    assert found(comparison, "laser/primary") == [("lost", 30, "lost on the link"), ("lost", 31, "lost on the link")]
    renumbered = {(name, k): k if k < 30 else k - 2 for name, k in rows()}
    comparison = compare(lose(SCAN, 30, 31), sequences=renumbered)
    assert found(comparison, "laser/primary") == [("lost", 30, ""), ("lost", 31, "")]


def test_a_missing_tick_is_a_failure(compare: Compare) -> None:
    comparison = compare(lambda out: out.pop((TICK.name, 30)))
    assert (comparison.missing_ticks, comparison.same) == (1, False)


def test_a_machine_that_stood_still_is_a_cause(compare: Compare) -> None:
    host_ns = START + OFFSET + 30 * PERIOD
    told = report(stalls=(Stall(host_ns - 40 * MS, host_ns - 20 * MS),))
    assert found(compare(lose(SCAN, 30), told), "laser/primary") == [("lost", 30, "the replaying machine stood still")]

    def change(out: Rows) -> None:
        del out[SCAN, 30]
        out[TICK.name, 30].lateness = 0.12

    comparison = compare(change)
    assert found(comparison, "laser/primary") == [("lost", 30, "the server stood still")]
    assert comparison.overruns == 1


def test_a_gap_of_the_input_is_told_as_such(tmp_path: Path) -> None:
    went_in, came_out = rows(), rows(OFFSET)
    for k in range(20, 28):
        del went_in[SCAN, k], came_out[SCAN, k]
    for k in range(28, 33):  # while the driver connects anew
        del came_out[SCAN, k]
    write(tmp_path / "in.mcap", went_in, 0)
    write(tmp_path / "out.mcap", came_out, OFFSET)
    comparison = compare_recordings(tmp_path / "in.mcap", tmp_path / "out.mcap", report())
    assert comparison.same
    cause = "after a gap of 0.9 s in the recording that went in"
    assert found(comparison, "laser/primary") == [("lost", k, cause) for k in range(28, 33)]


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


JOINTS = JOINT_STATES.name


def test_encoders_are_held_to_their_track(compare: Compare) -> None:
    def change(out: Rows) -> None:
        out[JOINTS, 30].position[0] += 0.1  # at 4 rad/s: 25 ms
        del out[JOINTS, 31]
        out[JOINTS, 32].position[0] += 0.02  # 5 ms

    assert found(compare(change), "encoders") == [("changed", 30, ""), ("lost", 31, "")]


def test_an_encoder_that_is_left_out_is_lost(compare: Compare) -> None:
    def change(out: Rows) -> None:
        stamp_ns = START + OFFSET + 30 * PERIOD - 10 * MS
        out[JOINTS, 30] = JointState(header(stamp_ns, ""), ["left"], np.array([4 * 2.99]), NOTHING, NOTHING)

    comparison = compare(change)
    assert found(comparison, "encoders") == [("lost", 30, "")]
    assert comparison.devices[1].differences[0].detail == "right"


def test_turns_that_nobody_saw_are_told_once(compare: Compare) -> None:
    def change(out: Rows) -> None:
        for k in range(30, TICKS):
            out[JOINTS, k].position[1] -= math.tau

    assert found(compare(change), "encoders") == [("turns", 30, "")]
    comparison = compare(change, report(fault("cut", "encoders", 20, 30)))
    assert found(comparison, "encoders") == [("turns", 30, "cut of encoders at 2.0–3.0 s")]
    figures = comparison.devices[1].figures
    assert figures["right_turned_in_rad"] - figures["right_turned_out_rad"] == pytest.approx(math.tau, abs=1e-3)
    assert figures["left_turned_in_rad"] == pytest.approx(figures["left_turned_out_rad"], abs=1e-3)


READS = TAGS.name


def test_reads_may_come_together_but_not_late(compare: Compare) -> None:
    def together(out: Rows) -> None:
        out[READS, 24].reads = []
        out[READS, 25].reads[0].count = 4

    assert found(compare(together), "rfid") == []

    def late(out: Rows) -> None:
        out[READS, 23].reads = []
        together(out)
        out[READS, 25].reads[0].count = 6

    assert found(compare(late), "rfid") == [("late", 23, "")]

    def too_few(out: Rows) -> None:
        out[READS, 24].reads[0].count = 1

    assert found(compare(too_few), "rfid") == [("lost", 24, "")]

    def too_many(out: Rows) -> None:
        out[READS, 24].reads[0].count = 3

    assert found(compare(too_many), "rfid") == [("extra", 24, "")]

    def weaker(out: Rows) -> None:
        out[READS, 24].reads[0].rssi = -50.0

    assert found(compare(weaker), "rfid") == [("changed", 24, "")]


def test_a_reader_says_in_each_tick_that_it_is_there(compare: Compare) -> None:
    assert found(compare(lose(READS, 40)), "rfid") == [("silent", 40, "")]
    assert found(compare(lose(READS, 24)), "rfid") == [("lost", 24, ""), ("silent", 24, "")]


def test_one_clock_needs_no_report(tmp_path: Path) -> None:
    write(tmp_path / "in.mcap", rows(), 0)
    write(tmp_path / "out.mcap", rows(), 0)
    assert compare_recordings(tmp_path / "in.mcap", tmp_path / "out.mcap").same


def test_the_command_says_what_differs_and_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "in.mcap", rows(), 0)
    came_out = rows(OFFSET)
    del came_out[SCAN, 30]
    write(tmp_path / "out.mcap", came_out, OFFSET)
    (tmp_path / "r.json").write_text(report().to_json())
    assert load_report(tmp_path / "r.json") == report()
    line = ["compare", str(tmp_path / "in.mcap"), str(tmp_path / "out.mcap"), "--replay", str(tmp_path / "r.json")]
    assert main(line) == 1
    assert "laser/primary: 1 lost, from tick 30: UNEXPLAINED" in capsys.readouterr().out
    assert main([*line, "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["devices"][0]["differences"][0]["stamp_ns"] == START + 30 * PERIOD - 30 * MS
    (tmp_path / "r.json").write_text(report(fault("cut", "laser/primary", 29, 30)).to_json())
    assert main(line) == 0


@pytest.mark.parametrize(
    ("text", "message"), [("{}", "missing required field"), ("no JSON", "not what rtlog-client replay --to devices")]
)
def test_a_report_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(BadInputError, match=message):
        load_report(tmp_path / "r.json")


def test_what_is_no_recording_of_ours_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "in.mcap", rows(), 0)
    with LogWriter(tmp_path / "bare.mcap", {}, None) as log:
        message = scan(0, START)
        log.write(SCAN, PRIMARY_SCAN.msgtype, encode(message), START, START)
        log.write(SCAN, PRIMARY_SCAN.msgtype, encode(message), START + 1, START)
    with pytest.raises(BadInputError, match=r"bare\.mcap: no profile in it"):
        compare_recordings(tmp_path / "in.mcap", tmp_path / "bare.mcap")
    write(tmp_path / "tickless.mcap", {key: row for key, row in rows().items() if key[0] != TICK.name}, 0)
    with pytest.raises(BadInputError, match=r"tickless\.mcap: 0 /rtlog/tick in it"):
        compare_recordings(tmp_path / "in.mcap", tmp_path / "tickless.mcap")

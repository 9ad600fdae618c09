"""Every way in which what comes out can differ from what went in is told with its cause."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from compared_drive import (
    MS,
    OFFSET,
    PERIOD,
    SCAN,
    START,
    TICKS,
    Compare,
    Rows,
    fault,
    found,
    lose,
    report,
    rows,
    scan,
    write,
)

from hw_profiles.errors import BadInputError
from rtlog_client.cli import main
from rtlog_client.compare import compare_recordings
from rtlog_client.log_file import LogWriter
from rtlog_client.replay_report import PlayedFault, Stall, load_report
from rtlog_server.messages import encode
from rtlog_server.topics import PRIMARY_SCAN, TICK


def test_the_same_is_the_same(compare: Compare) -> None:
    comparison = compare(len)
    assert comparison.same
    assert (comparison.ticks, comparison.missing_ticks, comparison.overruns) == (TICKS, 0, 0)
    figures = {device.device: (device.went_in, device.same, device.superseded) for device in comparison.devices}
    assert figures == {"laser/primary": (60, 60, 0), "encoders": (60, 60, 0), "rfid": (10, 10, 0)}
    assert not any(device.differences for device in comparison.devices)


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
    bytes_of_another = replace(report(), capture_of="laser/auxiliary")
    with pytest.raises(BadInputError, match=r"in\.mcap: its vehicle has no scanner laser/auxiliary"):
        compare_recordings(tmp_path / "captured.bin", tmp_path / "in.mcap", bytes_of_another)

"""Captured bytes of real scanners: cut at their telegrams, not a byte lost, each scan at its device's time."""

from pathlib import Path

import numpy as np
import pytest

from hw_profiles.errors import BadInputError
from rtlog_client.capture import capture_events, read_capture
from rtlog_client.cli import main
from rtlog_server.devices.lms111.cola import Dialect

DATA = Path("../shared/data/lms111")
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the captures of real scanners are not beside the repository")


@needs_data
def test_a_session_of_a_real_scanner_is_cut_at_its_scans() -> None:
    path = DATA / "colab_dev2host.bin"
    capture = read_capture(path)
    assert (capture.dialect, capture.scans) == (Dialect.B, 80)
    assert b"".join(piece.data for piece in capture.pieces) == path.read_bytes()
    assert capture.pieces[0].elapsed_ns == 0
    assert capture.pieces[-1].elapsed_ns * 1e-9 == pytest.approx(76 * 0.0201, abs=0.05)  # 77 distinct, a slow motor
    events = list(capture_events(capture, "laser/primary"))
    assert len(events) == 77
    assert np.diff([event.stamp_ns for event in events]) * 1e-9 == pytest.approx(0.0201, abs=0.0003)
    assert {len(event.content.ranges) for event in events} == {541}


@needs_data
def test_a_telegram_in_text_is_one_too() -> None:
    capture = read_capture(DATA / "lms_cola_a_scan541_cont.bin")
    assert (capture.dialect, capture.scans) == (Dialect.A, 1)


@pytest.mark.parametrize("data", [b"", b"\x02\x02\x02\x02\x00\x00\x00\x04abcd\x00", b"\x02sRA 0\x03", bytes(1000)])
def test_bytes_without_a_scan_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "c.bin").write_bytes(data)
    with pytest.raises(BadInputError, match=r"c\.bin: no LMDscandata telegram in it"):
        read_capture(tmp_path / "c.bin")
    with pytest.raises(BadInputError, match=r"d\.bin: No such file"):
        read_capture(tmp_path / "d.bin")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--to", "devices", "--device", "rfid"], "gives no scanner rfid an address; it has laser/primary"),
        (["--to", "devices", "--device", "laser/primary", "--start", "3"], "--start and --duration are for recordings"),
        (["--to", "zenoh", "--device", "laser/primary"], "--rate, --faults and --device are for --to devices"),
        (["--to", "zenoh", "--rate", "2"], "--rate, --faults and --device are for --to devices"),
    ],
)
def test_what_cannot_be_replayed_is_refused(
    tmp_path: Path, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.bin").write_bytes(b"x")
    assert main(["replay", str(tmp_path / "c.bin"), *options]) == 2
    assert message in capsys.readouterr().err

"""Real telegrams: each decodes to the values that another program found in it, and is written as it was."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtlog_server.devices.lms111.cola import Dialect, Receiver, frame
from rtlog_server.devices.lms111.protocol import Command, decode, encode_command
from rtlog_server.devices.lms111.scan_data import ScanData, encode_scan_data

CAPTURES = Path(__file__).parents[4] / "shared" / "data" / "lms111"
needs_captures = pytest.mark.skipif(not CAPTURES.is_dir(), reason=f"no captured sessions in {CAPTURES}")


def captured_payloads() -> list[bytes]:
    return Receiver(Dialect.B).feed((CAPTURES / "colab_dev2host.bin").read_bytes())


def as_in_the_index(scan: ScanData) -> dict[str, Any]:
    """The fields of a scan as colab_decoded.json has them."""
    fields = {name: getattr(scan, name) for name in ScanData.__slots__ if name != "event"}
    return fields | {
        "channels16": [
            {
                "content": c.content,
                "scale_factor": c.scale_factor,
                "scale_offset": c.scale_offset,
                "start_angle_1e4deg": c.start_angle_1e4deg,
                "angular_step_1e4deg": c.angular_step_1e4deg,
                "count": len(c.data),
                "data": c.data.tolist(),
            }
            for c in scan.channels16
        ],
        "channels8": list(scan.channels8),
        "encoders": list(scan.encoders),
        "device_status": list(scan.device_status),
        "digital_inputs": list(scan.digital_inputs),
        "digital_outputs": list(scan.digital_outputs),
        "time": scan.time._asdict() if scan.time else None,
    }


@needs_captures
def test_the_captured_scans() -> None:
    expected = json.loads((CAPTURES / "colab_decoded.json").read_text())
    scans = [s for s in (decode(Dialect.B, payload) for payload in captured_payloads()) if isinstance(s, ScanData)]
    assert len(scans) == 80  # the stream ends before the last of the 81 that are listed
    for scan, values in zip(scans, expected[:80], strict=True):
        known = {key: value for key, value in values.items() if key not in ("command", "trailing", "trailing_unparsed")}
        assert as_in_the_index(scan) == known
        assert scan.event is None  # the two bytes that the index calls trailing
        assert scan.channels16[0].data.dtype == np.uint16


@needs_captures
def test_the_captured_telegrams_one_by_one() -> None:
    raw = (CAPTURES / "colab_dev2host.bin").read_bytes()
    index = [e for e in json.loads((CAPTURES / "colab_index.json").read_text()) if e["dir"] == "dev>host"]
    payloads = captured_payloads()
    assert [len(payload) + 9 for payload in payloads] == [entry["len"] for entry in index]
    receiver = Receiver(Dialect.B)
    assert [p for byte in raw for p in receiver.feed(bytes([byte]))] == payloads
    assert receiver.skipped_bytes == 0


@needs_captures
def test_the_captured_scans_are_written_as_they_were() -> None:
    for payload in captured_payloads():
        scan = decode(Dialect.B, payload)
        if isinstance(scan, ScanData):
            assert encode_scan_data(Dialect.B, scan) == frame(Dialect.B, payload)


@needs_captures
def test_the_captured_requests() -> None:
    payloads = Receiver(Dialect.B).feed((CAPTURES / "colab_host2dev.bin").read_bytes())
    assert len(payloads) > 40
    for payload in payloads:
        command = decode(Dialect.B, payload)
        assert isinstance(command, Command)
        assert encode_command(Dialect.B, command.name, *command.values) == frame(Dialect.B, payload)


@needs_captures
@pytest.mark.parametrize(
    ("file", "command", "counts", "codes"),
    [
        ("lms_cola_a_scan541_cont.bin", "sSN LMDscandata", 541, {0: 12, 3: 51}),
        ("lms_cola_a_manual_example_21pts.bin", "sRA LMDscandata", 21, {}),
    ],
)
def test_real_telegrams_of_cola_a(file: str, command: str, counts: int, codes: dict[int, int]) -> None:
    raw = (CAPTURES / file).read_bytes()
    (payload,) = Receiver(Dialect.A).feed(raw)
    scan = decode(Dialect.A, payload)
    assert isinstance(scan, ScanData)
    distances = scan.channels16[0].data
    assert len(distances) == counts
    assert {code: int((distances == code).sum()) for code in range(16) if (distances == code).any()} == codes
    words = payload.split()
    first = words.index(b"DIST1") + 6
    assert distances.tolist() == [int(word, 16) for word in words[first : first + counts]]
    assert encode_scan_data(Dialect.A, scan, command) == raw
    newer = decode(Dialect.A, payload + b" 0 AB")  # a firmware that says more
    assert isinstance(newer, ScanData)
    assert encode_scan_data(Dialect.A, newer, command) == raw
    for cut in range(1, len(raw)):
        receiver = Receiver(Dialect.A)
        assert receiver.feed(raw[:cut]) + receiver.feed(raw[cut:]) == [payload]
    receiver = Receiver(Dialect.A)
    assert [p for byte in raw + raw for p in receiver.feed(bytes([byte]))] == [payload, payload]

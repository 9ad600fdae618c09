"""The LMS111's bytes from a hostile wire: framing, decoding, scans, clock. With coverage as its guide (atheris).

    python fuzz_lms111.py WAY RUNS CORPUS      way: stream-A, stream-B, payload-A, payload-B; corpus: a folder to fill

The law under test: whatever comes, the parser raises nothing but ColaError, keeps less than two telegrams, and no scan
that it lets pass can hold up the sampler: it is complete before it was received, and began not long before that.
"""

import sys
from contextlib import suppress

import atheris
import numpy as np
from fuzzing import fuzz

with atheris.instrument_imports(include=["rtlog_server.devices.lms111", "rtlog_server.clock"]):
    from rtlog_server.clock import DeviceClock
    from rtlog_server.devices.lms111.cola import MAX_PAYLOAD_BYTES, ColaError, Dialect, Receiver, frame
    from rtlog_server.devices.lms111.protocol import LAYOUTS, decode, encode_command
    from rtlog_server.devices.lms111.scan_data import Channel, Encoder, Event, ScanData, encode_scan_data
    from rtlog_server.devices.lms111.sweep import period_us, to_scan

RECEIVED_NS = 10**15
OLDEST_NS = 10 * 10**9  # a scan of a device that buffers for five seconds, and a slow turn or two
STREAM_PIECE = 37


def try_payload(dialect: Dialect, payload: bytes, clock: DeviceClock) -> None:
    """From a payload to a Scan, with what must hold of it."""
    telegram = decode(dialect, payload)
    if not isinstance(telegram, ScanData):
        return
    for echo in ("first", "last"):
        transmitted_ns = clock.update(telegram.time_of_transmission_us, RECEIVED_NS)
        scan = to_scan(telegram, transmitted_ns, period_us(telegram, telegram), echo)
        assert transmitted_ns <= RECEIVED_NS
        assert scan.measured_ns <= scan.complete_ns <= transmitted_ns
        assert transmitted_ns - scan.measured_ns <= OLDEST_NS
        assert scan.ranges_m.dtype == scan.intensities.dtype == np.float32
        assert len(scan.intensities) in (0, len(scan.ranges_m))
        assert not (scan.ranges_m <= 0).any()


def try_stream(dialect: Dialect, data: bytes) -> None:
    """From bytes, in pieces and in one, to Scans."""
    receiver, clock = Receiver(dialect), DeviceClock()
    payloads = []
    for start in range(0, len(data), STREAM_PIECE):
        payloads += receiver.feed(data[start : start + STREAM_PIECE])
        assert len(receiver._buffer) <= MAX_PAYLOAD_BYTES + 9
    whole = Receiver(dialect)
    assert whole.feed(data) == payloads
    framed = sum(len(frame(dialect, payload)) for payload in payloads)
    assert framed + receiver.skipped_bytes + len(receiver._buffer) == len(data)
    for payload in payloads:
        with suppress(ColaError):
            try_payload(dialect, payload, clock)


def samples(dialect: Dialect) -> list[bytes]:
    """A telegram of each kind that there is."""
    telegrams = []
    for name, layout in LAYOUTS.items():
        values = ["text" if code == "s" else 7 for code in layout]
        telegrams.append(encode_command(dialect, name, *values))
    data16, data8 = np.array([0, 1, 3, 16, 65535], np.uint16), np.array([0, 1, 255, 3, 4], np.uint8)
    wide = [Channel(content, 1.0, 0.0, -450_000, 5000, data16) for content in ("DIST1", "RSSI1", "DIST2")]
    narrow = [Channel("RSSI2", 1.0, 0.0, -450_000, 5000, data8)]
    scan = ScanData(1, 1, 9, (0, 2), 7, 8, 5000, 25_000, (0, 0), (7, 0), 0, 5000, 360, (), tuple(wide), tuple(narrow))
    telegrams.append(encode_scan_data(dialect, scan))
    full = ScanData(
        *(1, 1, 9, (1, 0), 65535, 0, 2**32 - 1, 9000, (0, 0), (7, 0), 0, 2500, 360, (Encoder(-1, 5),), tuple(wide[:1])),
        *((), (0.0,) * 6 + (1, 2), "Derecha", "no comment", (1970, 1, 1, 0, 0, 1, 5), Event("FDIN", 1, 2, 3)),
    )
    return [*telegrams, encode_scan_data(dialect, full)]


def main(way: str) -> None:
    kind, name = way.split("-")
    dialect = Dialect[name]
    telegrams = samples(dialect)
    payloads = [payload for telegram in telegrams for payload in Receiver(dialect).feed(telegram)]

    def try_one(data: bytes) -> None:
        if kind == "stream":
            try_stream(dialect, data)
        else:
            with suppress(ColaError):
                try_payload(dialect, data, DeviceClock())

    fuzz(try_one, telegrams if kind == "stream" else payloads, longest=800)


if __name__ == "__main__":
    main(sys.argv[1])

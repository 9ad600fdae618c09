"""What a replay takes from a recording: scans and reads in the order of their stamps."""

import math
from pathlib import Path

import numpy as np
import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Encoder
from rtlog_client.drive_log import Span, read_events, read_span
from rtlog_client.log_file import LogWriter
from rtlog_client.replay import _timeline
from rtlog_client.stage import total_counts
from rtlog_server.devices.encoders import position_rad
from rtlog_server.messages import LaserScan, TagRead, TagReads, encode, header, to_time
from rtlog_server.topics import PRIMARY_SCAN, TAGS

S = 1_000_000_000
START = 1_700_000_000 * S
NOTHING = np.empty(0)


def scan(stamp_ns: int) -> bytes:
    nothing = np.float32(NOTHING)
    return encode(LaserScan(header(stamp_ns, ""), 0, 1, 0.1, 0, 0.02, 0.1, 20, nothing, nothing))


def test_events_come_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", {}, None) as log:
        for k in range(60):
            tick_ns = START + k * S // 10
            reads = [TagRead(to_time(tick_ns - 50_000_000 - 1_000 * i), f"{k}.{i}", 0, 1, 0.0) for i in range(2)]
            log.write(PRIMARY_SCAN.name, PRIMARY_SCAN.msgtype, scan(tick_ns - 30_000_000), tick_ns, tick_ns)
            log.write(TAGS.name, TAGS.msgtype, encode(TagReads(header(tick_ns, ""), reads)), tick_ns, tick_ns)
    span = read_span(tmp_path / "a.mcap", 1.0, 2.0)
    assert span == Span(START + S, START + 3 * S, START)
    events = list(read_events(tmp_path / "a.mcap", ["laser/primary", "rfid"], span))
    assert [e.stamp_ns for e in events] == sorted(e.stamp_ns for e in events)
    assert [e.content.epc for e in events if e.device == "rfid"] == [f"{k}.{i}" for k in range(10, 31) for i in (1, 0)]
    assert sum(e.device == "laser/primary" for e in events) == 21
    with pytest.raises(BadInputError, match=r"nothing to replay after 6 s; it is 5\.9 s long"):
        read_span(tmp_path / "a.mcap", 6.0, None)


@pytest.mark.parametrize("rate", [1.0, 5.0, 0.5])
def test_recorded_ticks_come_to_lie_on_server_ticks(rate: float) -> None:
    period_ns = S // 10
    for phase_ns in (0, 1, 37_000_000, 99_999_999):
        span = Span(START + phase_ns + 7 * period_ns, START + 100 * S, START + phase_ns)
        for now_ns in (0, 5, START + 3 * S + 12_345):
            report = _timeline(span, now_ns, 0.1 / rate, rate)
            for tick in (0, 7, 8, 900):
                host_ns = report.host_ns(span.first_tick_ns + tick * period_ns)
                assert host_ns % (period_ns / rate) == 0
                assert report.recorded_ns(host_ns) == span.first_tick_ns + tick * period_ns
            assert now_ns <= report.host_ns(span.start_ns) < now_ns + period_ns / rate


@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("role", ["left_wheel", "steering"])
def test_counts_are_the_angle_seen_from_the_other_end(role: str, is_reversed: bool) -> None:
    encoder = Encoder(name="e", role=role, zero_deg=77.0 if role == "steering" else 0.0, reversed=is_reversed)  # type: ignore[arg-type]
    for angle in np.linspace(-3, 3, 41) * (1 if role == "steering" else 20):
        assert position_rad(encoder, total_counts(encoder, angle)) == pytest.approx(angle, abs=math.tau / 4096)

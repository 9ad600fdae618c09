"""What a replay takes from a recording: wheels in between, and scans and reads in the order of their stamps."""

import math
from pathlib import Path

import numpy as np
import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Encoder
from rtlog_client.drive_log import Span, read_events, read_joint_track, read_span
from rtlog_client.log_file import LogWriter
from rtlog_client.replay import _aligned_offset, total_counts
from rtlog_server.devices.encoders import position_rad
from rtlog_server.messages import JointState, LaserScan, TagRead, TagReads, encode, header, to_time
from rtlog_server.topics import JOINT_STATES, PRIMARY_SCAN, TAGS

S = 1_000_000_000
START = 1_700_000_000 * S
NOTHING = np.empty(0)


def joints(stamp_ns: int, **angles: float) -> bytes:
    return encode(JointState(header(stamp_ns, ""), list(angles), np.array(list(angles.values())), NOTHING, NOTHING))


def scan(stamp_ns: int) -> bytes:
    nothing = np.float32(NOTHING)
    return encode(LaserScan(header(stamp_ns, ""), 0, 1, 0.1, 0, 0.02, 0.1, 20, nothing, nothing))


def test_wheels_turn_evenly_between_readings(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", {}, None) as log:
        for at_s, wheel, steering in [(0, 10.0, 3.0), (2, 14.0, -3.1), (1, 11.0, 3.1)]:  # one stamp runs backwards
            data = joints(START + at_s * S, wheel=wheel, steering=steering)
            log.write(JOINT_STATES.name, JOINT_STATES.msgtype, data, START, START)
    track = read_joint_track(tmp_path / "a.mcap", ["steering", "wheel"])
    at_s = [-1, 0, 0.25, 1, 1.5, 2, 9]
    angles = [track.angle("wheel", START + round(t * S)) for t in at_s]
    assert angles == pytest.approx([10, 10, 10.25, 11, 12.5, 14, 14])
    assert track.angle("steering", START + 3 * S // 2) == pytest.approx((3.1 + math.tau - 3.1) / 2)  # through π
    with pytest.raises(BadInputError, match="lacks other; it has wheel, steering"):
        read_joint_track(tmp_path / "a.mcap", ["wheel", "other"])


def test_events_come_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", {}, None) as log:
        for k in range(60):
            tick_ns = START + k * S // 10
            reads = [TagRead(to_time(tick_ns - 50_000_000 - 1_000 * i), f"{k}.{i}", 0, 1, 0.0) for i in range(2)]
            log.write(PRIMARY_SCAN.name, PRIMARY_SCAN.msgtype, scan(tick_ns - 30_000_000), tick_ns, tick_ns)
            log.write(TAGS.name, TAGS.msgtype, encode(TagReads(header(tick_ns, ""), reads)), tick_ns, tick_ns)
    span = read_span(tmp_path / "a.mcap", 1.0, 2.0)
    assert span == Span(START + S, START + 3 * S, START)
    events = list(read_events(tmp_path / "a.mcap", [PRIMARY_SCAN.name, TAGS.name], span))
    assert [e.stamp_ns for e in events] == sorted(e.stamp_ns for e in events)
    assert [e.content.epc for e in events if e.topic == TAGS.name] == [
        f"{k}.{i}" for k in range(10, 31) for i in (1, 0)
    ]
    assert sum(e.topic == PRIMARY_SCAN.name for e in events) == 21
    with pytest.raises(BadInputError, match=r"nothing to replay after 6 s; it is 5\.9 s long"):
        read_span(tmp_path / "a.mcap", 6.0, None)


def test_recorded_ticks_come_to_lie_on_server_ticks() -> None:
    period_ns = S // 10
    for phase_ns in (0, 1, 37_000_000, 99_999_999):
        span = Span(START + phase_ns + 7 * period_ns, START + 100 * S, START + phase_ns)
        for now_ns in (0, 5, START + 3 * S + 12_345):
            offset_ns = _aligned_offset(span, now_ns, period_ns)
            assert (span.first_tick_ns + offset_ns) % period_ns == 0
            assert now_ns <= span.start_ns + offset_ns < now_ns + period_ns


@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("role", ["left_wheel", "steering"])
def test_counts_are_the_angle_seen_from_the_other_end(role: str, is_reversed: bool) -> None:
    encoder = Encoder(name="e", role=role, zero_deg=77.0 if role == "steering" else 0.0, reversed=is_reversed)  # type: ignore[arg-type]
    for angle in np.linspace(-3, 3, 41) * (1 if role == "steering" else 20):
        assert position_rad(encoder, total_counts(encoder, angle)) == pytest.approx(angle, abs=math.tau / 4096)

"""Did the encoders turn as they did? At the stamp of each reading that came out, against the track that went in.

    angle |          . ´ track         a reading may lie anywhere on the track within the tolerance of its stamp,
          |     . ´ █                  give or take the counts of the encoder
          | . ´     █  reading ± tolerance
          +─────────┴──────────

Wheels that count on from their place in the turn are off by whole turns from the start; what this grows by later are
turns that were missed while nobody could ask. In: two recordings, a profile. Out: a `DeviceComparison`.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from hw_profiles.profile import Encoder
from rtlog_client.difference import Causes, DeviceComparison, Difference, hole_causes
from rtlog_client.encoder_track import EncoderTrack
from rtlog_client.log_file import read_messages
from rtlog_client.replay_report import ReplayReport
from rtlog_client.ticks_out import TicksOut
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import JOINT_STATES

STAMP_NS = 10_000_000  # tolerance: encoders on a bus are latched one after the other, and share a stamp
COUNTS = 1.5
SPEED_NS = 100_000_000  # before a reading, over which its speed is taken
ROUND_NS = 20_000_000  # before its tick the encoders are being asked
BROUGHT_NS = 5_000_000  # by which a driver may bring a reading to its stamp, at that speed


def compare_encoders(
    track: EncoderTrack,
    encoders: Sequence[Encoder],
    came_out: Path,
    report: ReplayReport,
    ticks: TicksOut,
    causes: Causes,
) -> DeviceComparison:
    result = DeviceComparison("encoders")
    positions: list[int] = []
    sequences: list[int] = []
    wheels = {encoder.name: _Wheel(encoder, track, report) for encoder in encoders}
    answered: dict[int, tuple[set[str], int]] = {}
    found: list[tuple[str, int, int, str]] = []  # what, position, stamp, detail
    for message in read_messages(came_out, [JOINT_STATES.name]):
        state = decode(message.data, message.msgtype)
        stamp_ns, position = to_ns(state.header.stamp), ticks.position(message.log_time_ns)
        positions.append(position)
        sequences.append(message.sequence)
        answered[position] = set(state.name), stamp_ns
        for name, angle in zip(state.name, state.position, strict=True):
            if name in wheels and (what := wheels[name].judge(stamp_ns, angle)):
                found.append((what, position, stamp_ns, f"{name}: {wheels[name].detail}"))
    causes = causes.also(hole_causes("encoders", positions, sequences, ticks))
    first, last = (ticks.position(report.host_ns(moment)) for moment in (report.start_ns, report.end_ns))
    for position in range(first, last + 1):
        names, stamp_ns = answered.get(position, (set(), ticks.at(position)))
        result.went_in += 1
        if missing := [name for name in wheels if name not in names]:
            found.append(("lost", position, stamp_ns, ", ".join(missing)))
    for what, position, stamp_ns, detail in sorted(found, key=lambda one: one[1]):
        due_ns = ticks.at(position) - ROUND_NS, ticks.at(position)
        cause = causes.of("encoders", stamp_ns - ticks.period_ns, due_ns, ticks.at(position))
        recorded_ns = report.recorded_ns(stamp_ns)
        result.differences.append(Difference("encoders", what, ticks.index(position), recorded_ns, cause, detail))
    result.same = result.went_in - len({d.tick for d in result.differences})
    for name, wheel in wheels.items():
        result.figures |= {f"{name}_{key}": value for key, value in wheel.figures().items()}
    return result


class _Wheel:
    """One encoder, wheel or steering, through the drive."""

    def __init__(self, encoder: Encoder, track: EncoderTrack, report: ReplayReport) -> None:
        self.detail = ""  # of what `judge` found last
        self._encoder = encoder
        self._track = track
        self._report = report
        self._turns_off: int | None = None
        self._worst_rad = 0.0
        self._ends: list[tuple[int, float]] = []  # stamp and angle of the first and the newest reading

    def judge(self, stamp_ns: int, angle_rad: float) -> str:
        """What is wrong with a reading: "", "changed" or "turns"."""
        name = self._encoder.name
        around = [
            self._track.angle(name, self._report.recorded_ns(stamp_ns + offset_ns))
            for offset_ns in range(-STAMP_NS, STAMP_NS + 1, STAMP_NS // 2)
        ]
        before = self._track.angle(name, self._report.recorded_ns(stamp_ns - SPEED_NS))
        slack = COUNTS * math.tau / self._encoder.counts_per_turn
        slack += abs(around[2] - before) * BROUGHT_NS / SPEED_NS
        self._ends[1:] = [(stamp_ns, angle_rad)]
        off = round((angle_rad - around[2]) / math.tau)
        if self._turns_off is None:
            self._turns_off = off
        error = angle_rad - math.tau * off
        self._worst_rad = max(self._worst_rad, abs(error - around[2]))
        if not min(around) - slack <= error <= max(around) + slack:
            self.detail = f"{error - around[2]:+.4f} rad off the track"
            return "changed"
        turned, self._turns_off = off - self._turns_off, off
        if turned and self._encoder.role != "steering":
            self.detail = f"{turned:+d} turns"
            return "turns"
        return ""

    def figures(self) -> dict[str, float]:
        if len(self._ends) < 2:
            return {}
        (first_ns, first), (last_ns, last) = self._ends
        name = self._encoder.name
        went_in = self._track.angle(name, self._report.recorded_ns(last_ns)) - self._track.angle(
            name, self._report.recorded_ns(first_ns)
        )
        return {
            "turned_in_rad": round(went_in, 4),
            "turned_out_rad": round(last - first, 4),
            "worst_error_rad": round(self._worst_rad, 5),
        }

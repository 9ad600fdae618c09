"""Compare the recording that went in at the wire with the one that came out: what is the same, what not, and why.

In: two recordings, and what the replay said of itself (without: their clocks are the same). Out: a `Comparison`. The
law: every sample that went in is the same, superseded by a newer one in its tick, or a `Difference` with its cause.
"""

import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Profile, parse_profile
from rtlog_client.capture import capture_events, read_capture, transmission_delay_ns
from rtlog_client.compare_encoders import compare_encoders
from rtlog_client.compare_scans import compare_scans
from rtlog_client.compare_tags import compare_tags
from rtlog_client.difference import Causes, DeviceComparison, fault_causes, stall_causes
from rtlog_client.drive_log import TOPICS, Span, read_events, read_span
from rtlog_client.encoder_track import read_encoder_track
from rtlog_client.log_file import read_info
from rtlog_client.replay_report import ReplayReport
from rtlog_client.stage import addressed_lasers
from rtlog_client.ticks_out import TicksOut, read_ticks
from rtlog_server.topics import JOINT_STATES, ODOMETRY, TAGS


@dataclass(frozen=True, slots=True)
class Comparison:
    came_out: Path
    ticks: int  # recorded
    missing_ticks: int  # between the first and the last of them
    overruns: int  # ticks that began a whole period late or more
    devices: list[DeviceComparison]

    @property
    def same(self) -> bool:
        """Nothing differs but by what has a cause."""
        return not self.missing_ticks and not any(device.unexplained for device in self.devices)

    def to_json(self) -> str:
        answer: dict[str, Any] = {
            "same": self.same,
            "came_out": str(self.came_out),
            "ticks": self.ticks,
            "missing_ticks": self.missing_ticks,
            "overruns": self.overruns,
            "devices": [asdict(device) for device in self.devices],
        }
        return json.dumps(answer)

    def lines(self) -> list[str]:
        """For people: a line a device, then how often what happened, and why."""
        lines = [f"{self.ticks} ticks, {self.missing_ticks} missing, {self.overruns} a period late or more"]
        lines.append(f"{'device':18}{'went in':>9}{'same':>9}{'superseded':>12}{'differ':>8}{'unexplained':>13}")
        for device in self.devices:
            counts = f"{device.went_in:9}{device.same:9}{device.superseded:12}{len(device.differences):8}"
            lines.append(f"{device.device:18}{counts}{len(device.unexplained):13}")
        for device in self.devices:
            lines += [f"{device.device}: {key} {value:g}" for key, value in device.figures.items()]
            tally = Counter((d.what, d.cause) for d in device.differences)
            first = {(d.what, d.cause): d for d in reversed(device.differences)}
            for (what, cause), count in sorted(tally.items()):
                example = first[what, cause]
                detail = f" ({example.detail})" if example.detail else ""
                reason = cause or "UNEXPLAINED"
                lines.append(f"{device.device}: {count} {what}, from tick {example.tick}{detail}: {reason}")
        return lines


def compare_recordings(went_in: Path, came_out: Path, report: ReplayReport | None = None) -> Comparison:
    """Raises: BadInputError: one of them is no recording, is empty, or has no profile where one is needed."""
    profile, ticks = _profile(came_out), read_ticks(came_out)
    missing = int((~ticks.recorded).sum())
    overruns = int((ticks.lateness_s * 1e9 >= ticks.period_ns).sum())
    figures = came_out, int(ticks.recorded.sum()), missing, overruns
    if report is None:
        whole = read_span(went_in, 0.0, None)
        report = ReplayReport(0, whole.start_ns, whole.end_ns, 0, 0, 0)
    causes = Causes([*fault_causes(report), *stall_causes(report, ticks)], ticks)
    compare = _compare_devices if report.capture_of is None else _compare_capture
    return Comparison(*figures, compare(went_in, came_out, profile, report, ticks, causes))


def _compare_capture(
    went_in: Path, came_out: Path, profile: Profile, report: ReplayReport, ticks: TicksOut, causes: Causes
) -> list[DeviceComparison]:
    device, lasers = report.capture_of, addressed_lasers(profile)
    if device not in lasers:
        raise BadInputError(f"{came_out}: its vehicle has no scanner {device}, whose captured bytes were sent")
    if report.rate != 1.0:
        raise BadInputError(f"{went_in}: sent at another rate than its device's clock tells: there is no time to go by")
    capture = read_capture(went_in)
    events, delay_ns = capture_events(capture, device), transmission_delay_ns(capture)
    turn_s = 1 / lasers[device].scan_frequency_hz
    return [compare_scans(device, events, came_out, report, ticks, causes, turn_s, delay_ns)]


def _compare_devices(
    went_in: Path, came_out: Path, profile: Profile, report: ReplayReport, ticks: TicksOut, causes: Causes
) -> list[DeviceComparison]:
    """Of each device that the profile has and the input tells of."""
    there = read_info(went_in).message_counts
    span = Span(report.start_ns, report.end_ns, read_span(went_in, 0.0, None).first_tick_ns)
    devices = []
    for name, laser in addressed_lasers(profile).items():
        if any(there.get(topic) for topic in TOPICS[name]):
            turn_s = 1 / laser.scan_frequency_hz
            events = read_events(went_in, [name], span)
            devices.append(compare_scans(name, events, came_out, report, ticks, causes, turn_s))
    if profile.encoders and (there.get(JOINT_STATES.name) or there.get(ODOMETRY.name)):
        track = read_encoder_track(went_in, profile)
        devices.append(compare_encoders(track, profile.encoders, came_out, report, ticks, causes))
    if profile.rfid is not None and there.get(TAGS.name):
        devices.append(compare_tags((went_in, span), came_out, report, ticks, causes))
    return devices


def _profile(recording: Path) -> Profile:
    info = read_info(recording)
    if info.profile_toml is None:
        raise BadInputError(f"{recording}: no profile in it; a recording of our server is wanted here")
    return parse_profile(info.profile_toml, f"in {recording}")

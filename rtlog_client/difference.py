"""What two recordings of one drive differ in, and why: the one that went in at the wire, the one that came out.

In: what each device's comparison found. Out: `Difference`s, each with its cause: a fault that was played, a hole of the
link, a gap of the input, a machine that stood still, or none. The law: a difference without a cause is a failure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtlog_client.replay_report import ReplayReport
from rtlog_client.ticks_out import TicksOut

RECOVERY_NS = 2_000_000_000  # within which a device is to be back after its fault
TRANSIT_NS = 5_000_000  # from a sample's completion to the server's hand; later than this is late
STALE_NS = 30_000_000  # before its tick, within which the samples of it are on their way
STILL_NS = 2_000_000  # a tick that began so late tells of a machine that stood still
UNEXPLAINED = ""
BEFORE = "before recording began"
AFTER = "after recording ended"


@dataclass(frozen=True, slots=True)
class Difference:
    device: str
    what: str  # lost, late, changed, extra, stamp, turns, silent
    tick: int  # the server's index of the tick where it belongs
    stamp_ns: int  # in the recording that went in
    cause: str  # "": unexplained
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Cause:
    """Why samples of a device may be missing or wrong; UTC of the host.

    A `brief` one tells only of a sample that was due to arrive within it, not of one that was then being measured.
    """

    text: str
    devices: tuple[str, ...]  # empty: all
    from_ns: int
    to_ns: int
    brief: bool = False


@dataclass(slots=True)
class DeviceComparison:
    """Counts are samples: scans, reads of tags, readings of all encoders."""

    device: str
    went_in: int = 0
    same: int = 0
    superseded: int = 0  # a newer one came in the same tick
    differences: list[Difference] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def unexplained(self) -> list[Difference]:
        return [difference for difference in self.differences if difference.cause == UNEXPLAINED]


class Causes:
    """Finds the cause of a difference: the first in the order given that was at work at its time."""

    def __init__(self, causes: Sequence[Cause], ticks: TicksOut) -> None:
        self._causes = list(causes)
        self._ticks = ticks

    def also(self, causes: Sequence[Cause]) -> "Causes":
        return Causes([*causes, *self._causes], self._ticks)

    def of(self, device: str, from_ns: int, due_ns: tuple[int, int], to_ns: int) -> str:
        """Of a sample that was measured at `from_ns`, due to arrive within `due_ns`, and is of the tick at `to_ns`."""
        if to_ns <= self._ticks.first_ns - self._ticks.period_ns:
            return BEFORE
        if to_ns > self._ticks.last_ns:
            return AFTER
        for cause in self._causes:
            begin_ns, end_ns = due_ns if cause.brief else (from_ns, to_ns)
            if (not cause.devices or device in cause.devices) and cause.from_ns <= end_ns and begin_ns <= cause.to_ns:
                return cause.text
        return UNEXPLAINED


def fault_causes(report: ReplayReport) -> list[Cause]:
    """Each fault, and the time within which its devices are to be back."""
    start_ns = report.host_ns(report.start_ns)
    causes = []
    for fault in report.faults:
        from_s, to_s = ((moment - start_ns) * 1e-9 for moment in (fault.from_ns, fault.to_ns))
        name = fault.device if fault.other is None else f"{fault.device} with {fault.other}"
        text = f"{fault.kind} of {name} at {from_s:.1f}–{to_s:.1f} s"
        causes.append(Cause(text, fault.devices, fault.from_ns, fault.to_ns + RECOVERY_NS))
    return causes


def stall_causes(report: ReplayReport, ticks: TicksOut) -> list[Cause]:
    """When the replaying process or the server's tick loop stood still."""
    replaying = [
        Cause("the replaying machine stood still", (), stall.from_ns - TRANSIT_NS, stall.to_ns + TRANSIT_NS, True)
        for stall in report.stalls
    ]
    late = np.flatnonzero(ticks.lateness_s * 1e9 > STILL_NS)
    return replaying + [
        Cause(
            "the server stood still", (), ticks.at(k) - STALE_NS, ticks.at(k) + round(ticks.lateness_s[k] * 1e9), True
        )
        for k in late.tolist()
    ]


def hole_causes(device: str, positions: Sequence[int], sequences: Sequence[int], ticks: TicksOut) -> list[Cause]:
    """Where the sequence numbers of a topic, at these ticks, say that the link lost some."""
    order = np.argsort(np.array(sequences), kind="stable")
    at, number = np.array(positions)[order], np.array(sequences)[order]
    holes = np.flatnonzero(np.diff(number) > 1)
    return [
        Cause("lost on the link", (device,), ticks.at(int(at[k])) + 1, ticks.at(int(at[k + 1])) - 1)
        for k in holes.tolist()
    ]


def gap_causes(device: str, stamps_ns: NDArray[np.int64], least_ns: int) -> list[Cause]:
    """Gaps of the input (UTC of the host): a scanner that falls silent may be given up, and has to be found anew."""
    return [
        Cause(
            f"after a gap of {(b - a) * 1e-9:.1f} s in the recording that went in",
            (device,),
            b - TRANSIT_NS,
            b + RECOVERY_NS,
        )
        for a, b in zip(stamps_ns[:-1].tolist(), stamps_ns[1:].tolist(), strict=True)
        if b - a > least_ns
    ]

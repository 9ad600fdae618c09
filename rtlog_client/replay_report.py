"""What a replay says of itself when it is over: when the recorded moments happened again, and what went wrong.

In: a replay. Out: JSON, and back. The law: times of the recording and of the replay are bound by one straight line.

    UTC of this host
        |            .´ end        slope 1 / rate
        |  start .´
        +--------+-----+---- UTC of the recording
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import msgspec

from hw_profiles.errors import BadInputError


@dataclass(frozen=True, slots=True)
class PlayedFault:
    """A fault as it was played; UTC of the host."""

    device: str
    kind: str
    from_ns: int
    to_ns: int
    other: str | None = None

    @property
    def devices(self) -> tuple[str, ...]:
        return (self.device,) if self.other is None else (self.device, self.other)


@dataclass(frozen=True, slots=True)
class Stall:
    """The replaying process did not get to run; UTC of the host."""

    from_ns: int
    to_ns: int


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """Added to times of the recording or of its truth, `offset_ns` gives UTC of this host (at rate 1)."""

    offset_ns: int
    start_ns: int  # in the recording
    end_ns: int
    scans: int
    unheard_scans: int  # of these, sent while no server listened
    tag_reads: int
    rate: float = 1.0  # how much faster than it was recorded; 0: captured bytes as fast as they went
    faults: list[PlayedFault] = field(default_factory=list)
    stalls: list[Stall] = field(default_factory=list)
    capture_of: str | None = None  # the device whose captured bytes were sent; times are since its first scan

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    def host_ns(self, recorded_ns: int) -> int:
        """UTC of the host at which a moment of the recording happened again."""
        return self.offset_ns + self.start_ns + round((recorded_ns - self.start_ns) / self.rate)

    def recorded_ns(self, host_ns: int) -> int:
        return self.start_ns + round((host_ns - self.offset_ns - self.start_ns) * self.rate)


def load_report(path: Path) -> ReplayReport:
    """Raises: BadInputError: no such file, or nothing that a replay has printed."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=ReplayReport)
    except OSError as error:
        raise BadInputError(f"{path}: {error.strerror or error}") from error
    except msgspec.MsgspecError as error:
        raise BadInputError(f"{path}: not what rtlog-client replay --to devices prints: {error}") from error

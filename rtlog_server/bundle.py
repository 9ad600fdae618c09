"""What the sampling process tells the publishing one: once who it is, then a bundle a tick. A leaf."""

from dataclasses import dataclass
from uuid import UUID


@dataclass(frozen=True, slots=True)
class ServerInfo:
    """This run of the server."""

    boot_id: UUID
    vehicle: str  # the profile's name, as in the zenoh keys
    software: str
    profile_toml: str
    listen: tuple[str, ...]  # zenoh endpoints
    started_ns: int  # monotonic


@dataclass(frozen=True, slots=True)
class Sample:
    """A message on its way out. It got its number before the queue, so that what is dropped there leaves a hole."""

    topic: str
    sequence: int  # per topic, from 0
    data: bytes  # CDR


@dataclass(frozen=True, slots=True)
class DeviceReport:
    """A device at a tick."""

    name: str
    state: int  # OK, STALE or MISSING
    age_s: float  # of the newest sample; +inf if there was none
    message: str
    connects: int
    identity: dict[str, str]
    diagnostics: dict[str, str]


@dataclass(frozen=True, slots=True)
class LatenessSummary:
    """Quantiles are upper edges of their bins (at most 26 % too large), the maximum is exact."""

    count: int
    overruns: int  # ticks that began a whole period late or more
    p50_s: float
    p99_s: float
    max_s: float
    histogram: list[tuple[float, int]]  # upper edge in seconds and count, of the bins that hold any


@dataclass(frozen=True, slots=True)
class Report:
    """How the sampling process is, once a second and when a device's state changes."""

    stamp_ns: int  # UTC
    devices: list[DeviceReport]
    lateness: LatenessSummary
    dropped_ticks: int  # that found the queue to the publishing process full
    realtime: dict[str, str]


@dataclass(frozen=True, slots=True)
class Bundle:
    """All that a tick gave."""

    tick: int
    samples: list[Sample]  # the Tick message first
    report: Report | None  # None: not due at this tick

"""Hazards: what goes wrong in mines, as frozen, strict records of the world's TOML.

    [[hazards]]
    kind = "slip"         each kind is a record below; its docstring is its line in `rtlog-atlas simulate --help`
    run = "morning"       whom it strikes; default: every run
    at_s = 40.0           seconds after the run's first tick; default: by lot
    for_s = 1.0

What has no default is drawn by lot, from the seed. The vehicle's true motion is the same with and without hazards.
"""

import json
import textwrap
import typing
from collections.abc import Iterator
from typing import Annotated, Literal

from msgspec import Meta

from hw_profiles.strict_toml import Record

Seconds = Annotated[float, Meta(ge=0.0, le=36_000.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Factor = Annotated[float, Meta(ge=0.1, le=10.0)]
Length = Annotated[float, Meta(gt=0.0, le=100.0)]
Offset = Annotated[float, Meta(ge=-10.0, le=10.0)]  # metres
Turn = Annotated[float, Meta(ge=-180.0, le=180.0)]  # degrees
Delay = Annotated[float, Meta(ge=0.0, le=1.0)]  # seconds
Often = Annotated[int, Meta(ge=1, le=1000)]
Speed = Annotated[float, Meta(gt=0.0, le=20.0)]
Wheel = Literal["left_wheel", "right_wheel", "drive_wheel"]
Epc = Annotated[str, Meta(pattern="^[0-9A-F]{24}$")]


class Hazard(Record, frozen=True, tag_field="kind"):
    run: str | None = None

    @property
    def kind(self) -> str:
        return str(self.__struct_config__.tag)


class Timed(Hazard, frozen=True):
    at_s: Seconds | None = None


class Moment(Timed, frozen=True):
    """Strikes at a time, or so many times by lot."""

    times: Often = 1


class Event(Moment, frozen=True):
    """Strikes for a while."""

    for_s: Seconds = 1.0


class Spell(Timed, frozen=True):
    """Lasts for the whole run, or from a time on, or for a while."""

    for_s: Seconds | None = None


class Slip(Event, frozen=True, tag="slip"):
    """one wheel counts `factor` times what it should; by lot 0.4 to 1.6"""

    times: Often = 3
    wheel: Wheel | None = None
    factor: Factor | None = None


class Spin(Event, frozen=True, tag="spin"):
    """wheels turn faster than the vehicle moves, or while it stands"""

    wheel: Wheel | None = None
    extra_m_s: Speed = 1.0


class Slide(Event, frozen=True, tag="slide"):
    """wheels are locked while the vehicle moves"""

    wheel: Wheel | None = None


class Stuck(Event, frozen=True, tag="stuck"):
    """encoders repeat their angle, and count on from there"""

    for_s: Seconds = 10.0
    wheel: Wheel | None = None


class Jump(Moment, frozen=True, tag="jump"):
    """the count of one wheel jumps by `turns`; by lot up to one, either way"""

    wheel: Wheel | None = None
    turns: Annotated[float, Meta(ge=-1000.0, le=1000.0)] | None = None


class Reset(Moment, frozen=True, tag="reset"):
    """counts start anew from zero"""

    wheel: Wheel | None = None


class LostCounts(Spell, frozen=True, tag="lost_counts"):
    """a share of one wheel's counts is lost"""

    wheel: Wheel | None = None
    share: Share = 0.1


class OdometryLate(Hazard, frozen=True, tag="odometry_late"):
    """what the encoders say is older than its stamp"""

    delay_s: Delay = 0.06


class ScansLate(Hazard, frozen=True, tag="scans_late"):
    """what the scanner sees is older than its stamp"""

    delay_s: Delay = 0.06


class Jitter(Hazard, frozen=True, tag="jitter"):
    """stamps are off by chance, in order still"""

    std_s: Delay = 0.02
    of: Literal["scans", "odometry", "both"] = "both"


class OdometryMissing(Event, frozen=True, tag="odometry_missing"):
    """no message of the encoders"""

    for_s: Seconds = 3.0


class ScansMissing(Event, frozen=True, tag="scans_missing"):
    """no message of the scanner"""

    for_s: Seconds = 3.0


class Dropouts(Spell, frozen=True, tag="dropouts"):
    """a share of the beams has no return"""

    share: Share = 0.5


class Dust(Spell, frozen=True, tag="dust"):
    """a share of the beams returns from nearby, from `reach_m` at most"""

    share: Share = 0.15
    reach_m: Length = 3.0


class OwnParts(Hazard, frozen=True, tag="own_parts"):
    """a plate of the vehicle stands in this sector of the scanner's view, in every scan"""

    from_deg: Turn | None = None
    to_deg: Turn | None = None
    distance_m: Length | None = None


class Traffic(Timed, frozen=True, tag="traffic"):
    """another vehicle moves along where the scanner looks, or is "oncoming", or "parked" in this run"""

    way: Literal["along", "oncoming", "parked"] = "along"
    for_s: Seconds = 30.0
    gap_m: Length = 6.0
    aside_m: Offset = 1.6
    speed_m_s: Speed = 2.0
    length_m: Length = 4.0
    width_m: Length = 1.4


class ChangedWalls(Hazard, frozen=True, tag="changed_walls"):
    """a stretch of the wall nearest to the point `at` stands further out, from this run on"""

    at: tuple[float, float] | None = None
    length_m: Length = 8.0
    by_m: Length = 0.3


class FarReads(Hazard, frozen=True, tag="far_reads"):
    """a tag is read a few times from far down the drift"""

    epc: Epc | None = None
    within_m: Length = 25.0
    reads: Often = 5


class ThroughRock(Hazard, frozen=True, tag="through_rock"):
    """a tag is read a few times with rock between, from a drift beside"""

    epc: Epc | None = None
    within_m: Length = 15.0
    reads: Often = 3


class DeadTag(Hazard, frozen=True, tag="dead_tag"):
    """a tag dies in this run, at a time, and is never read again"""

    epc: Epc | None = None
    at_s: Seconds | None = None


class WrongMount(Hazard, frozen=True, tag="wrong_mount"):
    """the profile has the scanner so far from where it is; by lot if none is given"""

    dx_m: Offset | None = None
    dy_m: Offset | None = None
    dyaw_deg: Turn | None = None


class WrongRadii(Hazard, frozen=True, tag="wrong_radii"):
    """the profile's wheels are `factor` times the true ones; by lot 0.97 to 1.03, each its own"""

    wheel: Wheel | None = None
    factor: Factor | None = None


class WrongTrack(Hazard, frozen=True, tag="wrong_track"):
    """the profile's track, or wheelbase, is `factor` times the true one; by lot 0.95 to 1.05"""

    factor: Factor | None = None


WheelHazard = Slip | Spin | Slide | Stuck | Jump | Reset | LostCounts
AnyHazard = (
    WheelHazard
    | OdometryLate
    | ScansLate
    | Jitter
    | OdometryMissing
    | ScansMissing
    | Dropouts
    | Dust
    | OwnParts
    | Traffic
    | ChangedWalls
    | FarReads
    | ThroughRock
    | DeadTag
    | WrongMount
    | WrongRadii
    | WrongTrack
)
KINDS: dict[str, type[Hazard]] = {str(kind.__struct_config__.tag): kind for kind in typing.get_args(AnyHazard)}


def hazard_table() -> Iterator[str]:
    """Lines for people: each kind, its keys with their defaults, and what happens."""
    for name, kind in KINDS.items():
        keys = dict(zip(kind.__struct_fields__, kind.__struct_defaults__, strict=True))
        told = [key if value is None else f"{key} = {json.dumps(value)}" for key, value in keys.items() if key != "run"]
        yield f"  {name:17} {kind.__doc__}"
        yield from textwrap.wrap(", ".join(told), 118, initial_indent=" " * 22, subsequent_indent=" " * 22)

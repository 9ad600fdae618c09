"""The world: drifts, tags and drives, as frozen, strict records.

In: a small TOML. Out: a `World`. Lengths in metres, coordinates as [x, y] in the world frame or as the name of a place.

    [places]                       names for points
    [[drifts]]                     polylines with a width; where they meet is a junction, where one ends a dead end
    [[rooms]] / [[pillars]]        more free space / less of it
    [walls]                        roughness of the rock; 0 is a smooth tunnel
    [[tags]]                       RFID tags, each read within a range
    [[runs]]                       drives from waypoint to waypoint; between two places of one drift the way follows it
    [scanner]                      beams, field of view and range of the laser, where it is no LMS111
    [noise]                        what the sensors get wrong; `profile` names what they are and how they are mounted
    [[hazards]]                    what goes wrong now and then, or is not as the profile says: hazards.py
"""

import math
from collections.abc import Iterator
from itertools import pairwise, product
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, field
from msgspec.structs import replace

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Profile, load_profile
from hw_profiles.strict_toml import Record, parse_toml
from processing.simulation.hazards import AnyHazard

SHIPPED = Path(__file__).parent.parent / "worlds"
Place = str | tuple[float, float]
Name = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]+$")]  # becomes part of a file name
Percent = Annotated[float, Meta(ge=-50.0, le=50.0)]
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
Pause = Annotated[float, Meta(ge=0.0, le=3600.0)]
Spread = Annotated[float, Meta(ge=0.0, le=1.0)]  # a standard deviation, metres
Angle = Annotated[float, Meta(ge=-45.0, le=45.0)]  # degrees
Acceleration = Annotated[float, Meta(ge=0.1, le=10.0)]


class Walls(Record, frozen=True):
    """Rough rock: how far it stands from the smooth wall, a random function with Matérn 3/2 covariance."""

    roughness_m: Spread = 0.0  # standard deviation
    correlation_m: Annotated[float, Meta(ge=0.2, le=100.0)] = 1.5  # its length scale along the wall


class Drift(Record, frozen=True):
    points: Annotated[list[Place], Meta(min_length=2)]
    width_m: Annotated[float, Meta(ge=1.0, le=100.0)]
    roughness_m: Spread | None = None  # where it differs from [walls]


class Room(Record, frozen=True):
    corners: Annotated[list[Place], Meta(min_length=3)]


class Pillar(Record, frozen=True):
    at: Place
    radius_m: Annotated[float, Meta(ge=0.05, le=50.0)]


class Tag(Record, frozen=True):
    """A tag at a place. One EPC at several is a clone, or with `unread_by` and the times a tag that is moved."""

    epc: Annotated[str, Meta(pattern="^[0-9A-F]{24}$")]
    at: Place
    read_range_m: Annotated[float, Meta(ge=0.1, le=50.0)] = 3.0
    read_probability: Probability = 0.6  # of one inventory round within the range; outside it is zero
    unread_by: list[str] = field(default_factory=list)  # runs that never read it
    from_s: float = -math.inf  # of each run: when the tag is put there
    until_s: float = math.inf  # and taken away


class Driving(Record, frozen=True):
    """How the driver drives."""

    turn_radius_m: Annotated[float, Meta(ge=1.0, le=100.0)] = 4.0
    acceleration_m_s2: Acceleration = 0.8
    lateral_acceleration_m_s2: Acceleration = 1.0  # slows the vehicle in curves
    wander_m: Spread = 0.15  # standard deviation about the middle of the drift
    gear_change_s: Pause = 1.5
    wait_s: Pause = 2.0  # standing still before and after each run


class Run(Record, frozen=True):
    """A drive. Where the waypoints turn back on themselves, the vehicle stops and changes gear (ahead, reverse)."""

    name: Name
    waypoints: Annotated[list[Place], Meta(min_length=2)]
    speed_m_s: Annotated[float, Meta(ge=0.1, le=20.0)]
    stops_s: dict[str, Pause] = field(default_factory=dict)  # standing still at each passage of a place
    profile: str | None = None  # of another vehicle than the world's


class Scanner(Record, frozen=True):
    """The laser; an LMS111 at 50 Hz, unless another is named."""

    beams: Annotated[int, Meta(ge=3, le=10_000)] = 541
    field_of_view_deg: Annotated[float, Meta(gt=0.0, le=360.0)] = 270.0
    range_m: Annotated[float, Meta(ge=1.0, le=200.0)] = 20.0

    @property
    def increment_deg(self) -> float:
        return self.field_of_view_deg / (self.beams - 1)


class Noise(Record, frozen=True):
    """What the sensors get wrong. Systematic errors: true = nominal × (1 + error)."""

    range_m: Spread = 0.012  # standard deviation, LMS111 data sheet
    wheel_radius_error_percent: dict[str, Percent] = field(default_factory=dict)  # by the encoder's role
    track_width_error_percent: Percent = 0.0
    slip_m_per_sqrt_m: Spread = 0.0  # of each wheel, standard deviation over a metre of way, growing with its root
    steering_deg: Annotated[float, Meta(ge=0.0, le=45.0)] = 0.0  # standard deviation
    steering_zero_error_deg: Angle = 0.0
    missed_pass_probability: Probability = 0.0  # of driving by a tag without a single read
    dropped_scan_probability: Probability = 0.0
    dropped_tick_probability: Probability = 0.0  # nothing of the tick is in the recording


class World(Record, frozen=True):
    schema: Literal[1]
    name: Name
    profile: str
    drifts: Annotated[list[Drift], Meta(min_length=1)]
    runs: Annotated[list[Run], Meta(min_length=1)]
    seed: Annotated[int, Meta(ge=0)] = 0
    places: dict[str, tuple[float, float]] = field(default_factory=dict)
    rooms: list[Room] = field(default_factory=list)
    pillars: list[Pillar] = field(default_factory=list)
    tags: list[Tag] = field(default_factory=list)
    walls: Walls = Walls()
    scanner: Scanner = Scanner()
    driving: Driving = Driving()
    noise: Noise = Noise()
    hazards: list[AnyHazard] = field(default_factory=list)

    def point(self, place: Place) -> tuple[float, float]:
        return self.places[place] if isinstance(place, str) else place

    def profile_of(self, run: Run) -> str:
        """The name or file of the profile of the vehicle that drives a run."""
        return run.profile or self.profile


def shipped_worlds() -> list[str]:
    """The names of the worlds that come with the package."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def read_world_text(name_or_path: str | Path) -> str:
    """The TOML of a shipped world by its name, or of a file. Raises: BadInputError: there is none, or it is no text."""
    path = SHIPPED / f"{name_or_path}.toml" if str(name_or_path) in shipped_worlds() else Path(name_or_path)
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        hint = f"shipped worlds are {', '.join(shipped_worlds())}"
        raise BadInputError(f"world {name_or_path}: {error.strerror or error}; {hint}") from error
    except UnicodeDecodeError as error:
        raise BadInputError(f"world {name_or_path}: not UTF-8 text (byte {error.start})") from error


def parse_world(text: str, source: str) -> World:
    """Check a world's TOML; `source` names it in errors. Raises: BadInputError."""
    world = parse_toml(text, World, f"world {source}")
    for problem in _problems(world):
        raise BadInputError(f"world {source}: {problem}")
    return world


def without_noise(world: World) -> World:
    """The same world, walls and drives with perfect sensors and no hazards: what they count and round to stays."""
    tags = [replace(tag, read_probability=1.0) for tag in world.tags]
    return replace(world, tags=tags, noise=Noise(range_m=0.0), hazards=[])


def route(world: World, run: Run) -> list[tuple[Place, tuple[float, float]]]:
    """The waypoints of a run, with the points between two places of one drift filled in from the drift.

    Where several drifts hold both places, the one with the fewest points between them is meant.

    Raises:
        BadInputError: two drifts have equally few.
    """
    way: list[Place] = [run.waypoints[0]]
    for start, end in pairwise(run.waypoints):
        stretches = [stretch for drift in world.drifts if (stretch := _stretch(drift.points, start, end)) is not None]
        stretches.sort(key=len)
        if len(stretches) > 1 and len(stretches[0]) == len(stretches[1]):
            what = f"world {world.name}: run {run.name}: more than one drift joins {start} and {end}"
            raise BadInputError(f"{what}; name a place between them on the one that is meant")
        way += [*(stretches[0] if stretches else []), end]
    return [(place, world.point(place)) for place in way]


def _stretch(points: list[Place], start: Place, end: Place) -> list[Place] | None:
    """The points of a drift between two of its places, in driving order; of a ring, those with fewer points."""
    starts = [index for index, place in enumerate(points) if place == start and isinstance(place, str)]
    ends = [index for index, place in enumerate(points) if place == end and isinstance(place, str)]
    if not starts or not ends:
        return None
    first, last = min(product(starts, ends), key=lambda pair: abs(pair[0] - pair[1]))
    return points[first + 1 : last] if first < last else points[last + 1 : first][::-1]


def _problems(world: World) -> Iterator[str]:
    """What the types cannot say."""
    names = [run.name for run in world.runs]
    if len(set(names)) != len(names):
        yield f"two runs share a name: {', '.join(names)}"
    for where, place in _named_places(world):
        if place not in world.places:
            yield f"{where}: there is no {place!r} in [places]"
    for tag in world.tags:
        if unknown := set(tag.unread_by) - {run.name for run in world.runs}:
            yield f"tag {tag.epc}: unread_by names no run: {', '.join(sorted(unknown))}"
    wheels = {name: _wheels(load_profile(name)) for name in {world.profile_of(run): None for run in world.runs}}
    for name in (name for name, found in wheels.items() if not found):
        yield f"profile {name} has no vehicle with encoders"
    if unknown := set(world.noise.wheel_radius_error_percent) - set().union(*wheels.values()):
        profiles = ", ".join(f"profile {name}" for name in wheels)
        yield f"noise.wheel_radius_error_percent: {profiles} has no wheel {', '.join(sorted(unknown))}"
    for index, hazard in enumerate(world.hazards):
        where = f"hazards[{index}] ({hazard.kind})"
        if hazard.run is not None and hazard.run not in names:
            yield f"{where}: there is no run {hazard.run}"
        if (epc := getattr(hazard, "epc", None)) not in {None, *(tag.epc for tag in world.tags)}:
            yield f"{where}: there is no tag {epc}"
        wheel = getattr(hazard, "wheel", None)
        for run in (run for run in world.runs if hazard.run in (None, run.name)):
            if wheel is not None and wheel not in wheels[world.profile_of(run)]:
                yield f"{where}: profile {world.profile_of(run)} of run {run.name} has no {wheel}"


def _wheels(profile: Profile) -> set[str]:
    return {encoder.role for encoder in profile.encoders if encoder.role != "steering"}


def _named_places(world: World) -> Iterator[tuple[str, str]]:
    """Every place that is given by name, and where."""
    lists: list[tuple[str, list[Place]]] = []
    lists += [(f"drifts[{index}].points", drift.points) for index, drift in enumerate(world.drifts)]
    lists += [(f"rooms[{index}].corners", room.corners) for index, room in enumerate(world.rooms)]
    lists += [(f"pillars[{index}].at", [pillar.at]) for index, pillar in enumerate(world.pillars)]
    lists += [(f"tag {tag.epc}", [tag.at]) for tag in world.tags]
    lists += [(f"run {run.name}", [*run.waypoints, *run.stops_s]) for run in world.runs]
    for where, places in lists:
        yield from ((where, place) for place in places if isinstance(place, str))

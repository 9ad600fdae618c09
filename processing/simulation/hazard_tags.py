"""Hazards of the tags: reads from far down the drift, reads through rock, tags that die.

In: the readings of a run, and where it was. Out: the readings with the stray ones, without those of the dead.
"""

import numpy as np
from numpy.typing import NDArray

from processing.simulation.hazards import DeadTag, FarReads, ThroughRock
from processing.simulation.lots import Strike, generator
from processing.simulation.raycast import SegmentGrid, cast
from processing.simulation.sensors import TagReading
from processing.simulation.world import Run, Tag, World

Array = NDArray[np.float64]
FAR = 2.0  # times the range in which the tag is usually read
IN_WALL_M = 0.5  # a tag may hang so deep between rough rock and still be in view
TOGETHER_S = 2.0  # the stray reads of one tag come within


def without_dead(readings: list[TagReading], world: World, run: Run, duration_s: float, seed: int) -> list[TagReading]:
    """The readings of a run without those of tags that died before. One tag dies in one run."""
    names = [each.name for each in world.runs]
    for index, hazard in enumerate(world.hazards):
        if not isinstance(hazard, DeadTag) or not world.tags:
            continue
        rng = generator(seed, f"hazard {index}")
        epc = hazard.epc or str(rng.choice(sorted({tag.epc for tag in world.tags})))
        first = int(rng.integers(len(names))) if hazard.run is None else names.index(hazard.run)
        at_s = rng.random() * duration_s if hazard.at_s is None else hazard.at_s
        since_s = {-1: np.inf, 0: at_s, 1: -np.inf}[int(np.sign(names.index(run.name) - first))]
        readings = [reading for reading in readings if reading.epc != epc or reading.time_s < since_s]
    return readings


def with_strays(
    readings: list[TagReading],
    strike: Strike,
    grid: SegmentGrid,
    tags: list[Tag],
    places: Array,
    round_s: Array,
    position: Array,
) -> list[TagReading]:
    """The readings and a few more of one tag.

    Args:
        readings: In order of ticks.
        strike: FarReads or ThroughRock.
        grid: The walls.
        tags: Which the run could read, at `places` (m, 2).
        places: Where they are.
        round_s: The last inventory round before each tick (n,).
        position: Where the vehicle is then, (n, 2).
    """
    hazard, rng = strike.hazard, strike.generator
    assert isinstance(hazard, FarReads | ThroughRock)
    ticks_of: dict[str, NDArray[np.int64]] = {}
    for tag, place in zip(tags, places, strict=True):
        if hazard.epc in (None, tag.epc) and len(ticks := _stray_ticks(hazard, grid, tag, place, position)):
            ticks_of[tag.epc] = ticks
    if not ticks_of:
        strike.refuse(f"run {hazard.run} passes no place for it")
        return readings
    epc = sorted(ticks_of)[rng.integers(len(ticks_of))]
    ticks = ticks_of[epc]
    near = ticks[np.abs(round_s[ticks] - round_s[rng.choice(ticks)]) <= TOGETHER_S / 2]
    chosen = np.sort(rng.choice(near, min(hazard.reads, len(near)), replace=False)).tolist()
    strays = [TagReading(tick, epc, float(round_s[tick]), 1) for tick in chosen]
    return sorted([*readings, *strays], key=lambda reading: reading.tick)


def _stray_ticks(
    hazard: FarReads | ThroughRock, grid: SegmentGrid, tag: Tag, place: Array, position: Array
) -> NDArray[np.int64]:
    """At which ticks the tag could be read by such a chance."""
    way = place - position
    distance = np.linalg.norm(way, axis=1)
    least = tag.read_range_m * (FAR if isinstance(hazard, FarReads) else 1.0)
    ticks = np.flatnonzero((distance > least) & (distance <= hazard.within_m))
    free = cast(grid, position[ticks], np.arctan2(way[ticks, 1], way[ticks, 0]), hazard.within_m)
    in_view = free > distance[ticks] - IN_WALL_M
    return ticks[in_view == isinstance(hazard, FarReads)]

"""Changed walls: a stretch that was slashed or caved between two runs stands further out from then on.

In: the free space, the world. Out: the free space as a run finds it.
"""

import numpy as np
import shapely

from processing.simulation.hazards import ChangedWalls
from processing.simulation.lots import generator
from processing.simulation.world import Run, World, route


def space_of(run: Run, world: World, space: shapely.Geometry, seed: int) -> shapely.Geometry:
    """The free space in a run, with every stretch that was changed before it; `space` itself, where none was."""
    names = [each.name for each in world.runs]
    for index, hazard in enumerate(world.hazards):
        if not isinstance(hazard, ChangedWalls):
            continue
        rng = generator(seed, f"hazard {index}")
        first = int(rng.integers(min(1, len(names) - 1), len(names)))  # by lot, never the first of several
        first = first if hazard.run is None else names.index(hazard.run)
        at = hazard.at or _on_the_way(world, world.runs[first], rng)
        if names.index(run.name) >= first:
            space = _moved_out(space, shapely.Point(at), hazard)
    return space


def _on_the_way(world: World, run: Run, rng: np.random.Generator) -> tuple[float, float]:
    way = shapely.LineString([point for _, point in route(world, run)])
    aside = (
        way.interpolate(rng.uniform(0.1, 0.9), normalized=True).buffer(0.5).exterior
    )  # so that either wall is nearest
    point = aside.interpolate(rng.random(), normalized=True)
    return point.x, point.y


def _moved_out(space: shapely.Geometry, at: shapely.Point, hazard: ChangedWalls) -> shapely.Geometry:
    boundary = shapely.boundary(space)
    middle = shapely.get_point(shapely.shortest_line(boundary, at), 0)
    pieces = shapely.line_merge(shapely.intersection(boundary, middle.buffer(hazard.length_m / 2)))
    stretch = min(shapely.get_parts(pieces), key=middle.distance)  # and not the wall across the drift
    return shapely.union(space, shapely.buffer(stretch, hazard.by_m, cap_style="flat"))

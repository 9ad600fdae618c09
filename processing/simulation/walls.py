r"""Walls: the boundary between the free space of a world and the rock.

In: a World and a random generator. Out: the free space as shapely polygons and its boundary as segments. Rough walls
are one geometry for all runs: every ring of the boundary is cut into short pieces and shifted along its normals.

       ___/\_/\__      the drift, buffered by half its width, joined with the others,
    ─────────────      corners rounded a little, then displaced by a smooth random function of the arc length
"""

import numpy as np
import shapely
from numpy.typing import NDArray

from processing.simulation.world import World

Array = NDArray[np.float64]
CORNER_RADIUS_M = 0.4  # of rough rock, so that normals turn gradually
LONGEST_SEGMENT_M = 2.0  # keeps the cells of the ray caster's grid few for each
SIZE_M = 1e-6  # points this near are one point
SPLINTER_M2 = 1.0


def free_space(world: World, generator: np.random.Generator) -> shapely.Geometry:
    """Where the vehicle can be: the union of drifts and rooms without the pillars, with its rough walls."""
    lines = [shapely.LineString([world.point(place) for place in drift.points]) for drift in world.drifts]
    parts = [line.buffer(d.width_m / 2, cap_style="flat") for line, d in zip(lines, world.drifts, strict=True)]
    for index, (line, drift) in enumerate(zip(lines, world.drifts, strict=True)):
        others = shapely.union_all(lines[:index] + lines[index + 1 :])
        for end in (shapely.Point(line.coords[0]), shapely.Point(line.coords[-1])):
            if end.distance(others) < SIZE_M:  # a flat end at a junction would leave a notch
                parts.append(end.buffer(drift.width_m / 2))
    parts += [shapely.Polygon([world.point(place) for place in room.corners]) for room in world.rooms]
    pillars = [shapely.Point(world.point(pillar.at)).buffer(pillar.radius_m) for pillar in world.pillars]
    space = shapely.difference(shapely.union_all(parts), shapely.union_all(pillars))
    roughness = [world.walls.roughness_m if d.roughness_m is None else d.roughness_m for d in world.drifts]
    if not any(roughness):
        return space
    radius = CORNER_RADIUS_M
    space = space.buffer(radius).buffer(-2 * radius).buffer(radius)
    tree = shapely.STRtree(lines)

    def rough(ring: shapely.LinearRing) -> Array:
        points, normals, step = resample_ring(ring, min(world.walls.correlation_m / 10, 0.15))
        height = periodic_noise(len(points), step, world.walls.correlation_m, generator)
        return points + normals * (height * np.array(roughness)[tree.nearest(shapely.points(points))])[:, None]

    rough_parts = [
        shapely.make_valid(shapely.Polygon(rough(part.exterior), [rough(hole) for hole in part.interiors]))
        for part in shapely.get_parts(space)
    ]
    # where a wall crossed itself, make_valid leaves splinters
    return shapely.union_all([part for part in shapely.get_parts(rough_parts) if part.area > SPLINTER_M2])


def resample_ring(ring: shapely.LinearRing, step_m: float) -> tuple[Array, Array, float]:
    """Points (n, 2) at even distances along a ring, unit normals (n, 2), the distance."""
    count = max(8, round(ring.length / step_m))
    points = shapely.get_coordinates(ring.interpolate(np.arange(count) / count, normalized=True))
    chord = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    tangents = chord / np.linalg.norm(chord, axis=1, keepdims=True)
    return points, np.column_stack([tangents[:, 1], -tangents[:, 0]]), ring.length / count


def periodic_noise(count: int, step_m: float, correlation_m: float, generator: np.random.Generator) -> Array:
    """A periodic random function (count,) of unit variance and Matérn 3/2 covariance of that length scale."""
    wave_number = 2 * np.pi * np.fft.fftfreq(count, step_m)
    amplitude = 1 / (3 + (wave_number * correlation_m) ** 2)  # root of the spectral density, unscaled
    spectrum = np.fft.fft(generator.standard_normal(count)) * amplitude
    return np.asarray(np.fft.ifft(spectrum).real / np.sqrt(np.mean(amplitude**2)))


def wall_segments(space: shapely.Geometry) -> Array:
    """The boundary of the free space as segments (n, 4): x1, y1, x2, y2, none longer than 2 m."""
    return _segments(shapely.boundary(shapely.segmentize(space, LONGEST_SEGMENT_M)))


def new_walls(later: shapely.Geometry, space: shapely.Geometry) -> Array:
    """The walls of a later free space that were none of this one, as segments (n, 4)."""
    found = shapely.difference(shapely.boundary(later), shapely.boundary(space))
    return _segments(shapely.segmentize(found, LONGEST_SEGMENT_M))


def _segments(lines: shapely.Geometry) -> Array:
    corners = [shapely.get_coordinates(part) for part in shapely.get_parts(lines) if not part.is_empty]
    return np.concatenate([np.zeros((0, 4)), *(np.hstack([ring[:-1], ring[1:]]) for ring in corners)])

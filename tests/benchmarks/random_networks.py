"""Random drift networks and random drives through them, each by a random generator: topologies as mines may have them.

In: a generator. Out: a `Network`: places, drifts between them, halls; and waypoints of a drive. A third of the streets
of a grid are missing, trees have spurs, drifts lie side by side with a few metres of rock between them, forks slant,
drifts wind, halls have pillars.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SHARPEST_TURN_DEG = 110.0


@dataclass
class Network:
    """Places, and drifts between two of them as polylines, both ends included."""

    places: list[Array] = field(default_factory=list)
    drifts: list[tuple[int, int, Array]] = field(default_factory=list)
    rooms: list[Array] = field(default_factory=list)
    pillars: list[Array] = field(default_factory=list)

    def place(self, x: float, y: float) -> int:
        self.places.append(np.array([x, y]))
        return len(self.places) - 1

    def join(self, a: int, b: int, bow_m: float = 0.0) -> None:
        """A drift, bent to the side by so much in its middle."""
        start, end = self.places[a], self.places[b]
        length = float(np.hypot(*(end - start)))
        along = np.linspace(0.0, 1.0, max(2, int(length / 8) + 1) if bow_m else 2)[:, None]
        left = np.array([start[1] - end[1], end[0] - start[0]]) / length
        self.drifts.append((a, b, start + along * (end - start) + 4 * bow_m * along * (1 - along) * left))

    def ways(self, place: int) -> list[tuple[int, int, Array]]:
        """The drifts from a place: number, the place at the far end, points from here."""
        out = [(k, b, line) for k, (a, b, line) in enumerate(self.drifts) if a == place]
        return out + [(k, a, line[::-1]) for k, (a, b, line) in enumerate(self.drifts) if b == place]


def grid(net: Network, rng: np.random.Generator) -> None:
    """Streets, a third of them missing."""
    spacing, (rows, columns) = rng.uniform(30, 60), rng.integers(2, 4, 2)
    at = {
        (r, c): net.place(*(spacing * np.array([c, r]) + rng.normal(0, 4, 2)))
        for r, c in itertools.product(range(rows), range(columns))
    }
    for (r, c), a in at.items():
        for b in (at.get((r, c + 1)), at.get((r + 1, c))):
            if b is not None and (rng.random() < 0.67 or not net.ways(b)):
                net.join(a, b, rng.normal(0, 2))


def tree(net: Network, rng: np.random.Generator) -> None:
    """A trunk with spurs to both sides, square or slanting."""
    trunk = [net.place(0.0, 0.0)]
    for _ in range(rng.integers(2, 5)):
        x, y = net.places[trunk[-1]]
        trunk.append(net.place(x + rng.uniform(25, 60), y + rng.normal(0, 8)))
        net.join(trunk[-2], trunk[-1], rng.normal(0, 2))
    for joint in trunk[1:]:
        (x, y), angle, length = net.places[joint], rng.uniform(1.0, 2.0), rng.uniform(20, 50)
        side = rng.choice([-1, 1])
        net.join(joint, net.place(x + length * np.cos(angle), y + side * length * np.sin(angle)), rng.normal(0, 2))


def ring(net: Network, rng: np.random.Generator) -> None:
    """One closed loop, and an entrance."""
    count, radius = int(rng.integers(5, 9)), rng.uniform(25, 50)
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / count
    loop = [
        net.place(*(r * np.array([np.cos(a), np.sin(a)])))
        for a, r in zip(angles, radius * rng.uniform(0.8, 1.2, count), strict=True)
    ]
    for a, b in itertools.pairwise([*loop, loop[0]]):
        net.join(a, b, rng.normal(0, 2))
    net.join(loop[0], net.place(radius + rng.uniform(30, 60), rng.normal(0, 10)))


def ladder(net: Network, rng: np.random.Generator) -> None:
    """Two drifts side by side, a few metres of rock between them, and cross-cuts."""
    apart, rungs = rng.uniform(10, 18), int(rng.integers(2, 5))
    ways = np.cumsum(rng.uniform(25, 50, rungs + 2))
    low, high = ([net.place(x, y) for x in ways] for y in (0.0, apart))
    for side in (low, high):
        for a, b in itertools.pairwise(side):
            net.join(a, b)
    for k in range(1, rungs + 1):
        net.join(low[k], high[k])


def forks(net: Network, rng: np.random.Generator) -> None:
    """Y junctions, one after the other, the branches bent."""
    tips = [(net.place(0.0, 0.0), 0.0)]
    for generation in range(3):
        grown = []
        for tip, heading in tips:
            for turn in (0.0,) if generation == 0 else (rng.uniform(0.35, 0.7), rng.uniform(-0.7, -0.35)):
                length, (x, y) = rng.uniform(30, 60), net.places[tip]
                far = net.place(x + length * np.cos(heading + turn), y + length * np.sin(heading + turn))
                net.join(tip, far, rng.normal(0, 2))
                grown.append((far, heading + turn))
        tips = grown


def snake(net: Network, rng: np.random.Generator) -> None:
    """One winding drift: dead ends on both sides."""
    last, heading = net.place(0.0, 0.0), 0.0
    for _ in range(rng.integers(3, 6)):
        length, (x, y) = rng.uniform(30, 60), net.places[last]
        heading += rng.uniform(-0.8, 0.8)
        far = net.place(x + length * np.cos(heading), y + length * np.sin(heading))
        net.join(last, far, rng.uniform(-6, 6))
        last = far


def hall(net: Network, rng: np.random.Generator) -> None:
    """A wide hall with pillars, drifts away from it on all sides, two of them joined outside."""
    middle, half = net.place(0.0, 0.0), np.array([rng.uniform(10, 20), rng.uniform(8, 15)])
    net.rooms.append(half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    net.pillars += [half * rng.uniform(0.5, 0.7) * corner for corner in np.array([[-1.0, -1.0], [1.0, 1.0]])]
    gates = [net.place(*(half * side + 25 * side)) for side in np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])]
    for gate in gates:
        net.join(middle, gate)
    corner = net.place(*(half + rng.uniform(20, 30, 2)))
    net.join(gates[0], corner)
    net.join(corner, gates[1])


TOPOLOGIES = [grid, tree, ring, ladder, forks, snake, hall]


def random_run(net: Network, length_m: float, rng: np.random.Generator) -> list[Array]:
    """A walk of about this length from a place or from mid-drift; back in the other gear where nothing else is left."""
    first, second, line = net.drifts[rng.integers(len(net.drifts))]
    line, here = (line, second) if rng.random() < 0.5 else (line[::-1], first)
    if rng.random() < 0.4:  # from mid-drift
        way = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
        start = rng.uniform(0.2, 0.6) * way[-1]
        middle = [np.array([np.interp(start, way, line[:, k]) for k in (0, 1)])]
        points = middle + [p for p, w in zip(line, way, strict=True) if w > start + 3]
    else:
        points = list(line)
    driven, used = 0.0, np.zeros(len(net.drifts))
    while driven < length_m:
        back = points[-2] - points[-1]
        open_ways = [way for way in net.ways(here) if _bend_deg(-back, way[2][1] - way[2][0]) < SHARPEST_TURN_DEG]
        if not open_ways or rng.random() < 0.06:
            ways = [way for way in net.ways(here) if _bend_deg(back, way[2][1] - way[2][0]) < 1]
        else:
            fresh = np.array([0.3 ** used[k] for k, _, _ in open_ways])
            ways = [open_ways[rng.choice(len(open_ways), p=fresh / fresh.sum())]]
        k, here, line = ways[0]
        used[k] += 1
        points += list(line[1:])
        driven += float(np.hypot(*np.diff(line, axis=0).T).sum())
    return points


def _bend_deg(before: Array, after: Array) -> float:
    cross, dot = before[0] * after[1] - before[1] * after[0], before @ after
    return abs(float(np.degrees(np.arctan2(cross, dot))))

"""Random worlds, each from a number, mapped by the program and held against their truth.

    .venv/bin/python tests/benchmarks/random_worlds.py 1 2 3            a table; exit 1 where the law is broken
    .venv/bin/python tests/benchmarks/random_worlds.py 4 --hazards 2    the same world, struck by two kinds of hazards
    .venv/bin/python tests/benchmarks/random_worlds.py 17 -o FOLDER     only writes FOLDER/world17.toml and its profile

Rock, tags, vehicles, scanners and drives as mines may have them. Some numbers have shown faults; no constant of the
mapper was fitted to any. A world whose vehicle would not get around a corner is drawn again. The law: no failure, an
error of no more than 0.03 m and 0.3 mm for each metre driven, and nine of ten wall cells within 0.1 m of a wall. Where
hazards strike: 0.05 m and 0.5 mm for each metre, or the atlas says what is wrong with it.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from random_hazards import random_hazards
from random_networks import TOPOLOGIES, Network, ladder, random_run
from random_verdicts import HEAD, judge, summary

from hw_profiles.errors import BadInputError
from processing.simulation.hazards import KINDS
from processing.simulation.simulate import build_drive, build_space
from processing.simulation.world import parse_world

Array = NDArray[np.float64]
LONGEST_RUNS_M = 800.0  # all runs together, about
END_M = 4.0  # a dead end goes on for so long behind its last place
SCANNERS = [(181, 180.0), (361, 180.0), (541, 270.0), (1081, 270.0)]


def random_tags(net: Network, width_m: float, rng: np.random.Generator) -> list[Array]:
    """Every so many metres of drift, now and then at a junction, in a dead end, or a second one close by."""
    spacing, tags = rng.uniform(20, 150), []
    for _, _, line in net.drifts:
        way = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
        at = rng.uniform(0, spacing)
        while at < way[-1]:
            for more in (0.0, 10.0)[: 1 + (rng.random() < 0.15)]:
                point = np.array([np.interp(at + more, way, line[:, k]) for k in (0, 1)])
                tags.append(point + rng.uniform(-0.4, 0.4, 2) * width_m)
            at += rng.uniform(0.6, 1.4) * spacing
    tags += [place + rng.normal(0, 1, 2) for place in net.places if rng.random() < 0.1]
    return tags or [net.places[0]]


def write_random_world(folder: Path, number: int, hazards: int = 0) -> Path:
    """`world<number>.toml`, and the profile of its vehicle beside it. Raises: BadInputError: none can be driven.

    So many hazards strike it; the world itself is the same with any number of them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"world{number}.toml"
    for attempt in range(100):
        rng = np.random.default_rng([number, attempt])
        (folder / f"vehicle{number}.toml").write_text(_profile(rng), encoding="utf-8")
        text = _world(number, folder / f"vehicle{number}.toml", rng)
        world = parse_world(text, path.name)
        space = build_space(world, world.seed)
        try:
            for run in world.runs:
                build_drive(world, run, world.seed, space)
        except BadInputError:
            continue
        reach_m = max(tag.read_range_m for tag in world.tags)
        lot = np.random.default_rng([number, hazards, len(KINDS)])
        path.write_text("\n".join([text, *random_hazards(hazards, lot, reach_m), ""]), encoding="utf-8")
        return path
    raise BadInputError(f"world{number}: no drive fits")


def _profile(rng: np.random.Generator) -> str:
    """A trailer or a tricycle; the scanner looks ahead or back, in the middle or beside it, straight or askew."""
    tricycle = rng.random() < 0.4
    base = f"wheelbase_m = {rng.uniform(1.2, 3.0):.2f}" if tricycle else f"track_width_m = {rng.uniform(1.0, 2.2):.2f}"
    lines = [
        "schema = 1",
        'name = "random"',
        "[vehicle]",
        f'kinematics = "{"tricycle" if tricycle else "differential"}"',
        base,
    ]
    if tricycle and rng.random() < 0.5:
        lines.append('drive_axle = "front"')
    x, y, yaw = rng.uniform(0.3, 1.8), rng.normal(0, 0.3), rng.choice([0.0, rng.normal(0, 10)])
    if rng.random() < 0.6:
        x, yaw = -x, 180.0 + yaw
    lines += ["[lasers.primary]", f"mount = {{ x_m = {x:.2f}, y_m = {y:.2f}, yaw_deg = {yaw:.1f} }}"]
    for role in ("drive_wheel", "steering") if tricycle else ("left_wheel", "right_wheel"):
        lines += [
            "[[encoders]]",
            f'name = "{role}"',
            f'role = "{role}"',
            f"counts_per_turn = {rng.choice([1024, 4096])}",
        ]
        lines += ["wheel_radius_m = 0.3"] * (role != "steering")
    return "\n".join([*lines, "[rfid]", 'model = "ALR-9650"', ""])


def _world(number: int, profile: Path, rng: np.random.Generator) -> str:
    net, topology = Network(), TOPOLOGIES[number % len(TOPOLOGIES)]
    topology(net, rng)
    rough_m = float(rng.choice([0.0, 0.03, 0.1, 0.2, 0.3]))
    width_m = rng.uniform(3.2, 6.5 if topology is ladder else 8.0) + rough_m
    lines = [
        f"# {topology.__name__}",
        "schema = 1",
        f'name = "world{number}"',
        f"seed = {number}",
        f'profile = "{profile}"',
    ]
    lines += ["[walls]", f"roughness_m = {rough_m}", f"correlation_m = {rng.uniform(0.8, 3.0):.2f}"]
    for a, b, line in net.drifts:
        ends = [
            p + END_M * (p - q) / np.hypot(*(p - q)) if len(net.ways(of)) == 1 else p
            for of, p, q in ((a, line[0], line[1]), (b, line[-1], line[-2]))
        ]
        lines += [
            "[[drifts]]",
            f"points = {_points([ends[0], *line[1:-1], ends[1]])}",
            f"width_m = {width_m * rng.uniform(0.9, 1.1):.2f}",
        ]
    for corners in net.rooms:
        lines += ["[[rooms]]", f"corners = {_points(list(corners))}"]
    for pillar in net.pillars:
        lines += ["[[pillars]]", f"at = {_points([pillar])[1:-1]}", f"radius_m = {rng.uniform(0.3, 1.5):.2f}"]
    reach, share = rng.uniform(3, 12), rng.uniform(0.2, 0.9)
    for k, tag in enumerate(random_tags(net, width_m, rng)):
        lines += ["[[tags]]", f'epc = "E20034120000000000{number:03d}{k:03d}"', f"at = {_points([tag])[1:-1]}"]
        lines += [f"read_range_m = {reach * rng.uniform(0.8, 1.2):.1f}", f"read_probability = {share:.2f}"]
    runs, speed = int(rng.integers(1, 5)), rng.uniform(1.0, 5.0)
    for k in range(runs):
        points = random_run(net, LONGEST_RUNS_M / runs * rng.uniform(0.3, 1.0), rng)
        lines += [
            "[[runs]]",
            f'name = "r{k}"',
            f"waypoints = {_points(points)}",
            f"speed_m_s = {speed * rng.uniform(0.7, 1.3):.2f}",
        ]
    beams, view_deg = SCANNERS[rng.integers(len(SCANNERS))]
    lines += ["[scanner]", f"beams = {beams}", f"field_of_view_deg = {view_deg}", f"range_m = {rng.uniform(8, 30):.1f}"]
    lines += ["[driving]", "turn_radius_m = 4.0", f"wander_m = {rng.uniform(0, 0.25):.2f}"]
    return "\n".join([*lines, *_noise(rng, "tricycle" in profile.read_text(encoding="utf-8"), rough_m), ""])


def _noise(rng: np.random.Generator, tricycle: bool, rough_m: float) -> list[str]:
    worst = 3.0 if rough_m >= 0.1 else 1.0  # percent; in smooth walls nothing tells what the wheels count wrongly
    radius, apart = rng.uniform(-worst, worst), rng.normal(0, 0.2)
    wheels = (
        f"drive_wheel = {radius:.2f}" if tricycle else f"left_wheel = {radius:.2f}, right_wheel = {radius + apart:.2f}"
    )
    lines = [
        "[noise]",
        f"wheel_radius_error_percent = {{ {wheels} }}",
        f"slip_m_per_sqrt_m = {rng.uniform(0, 0.015):.4f}",
    ]
    lines += (
        [f"steering_zero_error_deg = {rng.normal(0, 0.3):.2f}", "steering_deg = 0.1"]
        if tricycle
        else [f"track_width_error_percent = {rng.normal(0, 1):.2f}"]
    )
    lines += [f"missed_pass_probability = {rng.choice([0.0, 0.1, 0.3])}"]
    return [*lines, f"dropped_scan_probability = {rng.choice([0.0, 0.01, 0.05])}"]


def _points(points: list[Array]) -> str:
    return "[" + ", ".join(f"[{x:.2f}, {y:.2f}]" for x, y in points) + "]"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("numbers", type=int, nargs="+")
    parser.add_argument("--hazards", type=int, default=0, metavar="N", help="so many strike each world; default: none")
    parser.add_argument("-o", dest="folder", type=Path, help="write the worlds there, and map nothing")
    args = parser.parse_args()
    if not 0 <= args.hazards <= len(KINDS):
        parser.error(f"there are {len(KINDS)} kinds of hazards")
    if args.folder is not None:
        for number in args.numbers:
            print(write_random_world(args.folder, number, args.hazards))
        return 0
    print(HEAD)
    verdicts = []
    for number in args.numbers:
        with tempfile.TemporaryDirectory() as folder:
            path = write_random_world(Path(folder), number, args.hazards)
            kinds = [hazard.kind for hazard in parse_world(path.read_text(encoding="utf-8"), path.name).hazards]
            calm = write_random_world(Path(folder) / "calm", number) if kinds else None
            verdicts.append(judge(number, path, kinds, Path(folder), calm))
            print(verdicts[-1].row, flush=True)
    if args.hazards:
        print("", *summary(verdicts), "", sep="\n")
    for verdict in verdicts:
        if verdict.word != "kept":
            print(f"world {verdict.number}, {verdict.word}: {verdict.why}")
    return int(any(verdict.word == "missed" for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())

"""Simulate: a world's drives as recordings, with the truth beside them.

In: a world. Out: a folder, whole or not at all; for the same world and seed always the same bytes:

    <world>-<run>.mcap   what rtlog-client would have recorded of the drive
    <world>-<run>.tum    the truth: t x y z qx qy qz qw of the vehicle in the world frame, at every stamp of the sensors
    walls.csv            the true walls as segments x1,y1,x2,y2 in metres, those that a later run found included
    tags.csv             epc,x,y
    world.toml           the world itself

Stamps are nanoseconds UTC, from a fixed day on; runs start four hours apart.
"""

import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Profile, parse_profile, read_profile_text
from processing.simulation.drive import Drive, plan_drive
from processing.simulation.hazard_clocks import delay_s
from processing.simulation.hazard_samples import disturb
from processing.simulation.hazard_tags import without_dead
from processing.simulation.hazard_traffic import obstacles
from processing.simulation.hazard_vehicle import true_profile
from processing.simulation.hazard_walls import space_of
from processing.simulation.hazards import OdometryLate, ScansLate
from processing.simulation.lots import generator, strikes_of
from processing.simulation.raycast import SegmentGrid, build_grid
from processing.simulation.recording import Samples, sample_drive, write_recording, write_truth
from processing.simulation.walls import free_space, new_walls, wall_segments
from processing.simulation.world import Run, World, parse_world, read_world_text, without_noise

Array = NDArray[np.float64]
FIRST_START_NS = 1_767_592_800 * 10**9  # 2026-01-05 06:00 UTC
BETWEEN_RUNS_NS = 4 * 3600 * 10**9
CLEARANCE_M = 0.5  # the least between the vehicle's origin and a wall
STREAMS = ("clock", "laser", "encoders", "rfid", "losses")


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    path: Path
    ticks: int
    length_m: float  # driven
    duration_s: float


def simulate(
    world_name: str | Path,
    out_dir: Path,
    seed: int | None = None,
    noise: bool = True,
    runs: list[str] | None = None,
    on_progress: Callable[[str, int, int], None] | None = None,
) -> list[SimulatedRun]:
    """Simulate a world (a file, or a shipped one by its name) into a new folder.

    Args:
        world_name: The world.
        out_dir: Where to; its parents are made.
        seed: In place of the world's; walls, driving and noise all follow it.
        noise: False leaves out hazards and all that sensors get wrong; walls and drives stay the same.
        runs: Only these; each comes out as it would among all.
        on_progress: Called with a run's name before it is simulated, the number of runs done, and of all.

    Raises:
        BadInputError: the world is wrong, or the folder exists already. Nothing was written.
    """
    text = read_world_text(world_name)
    world = parse_world(text, str(world_name))
    world = world if noise else without_noise(world)
    if unknown := set(runs or []) - {run.name for run in world.runs}:
        names = ", ".join(run.name for run in world.runs)
        raise BadInputError(f"world {world_name}: no run {', '.join(sorted(unknown))}; there are {names}")
    if out_dir.exists():
        raise BadInputError(f"{out_dir} exists already; it is left as it is")
    chosen = [(index, run) for index, run in enumerate(world.runs) if runs is None or run.name in runs]
    seed = world.seed if seed is None else seed
    space = build_space(world, seed)
    drives = [build_drive(world, run, seed, space) for _, run in chosen]
    segments = wall_segments(space)
    grid = build_grid(segments)
    spaces = [space_of(run, world, space, seed) for _, run in chosen]
    built = np.concatenate([segments, new_walls(spaces[-1], space)])
    results = []
    with _whole_folder(out_dir) as folder:
        (folder / "world.toml").write_text(text, encoding="utf-8")
        np.savetxt(folder / "walls.csv", built, "%.4f", ",", header="x1,y1,x2,y2", comments="")
        rows = ["{},{:.4f},{:.4f}\n".format(tag.epc, *world.point(tag.at)) for tag in world.tags]
        (folder / "tags.csv").write_text("epc,x,y\n" + "".join(rows), encoding="ascii")
        for done, ((index, run), drive, found) in enumerate(zip(chosen, drives, spaces, strict=True)):
            if on_progress is not None:
                on_progress(run.name, done, len(chosen))
            run_id, start_ns = f"{world.name}-{run.name}", FIRST_START_NS + index * BETWEEN_RUNS_NS
            profile_toml = read_profile_text(world.profile_of(run))
            profile = parse_profile(profile_toml, world.profile_of(run))
            walls = grid if found is space else build_grid(wall_segments(found))
            samples = sample_run(world, run, drive, walls, profile, seed)
            boot_id = uuid.uuid5(uuid.NAMESPACE_OID, f"{run_id} {seed}")
            write_recording(folder / f"{run_id}.mcap", samples, profile, profile_toml, start_ns, boot_id)
            write_truth(folder / f"{run_id}.tum", drive, samples, start_ns)
            ticks = int(samples.is_recorded.sum())
            results.append(SimulatedRun(out_dir / f"{run_id}.mcap", ticks, drive.length_m, drive.duration_s))
    return results


def sample_run(world: World, run: Run, drive: Drive, grid: SegmentGrid, profile: Profile, seed: int) -> Samples:
    """What is sampled on a run, as its hazards leave it; `profile` is what the recording says of the vehicle."""
    strikes = strikes_of(world, run, seed)
    vehicle = true_profile(profile, strikes)
    tags = [tag for tag in world.tags if run.name not in tag.unread_by]
    places = np.array([world.point(tag.at) for tag in tags]).reshape(-1, 2)
    samples = sample_drive(
        drive,
        grid,
        vehicle,
        tags,
        places,
        world.scanner,
        world.noise,
        {stream: generator(seed, run.name, stream) for stream in STREAMS},
        obstacles(strikes, drive, vehicle.lasers.primary.mount),
        scans_late_s=delay_s(strikes, ScansLate),
        odometry_late_s=delay_s(strikes, OdometryLate),
    )
    samples = disturb(samples, strikes, drive, grid, vehicle, tags, places)
    return replace(samples, readings=without_dead(samples.readings, world, run, drive.duration_s, seed))


def build_space(world: World, seed: int) -> shapely.Geometry:
    """The free space of the world, its rough walls drawn from the seed."""
    return free_space(world, generator(seed, "walls"))


def build_drive(world: World, run: Run, seed: int, space: shapely.Geometry) -> Drive:
    """The true drive of a run. Raises: BadInputError: it comes too near to a wall, or cannot be driven."""
    drive = plan_drive(world, run, generator(seed, run.name, "driving"))
    path = drive.pose[::10, :2]  # every 0.2 m
    clearances = clearance(path, space)
    worst = int(np.argmin(clearances))
    if clearances[worst] < CLEARANCE_M:
        x, y = path[worst]
        what = f"world {world.name}: run {run.name} comes within {CLEARANCE_M:g} m of a wall"
        raise BadInputError(f"{what} or through it at [{x:.1f}, {y:.1f}]")
    return drive


def clearance(path: Array, space: shapely.Geometry) -> Array:
    """How far each point (n, 2) is from the nearest wall, (n,); below zero in the rock."""
    shapely.prepare(space)
    points = shapely.points(path)
    walls = shapely.linestrings(wall_segments(space).reshape(-1, 2, 2))
    _, distances = shapely.STRtree(walls).query_nearest(points, return_distance=True, all_matches=False)
    return np.where(shapely.contains(space, points), distances, -distances)


@contextmanager
def _whole_folder(out_dir: Path) -> Iterator[Path]:
    """A folder beside `out_dir` that becomes it at the end, or goes if the work fails. Raises: BadInputError."""
    folder = out_dir.with_name(f".{out_dir.name}.{os.getpid()}.part")
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise BadInputError(f"{out_dir}: {error.strerror or error}") from error
    try:
        yield folder
        folder.rename(out_dir)
    except BaseException:
        shutil.rmtree(folder)
        raise

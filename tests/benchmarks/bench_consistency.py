"""The straight, featureless drift over ten seeds: its length against the wheels', and errors against what is stated.

Only wheels see how long it is: the map must be no worse than they are, and its covariances must hold: the mean NEES of
the drift's far end lies within its 95 % band. The first argument, if any, is another world; its edges are taken as one.
With --variants, the same drift narrower, wider, driven by other vehicles, driven backwards, with more slip.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from table import Figure, report

from processing.atlas import read_document
from processing.build import Config, build
from processing.comparison import read_trajectories
from processing.consistency import consistency, edge_errors
from processing.evaluation import truth_at
from processing.geometry import Array
from processing.open_loop import odometry_at_scans
from processing.read_log import read_log
from processing.simulation.simulate import simulate
from processing.simulation.world import SHIPPED
from processing.tum import read_tum

SEEDS = range(1, 11)
VARIANTS = {
    "narrow": {"width_m = 4.5": "width_m = 3.5"},
    "wide": {"width_m = 4.5": "width_m = 6.5"},
    "differential, 4 m/s": {'"canmet_trailer"': '"simulated"', "speed_m_s = 3.0": "speed_m_s = 4.0"},
    "tricycle": {'"canmet_trailer"': '"cu_ss534"', "{ left_wheel = 1.0, right_wheel = 0.9 }": "{ drive_wheel = 1.0 }"},
    "backwards": {'"east_stop", "niche", "niche_end", "niche", "west_start"': '"east_stop", "west_start"'},
    "slip": {"slip_m_per_sqrt_m = 0.005": "slip_m_per_sqrt_m = 0.02", "wander_m = 0.05": "wander_m = 0.15"},
}


def path_length(poses: Array) -> float:
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def wheels_error(recording: Path, truth: Path, from_tick: int, to_tick: int) -> float:
    """By how much the wheels alone, as the profile has them, count the way between two ticks too long [m]."""
    run = read_log(recording, None)
    ticks = run.scan_ticks.tolist()
    first, last = ticks.index(from_tick), ticks.index(to_tick)
    counted = float(np.hypot(*odometry_at_scans(run).deltas[first:last, :2].T).sum())
    return counted - path_length(truth_at(*read_tum(truth), run.scans.stamps_ns[first : last + 1]))


def main() -> int:
    worlds = sys.argv[1:] or ["straight"]
    if worlds != ["--variants"]:
        return measure(worlds[0], worlds[0])
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, changes in VARIANTS.items():
            text = (SHIPPED / "straight.toml").read_text()
            for old, new in changes.items():
                assert old in text, old
                text = text.replace(old, new)
            (world := Path(folder) / "straight.toml").write_text(text)
            missed |= measure(str(world), f"straight, {name}")
    return missed


def measure(world: str, name: str) -> int:
    errors, wheels = [], []
    with tempfile.TemporaryDirectory() as temporary:
        for seed in SEEDS:
            folder, atlas = Path(temporary) / str(seed), Path(temporary) / f"{seed}.atlas"
            runs = simulate(world, folder, seed)
            build([run.path for run in runs], None, Config(), atlas)
            document = read_document(atlas)
            truths = {run_id: read_tum(folder / f"{run_id}.tum") for run_id in read_trajectories(atlas)}
            errors += edge_errors(atlas, document["edges"], truths)
            for edge in (edge for edge in document["edges"] if edge["kind"] == "edge"):
                path = edge["paths"][0]
                truth = folder / f"{path['run']}.tum"
                wheels.append(wheels_error(folder / f"{path['run']}.mcap", truth, path["from"], path["to"]))
    found = consistency(errors)
    assert found is not None
    along, across = (np.array([error.error[k] for error in errors]) for k in (0, 1))
    stated = np.array([np.sqrt(np.diag(error.covariance)) for error in errors])
    return report(
        f"{name}: {len(errors)} drives through an edge, seeds {SEEDS[0]} to {SEEDS[-1]}",
        [
            Figure("the wheels alone: error of the way, rms", float(np.sqrt(np.mean(np.square(wheels)))), "m"),
            Figure(
                "far end: error ahead, rms",
                float(np.sqrt(np.mean(along**2))),
                "m",
                most=float(np.sqrt(np.mean(np.square(wheels)))),
            ),
            Figure("far end: stated deviation ahead, rms", float(np.sqrt(np.mean(stated[:, 0] ** 2))), "m"),
            Figure("far end: error to the side, rms", float(np.sqrt(np.mean(across**2))), "m"),
            Figure("far end: stated deviation to the side, rms", float(np.sqrt(np.mean(stated[:, 1] ** 2))), "m"),
            Figure("mean NEES of three dimensions, from below", found.mean_nees, "", least=found.band[0]),
            Figure("mean NEES of three dimensions, from above", found.mean_nees, "", most=found.band[1]),
            Figure("mean NEES of all poses of the drives", found.pose_mean_nees),
        ],
    )


if __name__ == "__main__":
    sys.exit(main())

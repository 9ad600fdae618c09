"""Every choice on simulated worlds and on a real log, built and compared by `rtlog-atlas` itself.

In: folders that `simulate` wrote, or a recording and its relations. Out: tables in Markdown, a row for each choice.
"""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
from choices_build import CHOICES, Choice

COLUMNS = {  # which seed is the worst, and how a figure is written
    "ATE, m": (max, ".4f"),
    "RPE 10 m, m": (max, ".4f"),
    "RPE 100 m, m": (max, ".3f"),
    "beacons, m": (max, ".4f"),
    "edge length, m": (max, ".4f"),
    "precision": (min, ".3f"),
    "recall": (min, ".3f"),
    "NEES": (max, ".1f"),
    "CPU, s": (max, ".0f"),
}
COSTLY = ("reference: the scan before", "solver: no robust cost", "solver: one linear step")
LEFT_OUT = {
    "mine_level": COSTLY,
    "tunnels": (*COSTLY, "reference: key frames 0.25 m apart", "reference: key frames 3 m apart"),
    "intel": ("assembly: `paper`", "method: `global`", "reference: the scan before"),
}
FIRST_SEED = 101


def simulate(world: str, folder: Path, seeds: int) -> list[Path]:
    """The folders of the seeds."""
    truths = [folder / f"{world}-{seed}" for seed in range(FIRST_SEED, FIRST_SEED + seeds)]
    for truth in truths:
        atlas_command("simulate", world, "-o", truth, "--seed", truth.name.rsplit("-", 1)[1])
    return truths


def print_world(world: str, truths: list[Path], folder: Path) -> None:
    print(f"| choice | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
    for choice in _chosen_for(world):
        rows = []
        for truth in truths:
            atlas = folder / f"{truth.name}-{CHOICES.index(choice)}.atlas"
            seconds = _build(choice, sorted(truth.glob("*.mcap")), atlas)
            rows.append([*_measure(atlas, truth), seconds])
        columns = zip(np.array(rows).T, COLUMNS.values(), strict=True)
        figures = " | ".join(_figure(column, worst(column), form) for column, (worst, form) in columns)
        print(f"| {choice.name} | {figures} |", flush=True)
    print()


def print_relations(recording: Path, relations: Path, folder: Path) -> None:
    print("| choice | mean error, m | its deviation, m | mean error, ° | CPU, s |\n|---|---|---|---|---|")
    for choice in _chosen_for(recording.stem):
        atlas = folder / f"{recording.stem}-{CHOICES.index(choice)}.atlas"
        seconds = _build(choice, [recording], atlas, "--method", "global")
        found = json.loads(atlas_command("compare", atlas, "--relations", relations, "--json"))["relations"]
        metres = f"{found['translation_mean_m']:.4f} | {found['translation_std_m']:.4f}"
        print(f"| {choice.name} | {metres} | {found['rotation_mean_deg']:.2f} | {seconds:.0f} |", flush=True)
    print()


def _chosen_for(world: str) -> list[Choice]:
    return [choice for choice in CHOICES if choice.name not in LEFT_OUT.get(world, ())]


def _build(choice: Choice, recordings: list[Path], atlas: Path, *options: str) -> float:
    """CPU seconds, user and system."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    atlas_command("build", *recordings, "-o", atlas, *options, *choice.options, choice=choice)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _measure(atlas: Path, truth: Path) -> list[float]:
    """All columns but the last."""
    found = json.loads(atlas_command("compare", atlas, "--truth", truth, "--json"))["truth"]
    errors = {error["distance_m"]: error["translation_rmse_m"] for error in found["rpe"]}
    distances = [errors.get(10.0, np.nan), errors.get(100.0, np.nan)]
    beacons, lengths = ((found[key] or {}).get("rmse", np.nan) for key in ("beacon_error_m", "edge_length_error_m"))
    walls = [found["walls"]["precision"], found["walls"]["recall"]]
    nees = (found["nees"] or {}).get("mean_nees", np.nan)
    return [found["ate"]["rmse_m"], *distances, beacons, lengths, *walls, nees]


def atlas_command(*arguments: str | Path, choice: Choice = CHOICES[0]) -> str:
    command = [sys.executable, Path(__file__).with_name("choices_build.py"), choice.name, *arguments]
    one_thread = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=one_thread)
    if result.returncode:
        sys.exit(f"{choice.name}: rtlog-atlas {' '.join(map(str, arguments))}\n{result.stderr}")
    return result.stdout


def _figure(values: np.ndarray, worst: float, form: str) -> str:
    return "–" if np.isnan(values).any() else f"{values.mean():{form}} ({worst:{form}})"

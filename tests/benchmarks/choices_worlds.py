"""Every choice on simulated worlds and on a real log.

In: folders that `simulate` wrote, or a recording and its relations. Out: tables in Markdown, a row for each choice.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from choices_build import CHOICES, Choice, build_otherwise

from processing.comparison import compare_relations, compare_truth

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
REFERENCES = tuple(choice.name for choice in CHOICES if choice.name.startswith("reference"))
SOLVERS = tuple(choice.name for choice in CHOICES if choice.name.startswith("solver"))
LEFT_OUT = {
    "two_drifts": REFERENCES + SOLVERS,
    "missed_tag": REFERENCES + SOLVERS,
    "straight": REFERENCES[:1],  # key frames 0.25 m apart are every scan there
    "mine_level": REFERENCES + SOLVERS,
    "tunnels": REFERENCES + SOLVERS,
    "intel": ("assembly: `paper`", "method: `global`", REFERENCES[0]),
}


def print_world(world: str, truths: list[Path], folder: Path) -> None:
    print(f"| choice | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
    for choice in _chosen_for(world):
        rows = []
        for truth in truths:
            atlas = folder / f"{truth.name}-{CHOICES.index(choice)}.atlas"
            seconds = build_otherwise(choice, sorted(truth.glob("*.mcap")), atlas)
            rows.append([*_measure(atlas, truth), seconds])
        columns = zip(np.array(rows).T, COLUMNS.values(), strict=True)
        figures = " | ".join(_figure(column, worst(column), form) for column, (worst, form) in columns)
        print(f"| {choice.name} | {figures} |", flush=True)
    print()


def print_relations(recording: Path, relations: Path, folder: Path) -> None:
    print("| choice | mean error, m | its deviation, m | mean error, ° | CPU, s |\n|---|---|---|---|---|")
    for choice in _chosen_for(recording.stem):
        atlas = folder / f"{recording.stem}-{CHOICES.index(choice)}.atlas"
        without_tags = replace(choice, config=replace(choice.config, method="global"))
        seconds = build_otherwise(without_tags, [recording], atlas)
        found = compare_relations(atlas, relations)["relations"]
        metres = f"{found['translation_mean_m']:.4f} | {found['translation_std_m']:.4f}"
        print(f"| {choice.name} | {metres} | {found['rotation_mean_deg']:.2f} | {seconds:.0f} |", flush=True)
    print()


def _chosen_for(world: str) -> list[Choice]:
    return [choice for choice in CHOICES if choice.name not in LEFT_OUT.get(world, ())]


def _measure(atlas: Path, truth: Path) -> list[float]:
    """All columns but the last."""
    found = compare_truth(atlas, truth)["truth"]
    errors = {error["distance_m"]: error["translation_rmse_m"] for error in found["rpe"]}
    distances = [errors.get(10.0, np.nan), errors.get(100.0, np.nan)]
    beacons, lengths = ((found[key] or {}).get("rmse", np.nan) for key in ("beacon_error_m", "edge_length_error_m"))
    walls = [found["walls"]["precision"], found["walls"]["recall"]]
    nees = (found["nees"] or {}).get("mean_nees", np.nan)
    return [found["ate"]["rmse_m"], *distances, beacons, lengths, *walls, nees]


def _figure(values: np.ndarray, worst: float, form: str) -> str:
    return "–" if np.isnan(values).any() else f"{values.mean():{form}} ({worst:{form}})"

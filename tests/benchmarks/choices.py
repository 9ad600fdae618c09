"""Which choice measures best: simulated worlds, several seeds, each matcher, assembly and method beside the others.

    .venv/bin/python tests/benchmarks/choices.py [--worlds loop,straight] [--seeds 3] > docs/choices.md

Out: a page in Markdown. A figure is the mean over the seeds, and the worst of them in brackets.
"""

import argparse
import json
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ATLAS = [sys.executable, "-m", "processing.cli"]
CHOICES = {
    "as shipped": [],
    "`--assembly paper`": ["--assembly", "paper"],
    "`--matcher psm`": ["--matcher", "psm"],
    "`--method global`": ["--method", "global"],
}
COLUMNS = {  # and which seed is the worst
    "ATE, m": max,
    "RPE 10 m, m": max,
    "RPE 100 m, m": max,
    "beacons, m": max,
    "edge length, m": max,
    "precision": min,
    "recall": min,
}
WORLDS = ("loop", "two_drifts", "missed_tag", "straight", "mine_level", "tunnels")
FIRST_SEED = 101
HEADER = """# Choices, by measurement

Each simulated world with {seeds} seeds (other walls, other noise), built with each choice; a row is the mean over the
seeds, the worst seed in brackets. ATE: one rigid move of the whole atlas onto the truth, rms over all poses
of all runs. RPE: relative error over 10 m and 100 m of driving. Precision and recall are those of the wall cells of the
map: a wall drawn twice lowers the precision.

Made by `{command}` on {machine}.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(WORLDS), help="default: %(default)s")
    parser.add_argument("--seeds", type=int, default=3, help="default: %(default)s")
    args = parser.parse_args()
    command = " ".join([".venv/bin/python", *sys.argv])
    print(
        HEADER.format(
            seeds=args.seeds, command=command, machine=f"{platform.machine()}, Python {platform.python_version()}"
        )
    )
    for world in args.worlds.split(","):
        print(f"## {world}\n")
        print(f"| choice | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
        measured: dict[str, list[list[float]]] = {choice: [] for choice in CHOICES}
        for seed in range(FIRST_SEED, FIRST_SEED + args.seeds):
            with tempfile.TemporaryDirectory() as folder:
                truth = Path(folder) / "truth"
                _run("simulate", world, "-o", truth, "--seed", str(seed))
                for number, (choice, options) in enumerate(CHOICES.items()):
                    measured[choice].append(_measure(truth, Path(folder) / f"{number}.atlas", options))
        for choice, rows in measured.items():
            columns = zip(np.array(rows).T, COLUMNS.values(), strict=True)
            print(
                f"| {choice} | {' | '.join(_figure(column, worst(column)) for column, worst in columns)} |", flush=True
            )
        print()


def _measure(truth: Path, atlas: Path, options: list[str]) -> list[float]:
    _run("build", *sorted(truth.glob("*.mcap")), "-o", atlas, "--jobs", "2", *options)
    found = json.loads(_run("compare", atlas, "--truth", truth, "--json"))["truth"]
    errors = {error["distance_m"]: error["translation_rmse_m"] for error in found["rpe"]}
    beacons, lengths = ((found[key] or {}).get("rmse", np.nan) for key in ("beacon_error_m", "edge_length_error_m"))
    walls = [found["walls"]["precision"], found["walls"]["recall"]]
    distances = [errors.get(10.0, np.nan), errors.get(100.0, np.nan)]
    return [found["ate"]["rmse_m"], *distances, beacons, lengths, *walls]


def _run(*arguments: str | Path) -> str:
    result = subprocess.run([*ATLAS, *arguments], capture_output=True, text=True, check=False)
    if result.returncode:
        sys.exit(f"rtlog-atlas {' '.join(map(str, arguments))}\n{result.stderr}")
    return result.stdout


def _figure(values: np.ndarray, worst: float) -> str:
    if np.isnan(values).any():
        return "–"
    return f"{values.mean():.3f} ({worst:.3f})"


if __name__ == "__main__":
    main()

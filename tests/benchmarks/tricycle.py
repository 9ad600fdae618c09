"""A real front-drive tricycle, calibrated on the first half of its drive and reckoned against its tracker on the other.

    tricycle.py dataset.txt     the recording that tests/processing/recorded_tricycle.py describes

Prints the figures by the first guess and as fitted, each with its standard deviation, and how far either odometry leads
off the tracker.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from processing.steering_calibration import NAMES

sys.path.insert(0, str(Path(__file__).parents[1] / "processing"))
from recorded_tricycle import (
    FIRST_GUESS,
    Recording,
    calibrate_tricycle,
    deviations,
    read_tricycle,
    relative_deviations,
    smooth_way,
)

UNITS = ("", "°", "mm", "m", "m", "m", "°")
IN_UNIT = np.array([1.0, np.degrees(1), 1e3, 1.0, 1.0, 1.0, np.degrees(1)])
APART_M = 10.0


def figures(recording: Recording, value: np.ndarray) -> list[str]:
    """Cells of a row: rms and most of position [m] and heading [°]; the same of stretches of 10 m."""
    cells = []
    for off in (deviations(recording, value), relative_deviations(recording, value, APART_M)):
        metres, degrees = np.hypot(off[:, 0], off[:, 1]), np.abs(np.degrees(off[:, 2]))
        cells += [f"{np.sqrt(np.mean(of**2)):.2f} / {of.max():.2f}" for of in (metres, degrees)]
    return cells


def row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    whole = read_tricycle(parser.parse_args().recording)
    half = len(whole) // 2
    first, second = whole.cut(0, half), whole.cut(half, len(whole))
    fit, other = calibrate_tricycle(first), calibrate_tricycle(second)
    print(row("", "first guess", "fitted on the first half", "on the second half"), row(*["---"] * 4), sep="\n")
    for k, (name, unit) in enumerate(zip(NAMES, UNITS, strict=True)):
        fitted = (f"{of.value[k] * IN_UNIT[k]:.3f} ± {of.sigma[k] * IN_UNIT[k]:.3f}" for of in (fit, other))
        print(row(f"{name} {unit}".strip(), f"{FIRST_GUESS[k] * IN_UNIT[k]:.3f}", *fitted))
    heads = ("position m", "heading °", f"position m in {APART_M:.0f} m", f"heading ° in {APART_M:.0f} m")
    print("", row("rms / most, off the tracker", *heads), row(*["---"] * 5), sep="\n")
    for what, part in (("the half that was not fitted", second), ("the whole drive", whole)):
        print(row(f"{what}, {smooth_way(part.tracker)[-1]:.0f} m: first guess", *figures(part, FIRST_GUESS)))
        print(row(f"{what}: calibrated on the first half", *figures(part, fit.value)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

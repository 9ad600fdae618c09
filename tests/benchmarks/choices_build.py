"""`rtlog-atlas` with one choice made otherwise than it ships; what is no option of it is a constant of a module.

    .venv/bin/python tests/benchmarks/choices_build.py "reference: the scan before" build RUN.mcap -o NAME.atlas

In: the name of a choice, then the command's own arguments, with one job. Out: what the command does.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

import numpy as np

from processing.cli import main
from processing.pose_graph import Links, Solution, solve

SPACING = "processing.open_loop.KEYFRAME_SPACING_M"
SOLVE = "processing.edge_map.solve"
NEVER = 1e12  # a corner that no link's squared distance reaches


def without_kernel(links: Links) -> Links:
    """The same links, none of which may be doubted."""
    return replace(links, robust=np.zeros(len(links), bool))


def solve_squares(poses: np.ndarray, links: Links, **how: Any) -> Solution:
    return solve(poses, without_kernel(links), **how)


def solve_once(poses: np.ndarray, links: Links, **how: Any) -> Solution:
    """One linear step, as Lu & Milios (1997) take it each time that the links are found anew."""
    return solve(poses, without_kernel(links), **{**how, "max_iterations": 1})


SQUARES = {"processing.frame_assembly.CORNER": NEVER, "processing.frame_assembly.GRADUAL": (NEVER,)}


@dataclass(frozen=True)
class Choice:
    name: str
    options: tuple[str, ...] = ()
    constants: Mapping[str, object] = field(default_factory=dict)


CHOICES = (
    Choice("as shipped"),
    Choice("matcher: `psm`", ("--matcher", "psm")),
    Choice("assembly: `paper`", ("--assembly", "paper")),
    Choice("method: `global`", ("--method", "global")),
    Choice("reference: the scan before", constants={SPACING: 0.0}),
    Choice("reference: key frames 0.25 m apart", constants={SPACING: 0.25}),
    Choice("reference: key frames 1.5 m apart", constants={SPACING: 1.5}),
    Choice("reference: key frames 3 m apart", constants={SPACING: 3.0}),
    Choice("solver: no robust cost", constants={SOLVE: solve_squares, **SQUARES}),
    Choice("solver: one linear step", constants={SOLVE: solve_once, **SQUARES}),
)


def make(choice: Choice) -> None:
    """Set the constants in this process. Raises: AttributeError: the product has no such constant any more."""
    for name, value in choice.constants.items():
        module_name, constant = name.rsplit(".", 1)
        module = import_module(module_name)
        getattr(module, constant)
        setattr(module, constant, value)


if __name__ == "__main__":
    make(next(choice for choice in CHOICES if choice.name == sys.argv[1]))
    sys.exit(main(sys.argv[2:]))

"""Builds with one choice made otherwise than it ships; what is no option of `rtlog-atlas` is a constant of a module.

In: recordings and a choice. Out: an atlas, and what it cost. Law: each build has a process of its own, a fork of this
one: what is set there is set nowhere else, and what this one has compiled is there.
"""

import multiprocessing
import resource
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from processing.build import Config, build
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


SQUARES = {
    "processing.frame_assembly.CORNER": NEVER,
    "processing.frame_assembly.GRADUAL": (NEVER,),
    "processing.linked_paths.CORNER": NEVER,
}


@dataclass(frozen=True)
class Choice:
    name: str
    config: Config = field(default_factory=Config)
    constants: Mapping[str, object] = field(default_factory=dict)


CHOICES = (
    Choice("as shipped"),
    Choice("matcher: `psm`", Config(matcher="psm")),
    Choice("assembly: `paper`", Config(assembly="paper")),
    Choice("method: `global`", Config(method="global")),
    Choice("reference: the scan before", constants={SPACING: 0.0}),
    Choice("reference: key frames 0.25 m apart", constants={SPACING: 0.25}),
    Choice("reference: key frames 1.5 m apart", constants={SPACING: 1.5}),
    Choice("reference: key frames 3 m apart", constants={SPACING: 3.0}),
    Choice("solver: no robust cost", constants={SOLVE: solve_squares, **SQUARES}),
    Choice("solver: one linear step", constants={SOLVE: solve_once, **SQUARES}),
)


def build_otherwise(choice: Choice, recordings: list[Path], atlas: Path) -> float:
    """CPU seconds, user and system."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = multiprocessing.get_context("fork").Process(target=_build, args=(choice, recordings, atlas))
    process.start()
    process.join()
    if process.exitcode:
        sys.exit(f"{choice.name}: {atlas} was not built")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _build(choice: Choice, recordings: list[Path], atlas: Path) -> None:
    for name, value in choice.constants.items():
        module_name, constant = name.rsplit(".", 1)
        module = import_module(module_name)
        getattr(module, constant)  # fails where the product has no such constant any more
        setattr(module, constant, value)
    build(recordings, None, choice.config, atlas)

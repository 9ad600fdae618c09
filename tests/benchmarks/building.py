"""Worlds that are simulated once, and builds in processes of their own whose cost is measured."""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from network_world import write_network

WORLDS = Path(tempfile.gettempdir()) / f"rtlog-benchmarks-{os.getuid()}"


@dataclass(frozen=True)
class Build:
    wall_s: float
    cpu_s: float  # of all its processes
    peak_mb: float  # of the largest of them
    summary: dict[str, object]


def network(blocks: int, one_run: bool = False) -> list[Path]:
    """The recordings of a network, simulated at the first call and kept in the temporary folder."""
    from processing.simulation.simulate import simulate

    folder = WORLDS / f"network{blocks}{'-one' * one_run}"
    if not folder.exists():
        WORLDS.mkdir(exist_ok=True)
        world = WORLDS / f"{folder.name}.toml"
        write_network(world, blocks, one_run)
        simulate(world, folder)
    return sorted(folder.glob("*.mcap"))


def build(recordings: list[Path], atlas: Path, *options: str) -> Build:
    """`rtlog-atlas build` as a user runs it."""
    command = [sys.executable, "-m", "processing.cli", "build", *map(str, recordings), "-o", str(atlas), "--json"]
    began = time.monotonic()
    with subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        text = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.monotonic() - began
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}")
    return Build(wall_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3, json.loads(text))


def same_atlas(a: Path, b: Path) -> bool:
    """Byte for byte in every file?"""
    ours, theirs = ({str(p.relative_to(of)): p for p in of.rglob("*") if p.is_file()} for of in (a, b))
    return ours.keys() == theirs.keys() and all(ours[k].read_bytes() == theirs[k].read_bytes() for k in ours)

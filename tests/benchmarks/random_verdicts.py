"""Does the map of a random world keep the law? Simulates, builds, measures, and says so in tables.

In: a world's file. Out: a `Verdict` and its row. The error is the RMSE of all poses of all runs under one rigid
transform; only runs that share no tag, which nothing joins, are moved each for itself. Where hazards strike, a map that
is further off than the law allows is told if its atlas says what it does not say of the same world without hazards,
and not of less than a tenth: worse than kept, better than missed.
"""

import json
import math
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from statistics import median

import numpy as np

from processing.comparison import read_trajectories
from processing.evaluation import Trajectory, absolute_error, align_parts, match_truth
from processing.tum import read_tum
from rtlog_client.log_file import read_messages
from rtlog_server.messages import decode
from rtlog_server.topics import TAGS

ATLAS = [sys.executable, "-m", "processing.cli"]
CALM, STRUCK = (0.03, 0.0003), (0.05, 0.0005)  # metres, and metres for each metre driven: without hazards, with them
LEAST_PRECISION = 0.9  # of the wall cells; hazards may spoil some
WELL_READ = 8  # reads


@dataclass(frozen=True)
class Verdict:
    number: int
    topology: str
    hazards: list[str]
    driven_m: float
    error_m: float
    parts: int
    precision: float
    told: list[str]  # what the atlas says against itself
    failure: str | None = None

    @property
    def allowed_m(self) -> float:
        least, share = STRUCK if self.hazards else CALM
        return least + share * self.driven_m

    @property
    def word(self) -> str:
        """Kept, told or missed."""
        within = self.error_m <= self.allowed_m and (self.hazards or self.precision >= LEAST_PRECISION)
        if self.failure is None and within:
            return "kept"
        return "told" if self.failure is None and self.hazards and self.told else "missed"

    @property
    def why(self) -> str:
        """Against the law, in a line."""
        if self.failure is not None:
            return self.failure
        why = (
            f"{self.error_m:.3f} m off, {self.allowed_m:.3f} m are allowed; {self.precision:.3f} of the cells on walls"
        )
        return "; ".join([why, f"{self.parts} part(s)", *self.told[:2]])

    @property
    def row(self) -> str:
        found = f"{self.error_m:9.4f} of {self.allowed_m:.3f} m{self.precision:11.4f}{self.parts:7d}"
        return (
            f"{self.number:6d}  {self.topology:8}{self.driven_m:7.0f} m{found}  {self.word:7}{', '.join(self.hazards)}"
        )


HEAD = f"{'world':>6}  {'':8}{'driven':>9}{'error':>9}{'allowed':>11}{'precision':>11}{'parts':>7}"


def judge(number: int, world: Path, hazards: list[str], folder: Path, calm: Path | None = None) -> Verdict:
    """Simulate, build and compare in a folder; where that breaks the law, the calm world too, for what it tells."""
    truth, atlas = folder / "truth", folder / "world.atlas"
    topology = world.read_text(encoding="utf-8").splitlines()[0][2:]
    try:
        _run("simulate", world, "-o", truth)
        _run("build", *sorted(truth.glob("*.mcap")), "-o", atlas)
        found = json.loads(_run("compare", atlas, "--truth", truth, "--json"))["truth"]
    except subprocess.CalledProcessError as error:
        last = (error.stderr.splitlines() or ["no word"])[-1]
        return Verdict(number, topology, hazards, 0.0, math.inf, 0, 0.0, [], f"status {error.returncode}: {last}")
    verdict = Verdict(
        number,
        topology,
        hazards,
        driven_m=sum(_length_m(path) for path in truth.glob("*.tum")),
        error_m=_error_m(atlas, truth),
        parts=found["parts"],
        precision=found["walls"]["precision"],
        told=_told(atlas),
    )
    if calm is None or verdict.word == "kept":
        return verdict
    usual = {_bare(line) for line in judge(number, calm, [], folder / "calm").told}
    return replace(verdict, told=[line for line in verdict.told if _bare(line) not in usual and not _is_small(line)])


def summary(verdicts: list[Verdict]) -> Iterator[str]:
    """How each kind of hazard was survived; a world counts for each of its hazards."""
    yield f"{'hazard':18}{'draws':>6}{'kept':>6}{'told':>6}{'missed':>8}{'median m':>10}{'worst m':>10}"
    kinds = sorted({kind for verdict in verdicts for kind in verdict.hazards})
    for kind in [*kinds, "all"]:
        of = [verdict for verdict in verdicts if kind in (*verdict.hazards, "all")]
        words, errors_m = [verdict.word for verdict in of], [verdict.error_m for verdict in of]
        counts = f"{len(of):6d}{words.count('kept'):6d}{words.count('told'):6d}{words.count('missed'):8d}"
        yield f"{kind:18}{counts}{median(errors_m):10.3f}{max(errors_m):10.3f}"


def _run(*arguments: str | Path) -> str:
    """Standard output. Raises: subprocess.CalledProcessError: it failed, or left a traceback."""
    done = subprocess.run([*ATLAS, *map(str, arguments)], capture_output=True, text=True, check=True)
    if "Traceback" in done.stderr:
        raise subprocess.CalledProcessError(0, done.args, done.stdout, f"a traceback: {done.stderr.splitlines()[-1]}")
    return done.stdout


def _told(atlas: Path) -> list[str]:
    """What an atlas says against itself."""
    document = json.loads((atlas / "atlas.json").read_text(encoding="utf-8"))
    lists = [[json.dumps(each) for each in document.get(key, [])] for key in ("convictions", "left_out")]
    return [*lists[0], *lists[1], *document["remarks"]]


def _is_small(line: str) -> bool:
    """Does it speak of less than a tenth, as of 6 of 643 scans? That warns nobody."""
    counts = re.search(r"\b(\d+) of (\d+) ", line)
    return counts is not None and 10 * int(counts[1]) < int(counts[2])


def _bare(line: str) -> str:
    """Without its numbers, which no two builds share."""
    return re.sub(r"[0-9A-F.]*\d[0-9A-F.]*", "#", line)


def _error_m(atlas: Path, truth: Path) -> float:
    """Of all poses of all runs, under one transform for all runs that share tags."""
    found = read_trajectories(atlas)
    runs = {run_id: match_truth(found[run_id], Trajectory(*read_tum(truth / f"{run_id}.tum"))) for run_id in found}
    groups = _joined({run_id: _tags(truth / f"{run_id}.mcap") for run_id in found})
    return absolute_error(runs, groups, align_parts(runs, groups)).rmse_m


def _tags(recording: Path) -> set[str]:
    """The tags that were well read; a few reads may be strays."""
    messages = [decode(message.data, message.msgtype) for message in read_messages(recording, [TAGS.name])]
    counts: Counter[str] = Counter()
    for read in (read for message in messages for read in message.reads):
        counts[read.epc] += read.count
    return {epc for epc, count in counts.items() if count >= WELL_READ}


def _joined(tags: dict[str, set[str]]) -> dict[str, int]:
    """The group of each run: those that share a tag, directly or by other runs, are one."""
    groups = {run_id: group for group, run_id in enumerate(tags)}
    for one, other in combinations(tags, 2):
        if tags[one] & tags[other]:
            groups = {run_id: groups[one] if group == groups[other] else group for run_id, group in groups.items()}
    return groups


def _length_m(path: Path) -> float:
    return float(np.hypot(*np.diff(np.loadtxt(path, usecols=(1, 2)), axis=0).T).sum())

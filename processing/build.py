"""Recordings in, atlas out: `rtlog-atlas build`.

    recordings ─ read_log ─ pipeline ─ Atlas

Law: what is not fit is refused before anything is begun, and nothing half done is left behind.
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

from hw_profiles.profile import Profile
from processing.output import refuse_existing
from processing.read_log import begin_reading
from processing.workers import Workers

if TYPE_CHECKING:
    from processing.atlas import Atlas


@dataclass(frozen=True, slots=True)
class Config:
    """What `rtlog-atlas build` was asked for; it goes into the atlas, so that a result explains itself."""

    method: Literal["landmark", "global"] = "landmark"
    assembly: Literal["refined", "paper"] = "refined"
    matcher: Literal["point-to-line", "psm"] = "point-to-line"
    resolution_m: float = 0.05


def build(recordings: list[Path], profile: Profile | None, config: Config, output: Path, jobs: int = 1) -> "Atlas":
    """Map recordings and write the atlas.

    Raises:
        BadInputError: a recording is unfit, or it cannot be told which run it is, or the output exists already.
        RTLogError: a disk is full, or a process died.
    """
    refuse_existing(output)
    with TemporaryDirectory(prefix="rtlog-atlas-") as temporary:
        scratch = Path(temporary)
        with Workers(jobs) as readers:
            runs = begin_reading(recordings, profile, scratch, readers)
            from processing.pipeline import map_runs, warm_up  # compilers and solvers load while others read

            warm_up()
            read = runs()
        with Workers(jobs) as work:
            return map_runs(read, config, output, scratch, work)

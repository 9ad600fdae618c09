"""Which files are one run: a recorder may split a run into parts, which share its run id.

In: recordings in any order. Out: for each run its parts in order of time. Law: what is one run is told by what files
say of themselves, never by their names, and what cannot be told is refused before any work.
"""

from itertools import pairwise
from pathlib import Path

from hw_profiles.errors import BadInputError
from rtlog_client.log_file import LogInfo, read_info

MAX_SHARED_NS = 10**9  # by so much two parts may overlap: messages of one tick on either side of the cut


def group_parts(recordings: list[Path]) -> list[tuple[Path, ...]]:
    """The runs in the order of their first mention, each with its parts.

    Raises:
        BadInputError: a file is no recording, one stands there twice, two runs have one name, or the name is not fit to
            be that of a file.
    """
    runs: dict[str, list[tuple[Path, LogInfo]]] = {}
    for path in recordings:
        info = read_info(path)
        if info.run_id in ("", ".", "..") or "/" in info.run_id:
            raise BadInputError(f"{path}: the run is called {info.run_id!r}, which no file can be")
        runs.setdefault(info.run_id, []).append((path, info))
    for run_id, parts in runs.items():
        parts.sort(key=lambda part: (part[1].start_ns, part[1].end_ns))
        for (a, before), (b, after) in pairwise(parts):
            if a.resolve() == b.resolve():
                raise BadInputError(f"{a} is named twice")
            boots = [info.metadata.get("boot_id") for info in (before, after)]
            if boots[0] == boots[1] and after.start_ns < before.end_ns - MAX_SHARED_NS:
                raise BadInputError(f"{a} and {b} hold the same time of run {run_id}; which of them is it?")
            if boots[0] != boots[1] or boots[0] is None:
                raise BadInputError(f"{a} and {b} are both called run {run_id}, and are not parts of one boot's run")
    return [tuple(path for path, _ in parts) for parts in runs.values()]

"""The loop as other scanners would have seen it: one simulated drive, its scans altered, mapped again.

    .venv/bin/python tests/benchmarks/bench_scanners.py

Out: the error of each map against the truth. What is altered is the recording, so that the whole of `build` is judged.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from table import Figure, report

from rtlog_client.log_file import LogWriter, read_info, read_messages
from rtlog_server.messages import decode, encode
from rtlog_server.topics import PRIMARY_SCAN

ATLAS = [sys.executable, "-m", "processing.cli"]
MUST_M = 0.03  # of the loop, with the scanner as it is
Change = Callable[[int, Any, np.random.Generator], Any]


def fewer_beams(_: int, scan: Any, __: np.random.Generator) -> Any:
    return replace(
        scan,
        ranges=np.array(scan.ranges[::3]),
        angle_increment=3 * scan.angle_increment,
        time_increment=3 * scan.time_increment,
        intensities=np.array(scan.intensities[::3]),
    )


def half_a_circle(_: int, scan: Any, __: np.random.Generator) -> Any:
    return replace(
        scan,
        ranges=scan.ranges[90:451],
        intensities=scan.intensities[90:451],
        angle_min=scan.angle_min + 90 * scan.angle_increment,
        angle_max=scan.angle_max - 90 * scan.angle_increment,
    )


def dust(k: int, scan: Any, rng: np.random.Generator) -> Any:
    share = 0.6 if 1200 <= k < 1400 else 0.15
    grains = rng.uniform(0.3, np.minimum(scan.ranges, scan.range_max))
    return replace(scan, ranges=np.where(rng.random(len(grains)) < share, grains, scan.ranges).astype(np.float32))


def dark_rock(_: int, scan: Any, rng: np.random.Generator) -> Any:
    lost = rng.random(len(scan.ranges)) < 0.5
    return replace(scan, ranges=np.where(lost, np.inf, scan.ranges).astype(np.float32))


def plate(_: int, scan: Any, rng: np.random.Generator) -> Any:
    """A part of the vehicle, 1.5 m off in 30° of the view."""
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ranges = 1.5 / np.cos(angles) + rng.normal(0, 0.004, len(angles))
    return replace(scan, ranges=np.where(np.abs(np.degrees(angles)) < 15, ranges, scan.ranges).astype(np.float32))


def someone_beside(k: int, scan: Any, rng: np.random.Generator) -> Any:
    """A third of the time a person, half a metre wide, walks two to four metres off."""
    ranges = np.array(scan.ranges)
    if k // 100 % 3 == 0:
        away = 3 + np.sin(k / 40)
        middle, half = int(270 + 200 * np.sin(k / 70)), int(0.25 / away / scan.angle_increment)
        seen = slice(max(middle - half, 0), middle + half)
        ranges[seen] = np.minimum(ranges[seen], away + rng.normal(0, 0.02))
    return replace(scan, ranges=ranges)


def jittered_stamps(_: int, scan: Any, rng: np.random.Generator) -> Any:
    stamp = scan.header.stamp
    ns = stamp.sec * 10**9 + stamp.nanosec + int(4e6 * rng.normal())
    return replace(scan, header=replace(scan.header, stamp=replace(stamp, sec=ns // 10**9, nanosec=ns % 10**9)))


def every_other(k: int, scan: Any, _: np.random.Generator) -> Any:
    return None if k % 2 else scan


CHANGES: dict[str, Change] = {
    "as it is: 541 beams, 270°, 10 Hz": lambda _, scan, __: scan,
    "181 beams": fewer_beams,
    "180°, 361 beams": half_a_circle,
    "5 Hz": every_other,
    "dust: 15 % of the beams end on nothing, 60 % for 20 s": dust,
    "dark rock: half of the beams have no return": dark_rock,
    "a plate of the vehicle in 30° of the view": plate,
    "someone walks beside": someone_beside,
    "stamps that jitter by 4 ms": jittered_stamps,
}


def main() -> int:
    figures = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _run("simulate", "loop", "-o", folder / "truth", "--seed", "1")
        (recording,) = (folder / "truth").glob("*.mcap")
        for number, (what, change) in enumerate(CHANGES.items()):
            (folder / str(number)).mkdir()
            alter(recording, folder / str(number) / recording.name, change)
            atlas = folder / f"{number}.atlas"
            _run("build", folder / str(number) / recording.name, "-o", atlas)
            found = json.loads(_run("compare", atlas, "--truth", folder / "truth", "--json"))["truth"]
            figures.append(Figure(what, found["ate"]["rmse_m"], "m", most=MUST_M))
    return report("error of the loop's map, by the scanner", figures)


def alter(recording: Path, output: Path, change: Change) -> None:
    """A copy of the recording with other scans; where the change gives None, the scan is missing."""
    info, rng, k = read_info(recording), np.random.default_rng(1), 0
    with LogWriter(output, info.metadata, info.profile_toml) as log:
        for message in read_messages(recording):
            data = message.data
            if message.topic == PRIMARY_SCAN.name:
                scan = change(k, decode(data, message.msgtype), rng)
                k += 1
                if scan is None:
                    continue
                data = encode(scan)
            log.write(
                message.topic, message.msgtype, data, message.log_time_ns, message.publish_time_ns, message.sequence
            )


def _run(*arguments: str | Path) -> str:
    return subprocess.run([*ATLAS, *arguments], check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    sys.exit(main())

"""A drive whose scans lost beams, met dust or saw the vehicle itself is mapped about as well as without all that."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from processing.atlas import read_document
from processing.build import Config, build
from processing.geometry import align, compose
from processing.tum import read_tum
from rtlog_client.log_file import LogWriter, read_info, read_messages
from rtlog_server.messages import decode, encode
from rtlog_server.topics import PRIMARY_SCAN

ANGLES = np.radians(np.linspace(-135, 135, 541))
Change = Callable[[np.ndarray, np.random.Generator], np.ndarray]  # of the ranges (541,) of a scan


def dropouts(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.where(rng.random(len(ranges)) < 0.5, np.inf, ranges)


def every_second(ranges: np.ndarray, _: np.random.Generator) -> np.ndarray:
    return np.where(np.arange(len(ranges)) % 2, np.nan, ranges)


def dust(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.where(rng.random(len(ranges)) < 0.3, rng.uniform(0.3, np.fmin(ranges, 20.0)), ranges)


def plate(ranges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """1.5 m ahead of the scanner, in 30° of its view."""
    ahead = np.abs(np.degrees(ANGLES)) < 15
    return np.where(ahead, 1.5 / np.cos(ANGLES) + rng.normal(0, 0.004, len(ranges)), ranges)


@pytest.mark.parametrize("change", [dropouts, every_second, dust, plate])
def test_the_drive_is_mapped(small_world: Path, tmp_path: Path, change: Change) -> None:
    recording = tmp_path / "small-around.mcap"
    alter(small_world / recording.name, recording, change)
    atlas = build([recording], None, Config(), tmp_path / "small.atlas")
    stamps, poses = atlas.trajectories["small-around"]
    true_stamps, true = read_tum(small_world / "small-around.tum")
    wanted = true[np.searchsorted(true_stamps, stamps)]
    off = compose(align(poses[:, :2], wanted[:, :2]), poses) - wanted
    assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))) < 0.03
    notes = [note for note in read_document(tmp_path / "small.atlas")["remarks"] if "vehicle itself" in note]
    if change is plate:
        (note,) = notes
        assert re.fullmatch(r"run small-around: beams at -1\d°…1\d° see the vehicle itself at 1\.5 m; .*", note)
    else:
        assert notes == []


def alter(source: Path, target: Path, change: Change) -> None:
    """A copy of the recording with other ranges."""
    info, rng = read_info(source), np.random.default_rng(1)
    with LogWriter(target, info.metadata, info.profile_toml) as log:
        for message in read_messages(source):
            data = message.data
            if message.topic == PRIMARY_SCAN.name:
                scan = decode(data, message.msgtype)
                data = encode(replace(scan, ranges=change(np.array(scan.ranges, float), rng).astype(np.float32)))
            log.write(message.topic, message.msgtype, data, message.log_time_ns, message.publish_time_ns)

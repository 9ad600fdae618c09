"""Relocation: a key frame far from where it was thought to be is found on the map, and chance is not believed."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.geometry import compose, wrap_angle
from processing.relocation import likelihood_field, relocate, relocate_stretch
from processing.scan_matching import match_scans
from processing.scan_walls import prepare_scan
from processing.simulation.raycast import build_grid, cast
from processing.strong_links import KeyFrames

ANGLES = np.radians(np.arange(-135, 135.25, 0.5))
MOUNT = np.array([-0.6, 0.0, np.pi])


def walls(seed: int) -> np.ndarray:
    """A hall of 30 × 20 m with boxes in it: segments (n, 4)."""
    rng = np.random.default_rng(seed)
    boxes = [(0.0, 0.0, 30.0, 20.0)]
    boxes += [(x, y, x + w, y + h) for x, y, w, h in rng.uniform([2, 2, 0.5, 0.5], [26, 16, 3, 2], (9, 4))]
    out = []
    for x0, y0, x1, y1 in boxes:
        corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
        out += [[*a, *b] for a, b in pairwise(corners)]
    return np.array(out)


def look(segments: np.ndarray, poses: np.ndarray, seed: int) -> list:
    rng, grid = np.random.default_rng(seed), build_grid(segments)
    scans = []
    for pose in poses:
        laser = compose(pose, MOUNT)
        origins = np.tile(laser[:2], (len(ANGLES), 1))
        ranges = cast(grid, origins, laser[2] + ANGLES, 20.0) + rng.normal(0, 0.01, len(ANGLES))
        ranges = np.where(np.isfinite(ranges) & (ranges < 20), ranges, np.nan)
        points = np.stack([ranges * np.cos(ANGLES), ranges * np.sin(ANGLES)], axis=-1)
        scans.append(prepare_scan(points, ANGLES[0], ANGLES[1] - ANGLES[0], MOUNT))
    return scans


@pytest.fixture(scope="module")
def drive() -> tuple[KeyFrames, np.ndarray]:
    """Along the hall and back: 16 key frames and their true poses."""
    x = np.linspace(4, 18, 8)
    there = np.column_stack([x, np.full(8, 1.0), np.zeros(8)])
    back = np.column_stack([x[::-1] + 0.3, np.full(8, 1.4), np.full(8, np.pi)])
    poses = np.concatenate([there, back])
    scans = look(walls(3), poses, 1)
    travelled = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    return KeyFrames(scans, np.zeros(16, np.int64), travelled, np.tile(MOUNT, (16, 1)), match_scans), poses


def test_a_scan_is_found_metres_and_half_a_radian_away(drive: tuple[KeyFrames, np.ndarray]) -> None:
    frames, poses = drive
    field, origin = likelihood_field(frames.scans[:8], compose(poses[:8], MOUNT))
    wrong = poses[12] + np.array([3.0, -2.0, 0.45])
    found, share = relocate(frames.scans[12], field, origin, wrong, 5.0, 0.6)
    assert_allclose(found[:2], poses[12, :2], atol=0.3)
    assert abs(wrap_angle(found[2] - poses[12, 2])) < 0.05
    assert share > 0.7


def test_a_stretch_that_is_lost_gets_links_to_where_it_is(drive: tuple[KeyFrames, np.ndarray]) -> None:
    frames, poses = drive
    guess = poses.copy()
    guess[8:] = compose(np.array([2.5, 1.5, 0.3]), poses[8:])  # the way back, bent off as a whole
    links = relocate_stretch(frames, guess, np.arange(8, 16), np.arange(8), 6.0, 0.6)
    assert len(links) >= 4
    seen = compose(poses[links.ends[:, 0]], links.motions)
    assert_allclose(seen[:, :2], poses[links.ends[:, 1], :2], atol=0.05)


def test_a_stretch_of_another_place_is_not_found(drive: tuple[KeyFrames, np.ndarray]) -> None:
    frames, poses = drive
    elsewhere = look(walls(17), poses[8:] + np.array([0.0, 9.0, 0.0]), 2)
    mixed = KeyFrames(frames.scans[:8] + elsewhere, frames.drive, frames.travelled, frames.mounts, match_scans)
    assert len(relocate_stretch(mixed, poses, np.arange(8, 16), np.arange(8), 6.0, 0.6)) == 0

"""Parts joined by the tags that they share: two tags, one tag and a bend, one tag where nothing tells the way."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from processing.build import Config, build
from processing.comparison import compare_truth
from processing.geometry import compose, relative
from processing.part_joining import PlacedDrive, TagPass, _some, join_parts, tag_links
from processing.scan_walls import Scan, prepare_scan
from processing.simulation.simulate import simulate

SMOOTH = """
schema = 1
name = "smooth"
seed = 5
profile = "canmet_trailer"
walls.roughness_m = 0.0
drifts = [{{ points = [[0, 0], [120, 0], {end}], width_m = 4.4 }}]
tags = [{tags}]
runs = [
    {{ name = "there", waypoints = [[8, 0], [120, 0], {turning}], speed_m_s = 2.5 }},
    {{ name = "back", waypoints = [{turning}, [120, 0], [50, 0]], speed_m_s = 2.5, profile = "{profile}" }},
]
"""
BEND = {"end": "[120, 60]", "turning": "[120, 30]"}
STRAIGHT = {"end": "[200, 0]", "turning": "[150, 0]"}  # the ends are out of sight
ONE = '{ epc = "E20034120000000000000A01", at = [85, 2] }'
TWO = ONE + ', { epc = "E20034120000000000000A02", at = [60, 2] }'


def map_smooth(folder: Path, tags: str, shape: dict[str, str], profile: str = "canmet_trailer") -> tuple[dict, str]:
    """The figures of `compare --truth` of both runs, and what is told of the map."""
    world = SMOOTH.format(tags=tags, profile=profile, **shape)
    (folder / "smooth.toml").write_text(world, encoding="utf-8")
    simulate(folder / "smooth.toml", folder / "sim")
    atlas = build(sorted((folder / "sim").glob("*.mcap")), None, Config(), folder / "smooth.atlas")
    return compare_truth(folder / "smooth.atlas", folder / "sim")["truth"], "\n".join(atlas.document["remarks"])


@pytest.mark.parametrize("tags", [ONE, TWO], ids=["one tag", "two tags"])
@pytest.mark.parametrize("profile", ["canmet_trailer", "pickup"])
def test_drives_both_ways_round_a_bend_are_one_map(tmp_path: Path, tags: str, profile: str) -> None:
    """What the scans see at the tags fits both ways round; the bend fits one, whichever way the scanners look."""
    found, _ = map_smooth(tmp_path, tags, BEND, profile)
    assert found["parts"] == 1
    assert found["ate"]["rmse_m"] < 0.1
    assert found["ate"]["heading_rmse_deg"] < 0.2


def test_two_tags_join_drives_through_a_drift_without_a_mark(tmp_path: Path) -> None:
    """No scan tells which way round or how far along: the tags do, as far as they go."""
    found, _ = map_smooth(tmp_path, TWO, STRAIGHT)
    assert found["parts"] == 1
    assert found["ate"]["rmse_m"] < 2.0
    assert found["ate"]["heading_rmse_deg"] < 0.2


def test_one_tag_in_a_drift_without_a_mark_joins_nothing_and_that_is_told(tmp_path: Path) -> None:
    found, told = map_smooth(tmp_path, ONE, STRAIGHT)
    assert found["parts"] == 2
    assert "passes of E20034120000000000000A01 could not be joined" in told
    assert found["ate_each_part"]["rmse_m"] < 0.3


def test_passes_of_a_tag_in_one_part_are_linked_unless_a_piece_holds_them() -> None:
    passes = [TagPass(0, 7, 0, 0, 2.0), TagPass(1, 7, 0, 50, 2.0), TagPass(2, 7, 0, 90, 2.0), TagPass(3, 8, 0, 95, 2.0)]
    part = np.zeros(4, np.int64)
    links = tag_links(passes, part, [np.array([0, 2]), np.array([1, 3])])
    assert links.ends.tolist() == [[0, 1]]  # the third lies in a piece with the first
    assert not links.robust.any()
    assert links.informations[0, 2, 2] < 1e-2  # a tag knows no heading
    apart = tag_links(passes, np.array([0, 1, 1, 1]), [np.array([0]), np.array([1]), np.array([2]), np.array([3])])
    assert apart.ends.tolist() == [[1, 2]]


def test_two_tags_say_how_parts_lie_without_a_scan() -> None:
    """Three tags far apart, no scans worth matching: least squares of the places."""
    rng = np.random.default_rng(3)
    poses = np.column_stack([np.linspace(0, 100, 11), 5 * np.sin(np.arange(11)), np.zeros(11)])
    elsewhere = compose(np.array([40.0, -20.0, 2.0]), poses + rng.normal(0, 0.3, poses.shape) * [1, 1, 0])
    blind = [blind_scan()] * 11
    drives = [PlacedDrive(at, blind, np.zeros(3), part) for part, at in enumerate((poses, elsewhere))]
    passes = [TagPass(10 * d + k, k, d, k, 2.0) for d in range(2) for k in (0, 5, 10)]
    (join,) = join_parts(drives, passes)
    assert join.nodes == [0, 5, 10]
    assert_allclose(compose(join.move, elsewhere)[:, :2], poses[:, :2], atol=1.5)
    assert abs(relative(poses[0], compose(join.move, elsewhere[0]))[2]) < 0.05


def test_one_tag_and_blind_scans_join_nothing() -> None:
    poses = np.column_stack([np.linspace(0, 100, 11), np.zeros(11), np.zeros(11)])
    drives = [PlacedDrive(poses, [blind_scan()] * 11, np.zeros(3), part) for part in range(2)]
    assert join_parts(drives, [TagPass(0, 4, 0, 5, 2.0), TagPass(1, 4, 1, 5, 2.0)]) == []


def blind_scan() -> Scan:
    return prepare_scan(np.full((50, 2), np.nan), -1.0, 0.04)


def test_no_more_pairs_are_asked_than_are_of_use_and_all_passes_come_by() -> None:
    ours = [TagPass(v, 7, 0, v, 2.0) for v in range(6)]
    theirs = [TagPass(v, 7, 1, v, 2.0) for v in (10, 11)]
    pairs = [(one, other) for one in ours for other in theirs]
    asked = _some(pairs, 6)
    assert len(asked) == 6
    assert {other.variable for _, other in asked} == {10, 11}
    assert len({one.variable for one, _ in asked}) == 6
    assert _some(pairs[:3], 6) == pairs[:3]

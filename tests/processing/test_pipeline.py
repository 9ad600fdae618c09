"""The whole method on the small mine: recordings in, atlas out, the same wherever it is computed."""

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import parse_profile, read_profile_text
from processing import read_log
from processing.atlas import Atlas, read_document
from processing.build import Config, build
from processing.geometry import align, compose, wrap_angle
from processing.pieces import drift_suffix
from processing.tum import read_tum
from rtlog_client.log_file import LoggedMessage, LogWriter, read_info, read_messages
from rtlog_server.messages import decode, to_ns


def rewrite(
    source: Path, target: Path, keep: Callable[[LoggedMessage], bool], metadata: dict[str, str] | None = None
) -> Path:
    """A recording with some of the messages of another, and its profile."""
    with LogWriter(target, metadata or {}, read_info(source).profile_toml) as log:
        for m in read_messages(source):
            if keep(m):
                log.write(m.topic, m.msgtype, m.data, m.log_time_ns, m.publish_time_ns, m.sequence)
    return target


@pytest.fixture(scope="module")
def recordings(small_world: Path) -> list[Path]:
    return [small_world / "small-around.mcap", small_world / "small-back.mcap"]


@pytest.fixture(scope="module")
def one_process(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("one_process") / "small.atlas"


@pytest.fixture(scope="module")
def atlas(recordings: list[Path], one_process: Path) -> Atlas:
    return build(recordings, None, Config(), one_process)


@pytest.fixture(scope="module")
def short(recordings: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 8 s of the second run, without the reader's topic."""
    start_ns = read_info(recordings[1]).start_ns
    target = tmp_path_factory.mktemp("short") / "short.mcap"
    return rewrite(recordings[1], target, lambda m: m.topic != "/rfid/tags" and m.log_time_ns < start_ns + 8 * 10**9)


@pytest.mark.usefixtures("atlas")
def test_one_process_or_two_give_the_same_bytes(one_process: Path, small_atlas: Path) -> None:
    names = sorted(str(path.relative_to(small_atlas)) for path in small_atlas.rglob("*") if path.is_file())
    assert len(names) == 1 + 9 + 2 + 3
    for name in names:
        assert (one_process / name).read_bytes() == (small_atlas / name).read_bytes(), name


def worst(atlas: Atlas, world: Path) -> tuple[float, float]:
    """How far off the worst pose of all runs is [m, rad], once all are moved as one onto the truth."""
    true, estimated = [], []
    for run_id, (stamps, poses) in atlas.trajectories.items():
        true_stamps, true_poses = read_tum(world / f"{run_id}.tum")
        assert np.isin(stamps, true_stamps).all()
        true.append(true_poses[np.searchsorted(true_stamps, stamps)])
        estimated.append(poses)
    wanted, found = np.concatenate(true), np.concatenate(estimated)
    errors = compose(align(found[:, :2], wanted[:, :2]), found) - wanted
    return float(np.hypot(*errors[:, :2].T).max()), float(np.abs(wrap_angle(errors[:, 2])).max())


def test_the_walls_close_and_the_drive_is_the_true_one(atlas: Atlas, small_world: Path) -> None:
    metres, radians = worst(atlas, small_world)
    assert metres < 0.05
    assert radians < np.radians(0.5)


@pytest.mark.parametrize(("choice", "most_m"), [(Config(matcher="psm"), 0.05), (Config(assembly="paper"), 0.5)])
def test_the_papers_matcher_and_its_assembly_find_the_drive_too(
    choice: Config, most_m: float, recordings: list[Path], small_world: Path, tmp_path: Path
) -> None:
    metres, radians = worst(build(recordings, None, choice, tmp_path / "paper.atlas"), small_world)
    assert metres < most_m
    assert radians < np.radians(1.5)


def test_every_scan_and_every_reading_has_a_pose(atlas: Atlas, recordings: list[Path]) -> None:
    for recording in recordings:
        topics = ["/laser/primary/scan", "/encoders/joint_states"]
        sent = {to_ns(decode(m.data, m.msgtype).header.stamp) for m in read_messages(recording, topics)}
        stamps, poses = atlas.trajectories[recording.stem]
        assert stamps.tolist() == sorted(sent)
        assert poses.shape == (len(stamps), 3)


def test_a_trajectory_does_not_jump_from_piece_to_piece(atlas: Atlas) -> None:
    for stamps, poses in atlas.trajectories.values():
        speed = np.hypot(*np.diff(poses[:, :2], axis=0).T) / np.maximum(np.diff(stamps) * 1e-9, 0.01)
        assert speed.max() < 3.0 + 1.5  # driven at 3 m/s at most


def test_paths_run_from_pass_to_pass(atlas: Atlas) -> None:
    document = atlas.document
    for run in document["runs"]:
        passes = sorted(
            (each["tick"], node["id"])
            for node in document["nodes"]
            for each in node["passes"]
            if each["run"] == run["id"]
        )
        paths = sorted(
            (path["from"], path["to"], path["direction"], edge["i"], edge["j"])
            for edge in document["edges"]
            for path in edge["paths"]
            if path["run"] == run["id"]
        )
        assert paths[0][0] == 0
        assert paths[-1][1] == run["ticks"] - 1
        assert all(a[1] == b[0] for a, b in pairwise(paths))
        assert [path[1] for path in paths[:-1]] == [tick for tick, _ in passes]
        for (_, first), (_, last), (_, _, direction, i, j) in zip(passes[:-1], passes[1:], paths[1:-1], strict=True):
            ends = (i, i) if j is None else (i, j)[::direction]
            assert ends == (first, last)


def test_both_ways_and_both_runs_share_an_edge(atlas: Atlas) -> None:
    edge = next(edge for edge in atlas.document["edges"] if edge["id"] == "0-1")
    assert [(path["run"], path["direction"]) for path in edge["paths"]] == [
        ("small-around", 1),
        ("small-around", 1),
        ("small-back", -1),
    ]
    assert edge["links"]["strong"] > 20


def test_a_turn_around_is_a_spur_of_its_tag(atlas: Atlas) -> None:
    spurs = [
        edge for edge in atlas.document["edges"] if edge["kind"] == "spur" and edge["paths"][0]["run"] == "small-back"
    ]
    assert [(edge["i"], edge["j"], len(edge["paths"])) for edge in spurs] == [(0, None, 1), (0, None, 1), (1, None, 1)]
    out_and_back, last, first = (edge["paths"][0] for edge in spurs)
    assert first["from"] == 0
    assert out_and_back["to"] == last["from"] > out_and_back["from"] > first["to"]
    assert last["to"] == 431


def test_a_run_without_tags_is_mapped_alone_and_that_is_said(short: Path, tmp_path: Path) -> None:
    atlas = build([short], None, Config(), tmp_path / "a.atlas")
    assert atlas.document["nodes"] == []
    assert [(edge["id"], edge["kind"], edge["length"]) for edge in atlas.document["edges"]] == [("run-0", "run", None)]
    assert "run short passed 0 tags: it is mapped alone" in atlas.document["remarks"]
    assert atlas.document["runs"][0]["ticks"] == 80
    (stamps, poses) = atlas.trajectories["short"]
    assert len(poses) == len(stamps) > 150
    assert np.hypot(*(poses[-1, :2] - poses[0, :2])) > 5


def test_parts_that_nothing_joins_lie_side_by_side(short: Path, recordings: list[Path], tmp_path: Path) -> None:
    end_ns = read_info(recordings[0]).start_ns + 14 * 10**9
    start = rewrite(recordings[0], tmp_path / "start.mcap", lambda m: m.log_time_ns < end_ns)  # past the first tag
    atlas = build([short, start], None, Config(), tmp_path / "a.atlas")
    assert {edge["part"] for edge in atlas.document["edges"]} == {0, 1}
    assert any("unconnected parts" in remark for remark in atlas.document["remarks"])
    first, second = (poses[:, 0] for _, poses in atlas.trajectories.values())
    assert first.max() + 20 < second.min() or second.max() + 20 < first.min()
    assert len(atlas.document["nodes"]) == 1


@pytest.mark.parametrize("assembly", ["refined", "paper"])
def test_the_global_method_needs_no_tags(short: Path, assembly: Any, tmp_path: Path) -> None:
    atlas = build([short], None, Config(method="global", assembly=assembly), tmp_path / "a.atlas")
    assert (len(atlas.document["nodes"]), len(atlas.document["edges"])) == (0, 1)
    assert atlas.document["parameters"] == {
        "method": "global",
        "assembly": assembly,
        "matcher": "point-to-line",
        "resolution_m": 0.05,
    }


def test_a_named_profile_wins_over_the_one_inside(short: Path, tmp_path: Path) -> None:
    text = read_profile_text("canmet_trailer").replace('name = "canmet_trailer"', 'name = "mended"')
    drawn_back = re.sub(r"x_m = -?[0-9.]+", "x_m = -3.6", text)
    runs = {
        "inside": build([short], None, Config(), tmp_path / "inside.atlas"),
        "named": build([short], parse_profile(drawn_back, source="a test"), Config(), tmp_path / "named.atlas"),
    }
    names = {key: found.document["runs"][0]["profile"] for key, found in runs.items()}
    assert names == {"inside": "canmet_trailer", "named": "mended"}
    inside, named = (found.trajectories["short"][1] for found in runs.values())
    assert np.abs(inside - named).max() > 0.01  # it was not only the name that was taken


def test_drifts_between_the_same_tags_have_names_of_their_own() -> None:
    names = [drift_suffix(number) for number in range(100)]
    assert names[:3] == ["", "b", "c"]
    assert len(set(names)) == 100


def test_the_same_run_twice_is_refused_before_any_is_read(
    recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(read_log, "read_window", lambda *_, **__: pytest.fail("a recording was read"))
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(recordings[1].read_bytes())  # it still knows which run it is
    for twice, said in (
        ([recordings[1], recordings[1]], r"small-back\.mcap is named twice$"),
        ([recordings[1], copy], r"small-back\.mcap and .*copy\.mcap hold the same time of run small-back; which"),
    ):
        with pytest.raises(BadInputError, match=said):
            build([recordings[0], *twice], None, Config(), tmp_path / "a.atlas")


@pytest.mark.parametrize("run_id", ["../../etc/motd", "..", ""])
def test_a_run_does_not_choose_where_it_is_written(recordings: list[Path], tmp_path: Path, run_id: str) -> None:
    named = rewrite(recordings[1], tmp_path / "a.mcap", lambda m: m.topic == "/rtlog/tick", {"run_id": run_id})
    with pytest.raises(BadInputError, match=r"a\.mcap: the run is called '.*', which no file can be"):
        build([named], None, Config(), tmp_path / "a.atlas")


def test_a_recording_too_short_to_map_is_named(recordings: list[Path], tmp_path: Path) -> None:
    start_ns = read_info(recordings[1]).start_ns
    brief = rewrite(recordings[1], tmp_path / "brief.mcap", lambda m: m.log_time_ns < start_ns + 500_000_000)
    with pytest.raises(BadInputError, match=r"brief\.mcap: \d scans are too few to map"):
        build([brief], None, Config(), tmp_path / "a.atlas")


def test_info_reads_what_build_wrote(atlas: Atlas, small_atlas: Path) -> None:
    assert read_document(small_atlas) == atlas.document

"""`compare` on an atlas in its folder: all right for a moved truth, parts apart, files that are missing or wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hw_profiles.errors import BadInputError
from processing.comparison import compare_relations, compare_truth, table
from processing.geometry import compose, relative, transform
from processing.map_files import to_image, write_image
from processing.occupancy_grid import Grid
from processing.tum import write_tum

MOVES = {"one": np.array([3.0, 4.0, 0.8]), "two": np.array([-40.0, 60.0, -2.0])}  # the true frame in the atlas
WALLS = np.array([[0, -2, 40, -2], [0, 2, 40, 2], [0, -2, 0, 2], [40, -2, 40, 2.0]])
STAMPS = 1_767_592_800 * 10**9 + np.arange(300) * 10**8


def truth_of(run_id: str) -> np.ndarray:
    y = {"one": 0.5, "two": 100.5}[run_id]
    return np.column_stack([np.linspace(2, 38, 300), np.full(300, y), np.zeros(300)])


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """An atlas of two unconnected drifts, each moved rigidly from its truth, and that truth."""
    atlas, truth = tmp_path / "a.atlas", tmp_path / "truth"
    (atlas / "trajectories").mkdir(parents=True)
    truth.mkdir()
    nodes, edges, cells, walls = [], [], [], []
    for part, (run_id, move) in enumerate(MOVES.items()):
        write_tum(truth / f"{run_id}.tum", STAMPS, truth_of(run_id))
        poses = compose(move, truth_of(run_id))
        write_tum(atlas / "trajectories" / f"{run_id}.tum", STAMPS, poses)
        for k, index in enumerate((20, 250)):
            place = dict(zip(("x", "y", "theta"), poses[index].tolist(), strict=True))
            passes = [{"run": run_id, "tick": index, "range": 2.0}]
            node = {"id": 2 * part + k, "epc": f"E{part}{k}", "range": 2.0, "part": part, "passes": passes}
            nodes.append(place | node)
        path = {"run": run_id, "from": 0, "to": 300, "direction": 1}
        common = {"i": 2 * part, "length": None, "part": part, "paths": [path], "links": {"weak": 0, "strong": 0}}
        edges.append(common | {"id": f"{part}", "kind": "edge", "j": 2 * part + 1})
        edges.append(common | {"id": f"{part}-spur", "kind": "spur", "j": None})
        walls.append(WALLS + np.array([0, 100 * part] * 2))
        for x1, y1, x2, y2 in walls[-1]:
            share = np.linspace(0, 1, 2000)[:, None]
            cells.append(transform(move, np.array([[x1, y1]]) + share * [[x2 - x1, y2 - y1]]))
    joined = np.concatenate(cells)
    low = np.floor(joined.min(axis=0) / 0.05)
    columns, rows = (np.floor(joined / 0.05) - low).astype(int).T
    log_odds = np.zeros((rows.max() + 1, columns.max() + 1), dtype=np.float32)
    log_odds[rows, columns] = 3
    write_image(atlas, to_image(Grid(log_odds, 0.05, low * 0.05)))
    listed = [{"id": run_id, "sha256": "", "ticks": 301, "profile": "p"} for run_id in MOVES]
    document = {"schema": 1, "runs": listed, "nodes": nodes, "edges": edges, "remarks": []}
    (atlas / "atlas.json").write_text(json.dumps(document))
    np.savetxt(truth / "walls.csv", np.concatenate(walls), "%.4f", ",", header="x1,y1,x2,y2", comments="")
    (truth / "tags.csv").write_text("epc,x,y\nE00,4.4080,2.5000\n")
    return atlas, truth


def test_a_moved_truth_is_right_in_everything(folders) -> None:
    figures = compare_truth(*folders)["truth"]
    assert (figures["parts"], figures["runs_without_truth"], figures["ate"]["stamps"]) == (2, [], 600)
    assert_allclose(figures["ate_each_part"]["rmse_m"], 0, atol=1e-5)
    assert_allclose([error["translation_rmse_m"] for error in figures["rpe"]], [0], atol=1e-5)  # 36 m hold no 100 m
    assert_allclose([figures["beacon_error_m"]["max"], figures["edge_length_error_m"]["max"]], 0, atol=1e-5)
    assert_allclose(figures["beacons"][0]["to_tag_m"], 2.0, atol=1e-3)
    assert (figures["beacon_error_m"]["count"], figures["edge_length_error_m"]["count"]) == (4, 2)
    assert (figures["walls"]["precision"], figures["walls"]["recall"]) == (1.0, 1.0)
    assert "1.0000 of" in table(json.loads(json.dumps({"truth": figures})))


def test_parts_that_lie_wrongly_to_each_other_are_wrong(folders) -> None:
    """How many parts there are is said first, then the error of the whole, and only then that of each part."""
    atlas, truth = folders
    figures = compare_truth(atlas, truth)["truth"]
    assert_allclose(figures["largest_part_share"], 0.5, atol=1e-6)
    assert figures["ate"]["rmse_m"] > 10
    assert max(error["rmse_m"] for error in figures["ate_of_runs"].values()) > 10
    first, second, *others = table({"truth": figures}).splitlines()
    assert first.endswith("2; the largest holds 50.0 % of the way driven")
    assert second.startswith("absolute trajectory error")
    assert f"{figures['ate']['rmse_m']:.4f} m" in second
    assert any(line.startswith("  each part for itself") and "0.0000 m" in line for line in others)
    assert any(line.startswith("beacons and walls") and "each part aligned for itself" in line for line in others)


def test_parts_that_lie_as_they_should_are_right(folders) -> None:
    atlas, truth = folders
    for run_id in MOVES:
        write_tum(atlas / "trajectories" / f"{run_id}.tum", STAMPS, compose(MOVES["one"], truth_of(run_id)))
    figures = compare_truth(atlas, truth)["truth"]
    assert figures["parts"] == 2
    assert_allclose(figures["ate"]["rmse_m"], 0, atol=1e-5)


def test_the_table_of_a_whole_map_speaks_of_no_parts(folders) -> None:
    atlas, truth = folders
    document = json.loads((atlas / "atlas.json").read_text())
    for edge in document["edges"]:
        edge["part"] = 0
    (atlas / "atlas.json").write_text(json.dumps(document))
    figures = compare_truth(atlas, truth)["truth"]
    assert figures["ate"] == figures["ate_each_part"]
    first, *others = table({"truth": figures}).splitlines()
    assert first.endswith("1; the largest holds 100.0 % of the way driven")
    assert not any("each part" in line for line in others)


def test_a_wrong_map_shows(folders) -> None:
    atlas, truth = folders
    poses = compose(MOVES["one"], truth_of("one") * [1.02, 1, 1])
    write_tum(atlas / "trajectories" / "one.tum", STAMPS, poses)
    figures = compare_truth(atlas, truth)["truth"]
    # one of two drives of 36 m stretched by 2 % about its middle: uniform between ±0.36 m
    assert_allclose(figures["ate_each_part"]["rmse_m"], 0.36 / np.sqrt(3) / np.sqrt(2), rtol=0.01)
    assert_allclose(
        figures["rpe"][0]["translation_rmse_m"], 0.2 / np.sqrt(2), rtol=0.02
    )  # pairs end a step of 0.12 m late


def test_what_the_truth_lacks_is_told(folders) -> None:
    atlas, truth = folders
    for name in ("two.tum", "walls.csv", "tags.csv"):
        (truth / name).unlink()
    figures = compare_truth(atlas, truth)["truth"]
    assert (figures["runs_without_truth"], figures["walls"], figures["beacons"][0]["to_tag_m"]) == (["two"], None, None)
    assert figures["beacon_error_m"]["count"] == 2
    assert (figures["parts"], figures["ate"]["stamps"]) == (2, 300)
    assert_allclose(figures["largest_part_share"], 0.5, atol=1e-6)
    assert "two" in table({"truth": figures})


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("walls.csv", "x1,y1,x2,y2\n1,2,3\n", "walls.csv, line 2"),
        ("walls.csv", "x1,y1,x2,y2\n1,2,3,nan\n", "walls.csv, line 2"),
        ("walls.csv", "x1,y1,x2,y2\n", "holds no wall"),
        ("walls.csv", "1,2,3,4\n", "header must be"),
        ("tags.csv", "epc,x,y\nE0,1,b\n", "tags.csv, line 2.*'b'"),
        ("one.tum", "", "holds no pose"),
        ("one.tum", "1 2 3\n", "line 1"),
    ],
)
def test_bad_truth_is_refused(folders, name: str, text: str, complaint: str) -> None:
    atlas, truth = folders
    (truth / name).write_text(text)
    with pytest.raises(BadInputError, match=complaint):
        compare_truth(atlas, truth)


def test_truth_of_another_time_or_none_is_refused(folders, tmp_path: Path) -> None:
    atlas, truth = folders
    for run_id in MOVES:
        write_tum(truth / f"{run_id}.tum", STAMPS + 10**15, truth_of(run_id))
    with pytest.raises(BadInputError, match="no truth of one, two"):
        compare_truth(atlas, truth)
    with pytest.raises(BadInputError, match="no truth of one, two"):
        compare_truth(atlas, tmp_path / "nowhere")


def test_relations(folders, tmp_path: Path) -> None:
    atlas, _ = folders
    poses = truth_of("one")
    motion = relative(poses[10], poses[200]) - [0.3, 0, 0]
    ends = [f"{ns // 10**9}.{ns % 10**9 // 1000:06d}" for ns in STAMPS[[10, 200]].tolist()]
    (tmp_path / "a.relations").write_text(f"{' '.join(ends)} {motion[0]} {motion[1]} 0 0 0 {motion[2]}\n")
    write_tum(atlas / "trajectories" / "two.tum", STAMPS - 10**15, truth_of("two"))  # no two runs share their time
    figures = compare_relations(atlas, tmp_path / "a.relations")
    assert_allclose(figures["relations"]["translation_mean_m"], 0.3, atol=1e-5)
    assert table(figures).startswith("1 relations: 0.3000 ± 0.0000 m")

"""The atlas on disk: what the contract says is in it, and that it is there whole or not at all."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image
from scipy.spatial import cKDTree

from hw_profiles.errors import BadInputError, RTLogError
from processing.atlas import Atlas, read_document, write_atlas
from processing.edge_files import write_npz
from processing.geometry import compose, relative, transform
from processing.map_files import FREE, MapImage, read_map
from processing.output import refuse_existing
from processing.tum import read_tum
from processing.workers import Workers
from rtlog_client.log_file import read_info

RUNS = [{"id": run_id, "sha256": "", "ticks": 3, "profile": "p"} for run_id in ("monday", "tuesday")]
PATHS = [{"run": "monday", "from": 0, "to": 2, "direction": 1}]
EDGE = {"id": "0-1", "kind": "edge", "i": 0, "j": 1, "length": 4.0, "part": 0}
EDGE |= {"links": {"weak": 2, "strong": 0}, "paths": PATHS}
PASSES = [{"run": "monday", "tick": 2, "range": 2.0}]
NODES = [
    {"id": k, "epc": f"E20{k}", "x": 4.0 * k, "y": 0.0, "theta": 0.0, "range": 2.0, "part": 0, "passes": PASSES}
    for k in range(2)
]
DOCUMENT = {"schema": 1, "runs": RUNS, "nodes": NODES, "edges": [EDGE], "remarks": ["Grüße"]}


def tiny_atlas(**changes: Any) -> Atlas:
    parts: dict[str, Any] = {
        "document": DOCUMENT,
        "trajectories": {"monday": (np.arange(3), np.zeros((3, 3))), "tuesday": (np.arange(2), np.ones((2, 3)))},
    }
    return Atlas(**(parts | changes))


def write_tiny(path: Path, **changes: Any) -> None:
    """Write it, with one edge and an image."""
    with tempfile.TemporaryDirectory() as scratch:
        edge = Path(scratch) / "0-1.npz"
        write_npz(edge, {"poses": np.zeros((3, 3))})
        image = MapImage(np.full((20, 50), FREE, np.uint8), 0.1, np.array([-0.5, -1.0]))
        write_atlas(path, tiny_atlas(**changes), [edge], image, Workers(1))


def contents(folder: Path) -> dict[str, bytes | None]:
    """Everything below a folder."""
    paths = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in paths}


def test_an_atlas_is_a_folder(tmp_path: Path) -> None:
    write_tiny(tmp_path / "a.atlas")
    assert [path.name for path in tmp_path.iterdir()] == ["a.atlas"]
    assert list(contents(tmp_path / "a.atlas")) == [
        "atlas.json",
        "edges",
        "edges/0-1.npz",
        "map.pgm",
        "map.png",
        "map.yaml",
        "trajectories",
        "trajectories/monday.tum",
        "trajectories/tuesday.tum",
    ]
    assert (tmp_path / "a.atlas").stat().st_mode & 0o777 == 0o755
    assert read_document(tmp_path / "a.atlas") == tiny_atlas().document


def test_the_same_atlas_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.atlas", "b.atlas"):
        write_tiny(tmp_path / name)
    assert contents(tmp_path / "a.atlas") == contents(tmp_path / "b.atlas")


def test_what_exists_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    write_tiny(tmp_path / "a.atlas")
    (tmp_path / "file.atlas").write_text("dear to someone")
    (tmp_path / "empty.atlas").mkdir()
    (tmp_path / "dangling.atlas").symlink_to(tmp_path / "nowhere")
    before = contents(tmp_path)
    for name in ("a.atlas", "file.atlas", "empty.atlas", "dangling.atlas"):
        with pytest.raises(BadInputError, match=rf"{name} exists already; it is left as it is$"):
            write_tiny(tmp_path / name, document={"schema": 1, "nodes": [], "edges": []})
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("none/a.atlas", "none: no such folder"),
        ("file/a.atlas", "file: no such folder"),
        ("x" * 300, "File name too long"),
    ],
)
def test_a_place_that_cannot_be_is_refused(tmp_path: Path, name: str, complaint: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BadInputError, match=complaint):
        refuse_existing(tmp_path / name)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_closed_folder_is_refused_before_the_work(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    with pytest.raises(BadInputError, match="no permission to write"):
        refuse_existing(tmp_path / "a.atlas")


class Interrupted(dict[str, Any]):
    """Trajectories whose writing ends after the first."""

    def items(self) -> Iterator[Any]:  # type: ignore[override]
        yield from list(super().items())[:1]
        raise KeyboardInterrupt


def test_an_interrupt_midway_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_tiny(tmp_path / "a.atlas", trajectories=Interrupted(tiny_atlas().trajectories))
    assert not list(tmp_path.iterdir())


WRITER = """
import resource, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_atlas import tiny_atlas, write_tiny

class Halting(dict):
    def items(self):
        yield from list(super().items())[:1]
        print("half", flush=True)
        time.sleep(60)

if sys.argv[3] == "full":
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))  # as a full disk, a write fails midway
    write_tiny(Path(sys.argv[1]))
else:
    write_tiny(Path(sys.argv[1]), trajectories=Halting(tiny_atlas().trajectories))
"""


def test_a_kill_midway_leaves_no_half_atlas(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITER, tmp_path / "a.atlas", Path(__file__).parent, "halt"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "half\n"
        assert not (tmp_path / "a.atlas").exists()
        [part] = tmp_path.iterdir()
        assert list((part / "edges").iterdir())  # it was indeed under way
        writer.send_signal(signal.SIGKILL)
    assert not (tmp_path / "a.atlas").exists()
    write_tiny(tmp_path / "a.atlas")  # what the kill left is in nobody's way


def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITER, tmp_path / "a.atlas", Path(__file__).parent, "full"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    last_line = result.stderr.splitlines()[-1]
    assert last_line == f"{RTLogError.__module__}.RTLogError: {tmp_path}/a.atlas: cannot be written: File too large"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (None, "no atlas here"),
        ("", "not JSON"),
        ('{"schema": 1', "not JSON"),
        ("[1]", "schema is not 1"),
        ('{"schema": 2}', "schema is not 1; another version"),
    ],
)
def test_what_is_no_atlas_is_refused(tmp_path: Path, text: str | None, complaint: str) -> None:
    if text is not None:
        (tmp_path / "atlas.json").write_text(text)
    with pytest.raises(BadInputError, match=complaint):
        read_document(tmp_path)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"nodes": [NODES[0], {"id": 1}]}, r"missing required field `epc` at `nodes\[1\]`"),
        ({"remarks": None}, r"Expected `array`, got `null` at `remarks`"),
        (
            {"edges": [EDGE | {"paths": [{"run": "monday"}]}]},
            r"missing required field `from` at `edges\[0\]\.paths\[0\]`",
        ),
        ({"edges": [EDGE | {"kind": "bow"}]}, r"Invalid enum value 'bow'"),
        ({"edges": [EDGE | {"j": 2}]}, "edge 0-1 ends at a node that is not there"),
        (
            {"convictions": [{"run": "monday", "ticks": [3], "what": "wheels", "how_much": "slip"}]},
            r"Expected `array` of length 2, got 1 at `convictions\[0\]\.ticks`",
        ),
        ({"runs": RUNS[1:]}, "edge 0-1 holds a path of monday, which is no run of it"),
    ],
)
def test_what_is_missing_in_an_atlas_is_named(tmp_path: Path, changes: dict[str, Any], complaint: str) -> None:
    (tmp_path / "atlas.json").write_text(json.dumps(DOCUMENT | changes))
    with pytest.raises(BadInputError, match=rf"atlas\.json: .*{complaint}"):
        read_document(tmp_path)


# The contract, on the atlas of the small mine.


def test_atlas_json_has_what_the_contract_says(small_atlas: Path, small_world: Path) -> None:
    document = json.loads((small_atlas / "atlas.json").read_text(encoding="utf-8"))
    assert document["schema"] == 1
    assert document["software"].startswith("rtlog ")
    assert document["parameters"]["method"] == "landmark"
    assert document["parameters"]["matcher"] == "point-to-line"
    assert [run["id"] for run in document["runs"]] == ["small-around", "small-back"]
    for run in document["runs"]:
        recording = small_world / f"{run['id']}.mcap"
        digest = subprocess.run(["sha256sum", recording], capture_output=True, text=True, check=True).stdout.split()[0]
        assert run["sha256"] == digest
        assert run["ticks"] == read_info(recording).message_counts["/rtlog/tick"]
    assert [node["id"] for node in document["nodes"]] == [0, 1, 2, 3]
    assert [node["epc"][-3:] for node in document["nodes"]] == ["401", "402", "403", "404"]
    for node in document["nodes"]:
        assert all(isinstance(node[key], float) for key in ("x", "y", "theta", "range"))
        assert node["passes"]
        assert {key for each in node["passes"] for key in each} == {"run", "tick", "range", "read"}
    assert {(edge["i"], edge["j"]) for edge in document["edges"]} == {
        *((0, 1), (1, 2), (2, 3), (0, 3)),
        *((0, None), (1, None)),
    }
    for edge in document["edges"]:
        assert isinstance(edge["id"], str)
        assert (edge["length"] is None) == (edge["j"] is None)
        for path in edge["paths"]:
            assert set(path) == {"run", "from", "to", "direction"}


def test_lengths_and_nodes_are_those_of_the_mine(small_atlas: Path) -> None:
    document = read_document(small_atlas)
    at = np.array([[node["x"], node["y"]] for node in document["nodes"]])
    tags = np.array([[29, 1.8], [41.8, 16], [20, 28.2], [-1.8, 14]])
    for edge in document["edges"]:
        if edge["j"] is not None:
            i, j = edge["i"], edge["j"]
            assert edge["length"] == pytest.approx(np.hypot(*(at[j] - at[i])), abs=2e-6)
            assert edge["length"] == pytest.approx(np.hypot(*(tags[j] - tags[i])), abs=4.0)  # a pass is near its tag
    for node in document["nodes"]:
        assert 1.0 < node["range"] < 3.5  # the tags are read within 3 m


def test_every_edge_has_its_arrays(small_atlas: Path) -> None:
    document = read_document(small_atlas)
    names = [edge["id"] for edge in document["edges"]]
    assert {f"{name}.npz" for name in names} == {path.name for path in (small_atlas / "edges").iterdir()}
    for edge in document["edges"]:
        with np.load(small_atlas / "edges" / f"{edge['id']}.npz") as arrays:
            count = edge["poses"]
            assert arrays["poses"].shape == (count, 3)
            assert arrays["covariances"].shape == (count, 3, 3)
            assert_allclose(arrays["covariances"], arrays["covariances"].swapaxes(1, 2), atol=1e-12)
            assert np.linalg.eigvalsh(arrays["covariances"]).min() > -1e-12
            links = len(arrays["link_ends"])
            assert arrays["link_motions"].shape == (links, 3)
            assert arrays["link_informations"].shape == (links, 3, 3)
            assert arrays["link_ends"].min() >= 0
            assert arrays["link_ends"].max() < count
            strong = arrays["link_strong"]
            assert edge["links"] == {"weak": int((~strong).sum()), "strong": int(strong.sum())}
            doubt = np.linalg.inv(arrays["link_informations"][strong])[:, :2, :2]
            assert np.linalg.eigvalsh(doubt)[:, 0].max() < 0.5**2  # a match of scans knows better than a tag
            assert_allclose(  # the poses fit the links that they come from
                relative(*(arrays["poses"][arrays["link_ends"][strong][:, k]] for k in (0, 1)))[:, :2],
                arrays["link_motions"][strong][:, :2],
                atol=0.3,
            )
            assert arrays["path_firsts"].tolist()[0] == 0
            assert len(arrays["path_firsts"]) == len(edge["paths"]) + 1
            assert arrays["path_firsts"].tolist()[-1] == count
            assert arrays["ticks"].shape == (count,)
            for k, path in enumerate(edge["paths"]):
                ticks = arrays["ticks"][slice(*arrays["path_firsts"][k : k + 2])]
                assert (ticks[0], ticks[-1]) == (path["from"], path["to"])
                assert np.all(np.diff(ticks) > 0)
            assert arrays["grid_log_odds"].ndim == 2
            assert arrays["grid_resolution"] == 0.05
            assert arrays["grid_origin"].shape == (2,)


def test_an_edge_frame_lies_at_its_origin_and_points_at_its_end(small_atlas: Path) -> None:
    document = read_document(small_atlas)
    at = np.array([[node["x"], node["y"]] for node in document["nodes"]])
    for edge in document["edges"]:
        if edge["j"] is None:
            continue
        ahead = compose(np.array(edge["frame"]), np.array([edge["length"], 0.0, 0.0]))
        assert_allclose(edge["frame"][:2], at[edge["i"]], atol=1e-6)
        assert_allclose(ahead[:2], at[edge["j"]], atol=1e-4)


def test_the_walls_of_the_grids_are_those_of_the_map(small_atlas: Path) -> None:
    image = read_map(small_atlas)
    walls = cKDTree(image.occupied_points())
    for edge in read_document(small_atlas)["edges"]:
        with np.load(small_atlas / "edges" / f"{edge['id']}.npz") as arrays:
            rows, columns = np.nonzero(arrays["grid_log_odds"] > 3)
            resolution = float(arrays["grid_resolution"])
            local = arrays["grid_origin"] + resolution * (np.column_stack([columns, rows]) + 0.5)
        distances, _ = walls.query(transform(np.array(edge["frame"]), local))
        assert np.quantile(distances, 0.99) < 2 * resolution


def test_the_map_is_no_larger_than_what_is_known(small_atlas: Path) -> None:
    image = read_map(small_atlas)
    sizes = sorted(image.resolution_m * np.array(image.pixels.shape))
    assert sizes == pytest.approx([35.0, 45.0], abs=1.5)  # the drifts of a loop of 40 × 30 m


def test_the_picture_opens(small_atlas: Path) -> None:
    with Image.open(small_atlas / "map.png") as picture:
        picture.load()
        assert picture.mode == "RGB"
    with Image.open(small_atlas / "map.pgm") as picture:
        assert picture.size == read_map(small_atlas).pixels.shape[::-1]


def test_trajectories_are_named_for_their_runs(small_atlas: Path) -> None:
    paths = sorted((small_atlas / "trajectories").iterdir())
    assert [path.name for path in paths] == ["small-around.tum", "small-back.tum"]
    for path in paths:
        stamps, poses = read_tum(path)
        assert np.all(np.diff(stamps) > 0)
        assert np.isfinite(poses).all()

"""A small mine: a loop of 40 × 30 m with four tags, driven by two runs, once around and back the other way."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from processing.edge_placement import Placed
from processing.geometry import align, compose
from processing.graph import Graph, build_graph
from processing.pieces import SolvedPiece, solve_piece
from processing.pipeline import DrivenRun, drive_through, piece_input, piece_names
from processing.read_log import begin_reading
from processing.ready_runs import make_ready
from processing.scan_matching import match_scans
from processing.simulation.simulate import simulate
from processing.tum import read_tum
from processing.workers import Workers

sys.path.insert(0, str(Path(__file__).parent))  # the helpers beside the tests

SMALL_WORLD = """
schema = 1
name = "small"
seed = 4
profile = "canmet_trailer"
walls.roughness_m = 0.2

[places]
start = [8, 0]
sw = [0, 0]
se = [40, 0]
ne = [40, 30]
nw = [0, 30]
bay = [20, 12]
bay_mouth = [20, 0]

[[drifts]]
points = ["sw", "start", "bay_mouth", "se", "ne", "nw", "sw"]
width_m = 4.6
[[drifts]] # a dead end
points = ["bay_mouth", "bay"]
width_m = 4.6

[[tags]]
epc = "E20034120000000000000401"
at = [29, 1.8]
[[tags]]
epc = "E20034120000000000000402"
at = [41.8, 16]
[[tags]]
epc = "E20034120000000000000403"
at = [20, 28.2]
[[tags]]
epc = "E20034120000000000000404"
at = [-1.8, 14]

[[runs]] # once around, and on to the second tag
name = "around"
waypoints = ["start", "se", "ne", "nw", "sw", "se", [40, 23]]
speed_m_s = 3.0
[[runs]] # the other way, past the first tag and back to it
name = "back"
waypoints = [[32, 30], "ne", "se", "bay_mouth", "se", [40, 8]]
speed_m_s = 3.0

[noise]
wheel_radius_error_percent = { left_wheel = 1.0, right_wheel = 0.8 }
slip_m_per_sqrt_m = 0.005
"""


@pytest.fixture(scope="session")
def small_world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `rtlog-atlas simulate` writes of the small mine: small-around.mcap, small-back.mcap and the truth."""
    folder = tmp_path_factory.mktemp("small_world")
    (folder / "small.toml").write_text(SMALL_WORLD, encoding="utf-8")
    simulate(folder / "small.toml", folder / "small")
    return folder / "small"


@pytest.fixture(scope="session")
def small_atlas(small_world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small mine as the program itself maps it, in two processes."""
    atlas = tmp_path_factory.mktemp("small_atlas") / "small.atlas"
    recordings = [small_world / "small-around.mcap", small_world / "small-back.mcap"]
    command = [sys.executable, "-m", "processing.cli", "build", *recordings, "-o", atlas, "--jobs", "2"]
    subprocess.run(command, check=True, capture_output=True)
    return atlas


def drive_both(world: Path) -> list[DrivenRun]:
    recordings = [world / f"small-{run}.mcap" for run in ("around", "back")]
    runs = begin_reading(recordings, None, world, Workers(1))()
    return drive_through(make_ready(runs, with_tags=True, work=Workers(1)), Workers(1), match_scans)


@pytest.fixture(scope="session")
def driven(small_world: Path) -> list[DrivenRun]:
    """Both runs of the small mine, open loop. Leave them as they are."""
    return drive_both(small_world)


@pytest.fixture(scope="session")
def driven_clean(small_world: Path, tmp_path_factory: pytest.TempPathFactory) -> list[DrivenRun]:
    """The same drives with perfect sensors."""
    folder = tmp_path_factory.mktemp("clean_world") / "small"
    simulate(small_world / "world.toml", folder, noise=False)
    return drive_both(folder)


@pytest.fixture(scope="session")
def truth(small_world: Path, driven: list[DrivenRun]) -> list[np.ndarray]:
    """The true pose (n, 3) of every scan of both runs, with and without noise."""
    poses = []
    for of in driven:
        stamps, true = read_tum(small_world / f"{of.run.run_id}.tum")
        poses.append(true[np.searchsorted(stamps, of.run.scans.stamps_ns)])
    return poses


def solve_pieces(driven: list[DrivenRun]) -> tuple[Graph, list[SolvedPiece]]:
    graph = build_graph([of.passes for of in driven], [len(of.loop) for of in driven])
    inputs = [piece_input(name, piece, driven) for name, piece in zip(piece_names(graph), graph.pieces, strict=True)]
    return graph, [part for given in inputs for part in solve_piece(given, match_scans)]


@pytest.fixture(scope="session")
def solve_runs() -> Callable[[list[DrivenRun]], tuple[Graph, list[SolvedPiece]]]:
    """solve_runs(driven): the graph of driven runs and its pieces, solved."""
    return solve_pieces


@pytest.fixture(scope="session")
def solved(driven: list[DrivenRun]) -> tuple[Graph, list[SolvedPiece]]:
    """The graph of the small mine and its pieces. Leave them as they are."""
    return solve_pieces(driven)


@pytest.fixture(scope="session")
def true_keyframes(truth: list[np.ndarray]) -> Callable[[SolvedPiece, list[DrivenRun]], np.ndarray]:
    """true_keyframes(piece, driven): the true poses (N, 3) of the piece's key frames."""

    def of_piece(piece: SolvedPiece, driven: list[DrivenRun]) -> np.ndarray:
        pairs = zip(piece.input.piece.spans, piece.input.paths, strict=True)
        return np.concatenate([truth[s.run][driven[s.run].loop.keyframes[path.keyframes]] for s, path in pairs])

    return of_piece


@pytest.fixture(scope="session")
def move_into_world(
    true_keyframes: Callable[[SolvedPiece, list[DrivenRun]], np.ndarray],
) -> Callable[[list[Placed], list[DrivenRun]], tuple[np.ndarray, np.ndarray]]:
    """move_into_world(pieces, driven): the move (3,) of all as one, and how far off (N,) m they are then."""

    def move(pieces: list[Placed], driven: list[DrivenRun]) -> tuple[np.ndarray, np.ndarray]:
        placed = np.concatenate([piece.poses for piece in pieces])
        true = np.concatenate([true_keyframes(piece.solved, driven) for piece in pieces])
        into_world = align(placed[:, :2], true[:, :2])
        return into_world, np.hypot(*(compose(into_world, placed) - true)[:, :2].T)

    return move

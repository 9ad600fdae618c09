"""`rtlog-atlas compare`: an atlas on disk against the truth or against known relations.

In: an atlas; the folder that `simulate` wrote (`<run id>.tum`, `walls.csv`, `tags.csv`), or a file of relations. Out: a
dictionary of plain values for JSON, and the same as a table of text.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from hw_profiles.errors import BadInputError
from processing.atlas import read_document
from processing.consistency import consistency, edge_errors
from processing.evaluation import (
    Beacon,
    Trajectory,
    absolute_error,
    align_parts,
    align_whole,
    beacon_errors,
    distribution,
    edge_length_errors,
    largest_part_share,
    match_truth,
    relative_error,
    true_place,
    way_driven,
)
from processing.geometry import Array, transform
from processing.map_files import read_map
from processing.relations import read_relations, relation_errors
from processing.tum import read_tum
from processing.wall_evaluation import WallScore, score_walls

RELATIVE_DISTANCES_M = (10.0, 100.0)


def compare_truth(atlas: Path, truth: Path) -> dict[str, Any]:
    """The atlas against the truth of its runs; what the truth's folder does not hold is None.

    The trajectories are moved as one rigid body (`ate`, `ate_of_runs`), and each part for itself (`ate_each_part`), as
    are beacons and walls.

    Raises:
        BadInputError: a file is malformed, or no run of the atlas has a truth of the same time.
    """
    document, trajectories = read_document(atlas), read_trajectories(atlas)
    true = {run_id: _read_truth(truth / f"{run_id}.tum") for run_id in trajectories if _has(truth, f"{run_id}.tum")}
    matched = {run_id: match_truth(trajectories[run_id], true[run_id]) for run_id in true}
    runs = {run_id: match for run_id, match in matched.items() if len(match.estimate)}
    if not runs:
        raise BadInputError(f"{truth}: holds no truth of {', '.join(trajectories)} at the time of the recordings")
    parts = {path["run"]: edge["part"] for edge in document["edges"] for path in edge["paths"]}
    whole, moves = align_whole(runs, parts), align_parts(runs, parts)
    ways_m = {
        run_id: way_driven(runs[run_id].truth if run_id in runs else of.poses) for run_id, of in trajectories.items()
    }
    beacons = [
        Beacon(n["epc"], np.array([n["x"], n["y"]]), n["part"], [p["run"] for p in n["passes"]])
        for n in document["nodes"]
    ]
    places = np.array([true_place(beacon, runs) for beacon in beacons]).reshape(-1, 2)
    edges = [(edge["i"], edge["j"]) for edge in document["edges"] if edge["j"] is not None]
    at_beacons = beacon_errors(
        beacons, places, moves, _read_tags(truth / "tags.csv") if _has(truth, "tags.csv") else {}
    )
    walls = _compare_walls(atlas, truth / "walls.csv", runs, parts, moves) if _has(truth, "walls.csv") else None
    stated = {run_id: (true[run_id].stamps_ns, true[run_id].poses) for run_id in runs}
    relatives = [relative_error(runs, distance_m) for distance_m in RELATIVE_DISTANCES_M]
    figures: dict[str, Any] = {
        "parts": len(set(parts.values())),
        "largest_part_share": largest_part_share(ways_m, parts),
        "runs_without_truth": sorted(set(trajectories) - set(runs)),
        "ate": asdict(absolute_error(runs, parts, whole)),
        "ate_of_runs": {run_id: asdict(absolute_error({run_id: runs[run_id]}, parts, whole)) for run_id in runs},
        "ate_each_part": asdict(absolute_error(runs, parts, moves)),
        "rpe": [asdict(error) for error in relatives if error is not None],
        "beacon_error_m": _plain(distribution(np.array([error.error_m for error in at_beacons]))),
        "beacons": [asdict(error) for error in at_beacons],
        "edge_length_error_m": _plain(distribution(edge_length_errors(beacons, places, edges))),
        "nees": _plain(consistency(edge_errors(atlas, document["edges"], stated))),
        "walls": _plain(walls),
    }
    return {"truth": figures}


def compare_relations(atlas: Path, file: Path) -> dict[str, Any]:
    """The atlas against relations. Its trajectories hold every stamp of the odometry, so nothing need be carried.

    Raises:
        BadInputError: a file is malformed, or the relations belong to another recording.
    """
    runs = read_trajectories(atlas).values()
    stamps_ns = np.concatenate([run.stamps_ns for run in runs])
    poses = np.concatenate([run.poses for run in runs])
    return {"relations": asdict(relation_errors(stamps_ns, poses, read_relations(file), stamps_ns, poses))}


def read_trajectories(atlas: Path) -> dict[str, Trajectory]:
    """By run id. Raises: BadInputError: one is missing, empty or malformed."""
    run_ids = [run["id"] for run in read_document(atlas)["runs"]]
    return {run_id: _read_truth(atlas / "trajectories" / f"{run_id}.tum") for run_id in run_ids}


def table(figures: dict[str, Any]) -> str:
    """The figures as lines for people."""
    lines = []
    if truth := figures.get("truth"):
        ate, several, rows = truth["ate"], truth["parts"] > 1, []
        share = f"{truth['parts']}; the largest holds {100 * truth['largest_part_share']:.1f} % of the way driven"
        rows.append(("connected parts", share))
        rows.append(("absolute trajectory error", f"{ate['rmse_m']:.4f} m rmse, {ate['max_m']:.4f} m at most"))
        rows += [(f"  {run}", f"{error['rmse_m']:.4f} m") for run, error in truth["ate_of_runs"].items()]
        rows.append(("  heading", f"{ate['heading_rmse_deg']:.3f}° rmse"))
        if several:
            each = truth["ate_each_part"]
            figure = f"{each['rmse_m']:.4f} m rmse, {each['max_m']:.4f} m at most: not where the parts lie"
            rows.append(("  each part for itself", figure))
        for error in truth["rpe"]:
            figure = f"{error['translation_rmse_m']:.4f} m, {error['rotation_rmse_deg']:.3f}° rmse"
            rows.append((f"relative error over {error['distance_m']:g} m", figure))
        rows.append(("beacon position error", _spread(truth["beacon_error_m"], "beacons")))
        away = [beacon["to_tag_m"] for beacon in truth["beacons"] if beacon["to_tag_m"] is not None]
        if away:  # no error: a beacon is the place on the road from which the tag was read
            rows.append(("  from beacon to tag", f"{np.mean(away):.2f} m in the mean, {max(away):.2f} m at most"))
        rows.append(("edge length error", _spread(truth["edge_length_error_m"], "edges")))
        if nees := truth["nees"]:
            band = (
                f"3 were right; of {nees['edges']} edges {nees['band'][0]:.2f} to {nees['band'][1]:.2f} may be chance"
            )
            rows.append(("error² over covariance, NEES", f"{nees['mean_nees']:.2f} in the mean; {band}"))
        if walls := truth["walls"]:
            rows.append(("wall cells: precision", f"{walls['precision']:.4f} of {walls['occupied_cells']} drawn"))
            rows.append(("wall cells: recall", f"{walls['recall']:.4f} of {walls['seen_cells']} seen"))
        rows.append(("poses compared", f"{ate['stamps']}, and {ate['uncounted']} outside the truth's time"))
        if several:
            rows.append(("beacons and walls", "each part aligned for itself"))
        rows += [("no truth of run", run_id) for run_id in truth["runs_without_truth"]]
        lines += [f"{name:28} {value}" for name, value in rows]
    if relations := figures.get("relations"):
        lines.append(
            f"{relations['relations']} relations: "
            f"{relations['translation_mean_m']:.4f} ± {relations['translation_std_m']:.4f} m, "
            f"{relations['rotation_mean_deg']:.3f} ± {relations['rotation_std_deg']:.3f}°"
        )
    return "\n".join(lines)


def _compare_walls(
    atlas: Path, file: Path, runs: dict[str, Any], parts: dict[str, int], moves: dict[int, Array]
) -> WallScore:
    """The stitched map against the walls. A cell belongs to the part whose trajectory is nearest, and moves with it."""
    occupied = read_map(atlas).occupied_points()
    _, nearest = cKDTree(np.concatenate([run.estimate[:, :2] for run in runs.values()])).query(occupied)
    owners = np.concatenate([np.full(len(run.estimate), parts[run_id]) for run_id, run in runs.items()])[nearest]
    for part, move in moves.items():
        occupied[owners == part] = transform(move, occupied[owners == part])
    walls = np.array([[float(word) for word in row] for row in _read_csv(file, "x1,y1,x2,y2")])
    if not len(walls):
        raise BadInputError(f"{file}: holds no wall")
    return score_walls(occupied, walls, [run.truth for run in runs.values()])


def _has(folder: Path, name: str) -> bool:
    return (folder / name).is_file()


def _read_truth(path: Path) -> Trajectory:
    stamps_ns, poses = read_tum(path)
    if not len(stamps_ns):
        raise BadInputError(f"{path}: holds no pose")
    order = np.argsort(stamps_ns, kind="stable")
    return Trajectory(stamps_ns[order], poses[order])


def _read_tags(path: Path) -> dict[str, Array]:
    rows = _read_csv(path, "epc,x,y")
    return {row[0]: np.array([float(row[1]), float(row[2])]) for row in rows}


def _read_csv(path: Path, header: str) -> list[list[str]]:
    """The rows under this header, each word but a first `epc` a number. Raises: BadInputError with the line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(f"{path}: {error}") from error
    if not lines or lines[0] != header:
        raise BadInputError(f"{path}, line 1: the header must be {header}")
    rows = [line.split(",") for line in lines[1:]]
    for number, row in enumerate(rows, start=2):
        try:
            numbers = [float(word) for word in row[header.startswith("epc") :]]
        except ValueError as error:
            raise BadInputError(f"{path}, line {number}: {error}") from error
        if len(row) != header.count(",") + 1 or not np.isfinite(numbers).all():
            raise BadInputError(f"{path}, line {number}: {','.join(row)[:60]} is no {header}")
    return rows


def _plain(record: Any) -> dict[str, Any] | None:
    return None if record is None else asdict(record)


def _spread(error: dict[str, Any] | None, of: str) -> str:
    return "-" if error is None else f"{error['rmse']:.4f} m rmse, {error['max']:.4f} m at most, {error['count']} {of}"

"""The atlas: the product, as a folder on disk, written whole or not at all; what is small of it also in memory.

NAME.atlas/atlas.json                what the graph is made of, and from what
NAME.atlas/edges/<id>.npz            poses, covariances, links and grid of every piece, in its own frame
NAME.atlas/trajectories/<run>.tum    t x y z qx qy qz qw of every stamp with odometry or a scan, in the atlas frame
NAME.atlas/map.pgm, .yaml, .png      the stitched picture: a view of the atlas, not the atlas
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError, RTLogError
from processing.atlas_schema import check_document
from processing.map_files import MapImage, Overlay, StoredImage, write_image, write_picture
from processing.output import refuse_existing
from processing.tum import write_tum
from processing.workers import Workers

Array = NDArray[np.float64]

SCHEMA = 1


@dataclass(frozen=True, slots=True)
class Atlas:
    document: dict[str, Any]  # what atlas.json holds
    trajectories: dict[str, tuple[NDArray[np.int64], Array]]  # by run id: stamps [ns], poses (m, 3)


def write_atlas(path: Path, atlas: Atlas, edges: Sequence[Path], image: MapImage | StoredImage, work: Workers) -> None:
    """Write the folder beside its place, and move it there once it is whole. The files of the edges are moved into it.

    Raises:
        BadInputError: there is something at `path` already.
        RTLogError: the disk is full, or will not have it for another reason.
    """
    refuse_existing(path)
    try:
        part = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            part.chmod(0o755)
            _write_files(part, atlas, edges, image, work)
            part.rename(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)  # after the renaming, nothing is there
    except OSError as error:
        raise RTLogError(f"{path}: cannot be written: {error.strerror or error}") from error


def _write_files(
    folder: Path, atlas: Atlas, edges: Sequence[Path], image: MapImage | StoredImage, work: Workers
) -> None:
    (folder / "edges").mkdir()
    (folder / "trajectories").mkdir()
    for edge in edges:
        shutil.move(edge, folder / "edges" / edge.name)
    writing: list[Callable[[], None]] = [
        partial(write_tum, folder / "trajectories" / f"{run_id}.tum", stamps_ns, poses)
        for run_id, (stamps_ns, poses) in atlas.trajectories.items()
    ]
    writing += [partial(write_picture, folder, image, _overlay(atlas)), partial(write_image, folder, image)]
    work.map("files", _call, writing)
    text = json.dumps(atlas.document, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / "atlas.json").write_text(text + "\n", encoding="utf-8")


def _call(function: Callable[[], None]) -> None:
    function()


def read_document(path: Path) -> dict[str, Any]:
    """What atlas.json holds. Raises: BadInputError: there is no atlas, one of another schema, or a damaged one."""
    try:
        document = json.loads((path / "atlas.json").read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInputError(f"{path}: no atlas here ({error.strerror or error})") from error
    except ValueError as error:
        raise BadInputError(f"{path}/atlas.json: not JSON: {error}") from error
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise BadInputError(f"{path}/atlas.json: schema is not {SCHEMA}; another version of rtlog-atlas wrote it")
    check_document(document, f"{path}/atlas.json")
    return document


def _overlay(atlas: Atlas) -> Overlay:
    at = np.array([[node["x"], node["y"]] for node in atlas.document["nodes"]]).reshape(-1, 2)
    ends = [[edge["i"], edge["j"]] for edge in atlas.document["edges"] if edge["j"] is not None]
    return Overlay(
        nodes=at,
        names=[node["epc"][-4:] for node in atlas.document["nodes"]],
        edges=at[np.array(ends, np.int64).reshape(-1, 2)],
        trajectories=[poses[:, :2] for _, poses in atlas.trajectories.values()],
    )

"""A map goes to disk as nav2 wants it and comes back; a picture shows the walls even when it is shrunk."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from hw_profiles.errors import BadInputError
from processing.map_files import (
    FREE,
    MARGIN_PIXELS,
    OCCUPIED,
    UNKNOWN,
    WALL,
    MapImage,
    Overlay,
    draw_map,
    read_map,
    stitch_image,
    to_image,
    write_image,
    write_picture,
)
from processing.occupancy_grid import Grid, store_grid
from processing.stitching import stitch
from processing.workers import Workers


@pytest.fixture
def grid() -> Grid:
    log_odds = np.zeros((30, 50), dtype=np.float32)
    log_odds[5:25, 5:40] = -2
    log_odds[5, 5:40] = 3  # the wall at the smallest y
    log_odds[24, 39] = 0.85  # one hit is no wall
    return Grid(log_odds, 0.05, np.array([-1.25, 3.0]))


def test_what_is_written_is_what_nav2_reads(tmp_path: Path, grid: Grid) -> None:
    write_image(tmp_path, to_image(grid))
    data = (tmp_path / "map.pgm").read_bytes()
    assert data.startswith(b"P5\n50 30\n255\n")
    assert len(data) == 13 + 50 * 30
    picture = np.asarray(Image.open(tmp_path / "map.pgm"))
    assert (picture[24, 10], picture[10, 10], picture[0, 0], picture[5, 39]) == (0, 254, 205, 205)
    lines = (tmp_path / "map.yaml").read_text().splitlines()
    assert {"image: map.pgm", "resolution: 0.05", "origin: [-1.25, 3.0, 0.0]", "negate: 0"} <= set(lines)


def test_round_trip(tmp_path: Path, grid: Grid) -> None:
    write_image(tmp_path, to_image(grid))
    back = read_map(tmp_path)
    assert_array_equal(back.pixels, to_image(grid).pixels)
    assert (back.resolution_m, *back.origin) == (0.05, -1.25, 3.0)
    points = back.occupied_points()
    assert len(points) == 35
    assert_allclose(points[:, 1], 3.0 + 5.5 * 0.05)
    assert_allclose(points[0, 0], -1.25 + 5.5 * 0.05)


def test_same_grid_same_bytes(tmp_path: Path, grid: Grid) -> None:
    overlay = Overlay(
        np.array([[-1.0, 3.5]]), ["E200"], np.array([[[-1.0, 3.5], [0.0, 4.0]]]), [np.array([[0, 3.5]] * 2)]
    )
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_image(tmp_path / name, to_image(grid))
        write_picture(tmp_path / name, to_image(grid), overlay)
    for file in ("map.pgm", "map.yaml", "map.png"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_empty_grid_is_written(tmp_path: Path) -> None:
    write_image(tmp_path, to_image(Grid(np.zeros((0, 0), dtype=np.float32), 0.05, np.zeros(2))))
    assert read_map(tmp_path).pixels.tolist() == [[UNKNOWN]]


def test_shrunk_pictures_keep_thin_walls() -> None:
    pixels = np.full((9001, 200), FREE, dtype=np.uint8)
    pixels[4321] = OCCUPIED
    picture = np.asarray(draw_map(MapImage(pixels, 0.05, np.zeros(2)), Overlay()))
    assert picture.shape[0] == 9001 // 3 + 1 + 2 * MARGIN_PIXELS
    rows = np.flatnonzero((picture[:, MARGIN_PIXELS + 30] == WALL).all(axis=1))
    assert_array_equal(rows, [picture.shape[0] - 1 - MARGIN_PIXELS - 4321 // 3])


def test_nodes_are_drawn_where_they_are() -> None:
    pixels = np.full((100, 100), FREE, dtype=np.uint8)
    plain = np.asarray(draw_map(MapImage(pixels, 0.05, np.array([10.0, 20.0])), Overlay())).astype(int)
    with_node = draw_map(MapImage(pixels, 0.05, np.array([10.0, 20.0])), Overlay(np.array([[11.0, 24.0]]), [""]))
    rows, columns = np.nonzero(np.abs(np.asarray(with_node).astype(int) - plain).sum(axis=2))
    assert_allclose([columns.mean(), rows.mean()], [MARGIN_PIXELS + 240, MARGIN_PIXELS + 240], atol=1)


@pytest.mark.parametrize("x", [12.0, 100.0, 209.5])
def test_names_are_whole_also_at_the_rim(x: float) -> None:
    image = MapImage(np.full((100, 4000), FREE, dtype=np.uint8), 0.05, np.array([10.0, 20.0]))
    node = np.array([[x, 22.0]])
    named, bare = (np.asarray(draw_map(image, Overlay(node, [name]))).astype(int) for name in ("0627", ""))
    columns = np.nonzero(np.abs(named - bare).sum(axis=(0, 2)))[0]
    assert columns.max() - columns.min() == pytest.approx(92, abs=5)  # as wide as anywhere


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("resolution: 0.05\n", ""), "resolution is missing"),
        (("0.05", "wide"), "could not convert"),
        (("3.0, 0.0]", "3.0, 1.0]"), "without yaw"),
        (("map.pgm", "none.pgm"), "No such file"),
        (("negate: 0", "negate: 1"), "not negated"),
    ],
)
def test_bad_maps_are_refused(tmp_path: Path, grid: Grid, change: tuple[str, str], complaint: str) -> None:
    write_image(tmp_path, to_image(grid))
    path = tmp_path / "map.yaml"
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(BadInputError, match=complaint):
        read_map(tmp_path)


def test_damaged_image_is_refused(tmp_path: Path, grid: Grid) -> None:
    write_image(tmp_path, to_image(grid))
    (tmp_path / "map.pgm").write_bytes(b"P5\n50 30\n255\n\x00")
    with pytest.raises(BadInputError, match="map"):
        read_map(tmp_path)


def test_a_map_stitched_in_bands_is_the_whole_without_its_empty_rim(
    grid: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    placements = np.array([[0.0, 0.0, 0.0], [1.1, 0.6, 0.4]])
    whole = to_image(stitch([grid, grid], placements))
    known = np.argwhere(stitch([grid, grid], placements).log_odds != 0)
    (low, left), (high, right) = known.min(axis=0), known.max(axis=0) + 1
    assert left > 0
    stored, work = store_grid(grid, tmp_path / "grid.npy"), Workers(1)
    pictures = set()
    for cells in (10**6, 300, 1):
        monkeypatch.setattr("processing.map_files.BAND_CELLS", cells)
        image = stitch_image([stored, grid], placements, tmp_path / f"map{cells}", work)
        assert_array_equal(image.rows(slice(None)), whole.pixels[low:high, left:right])
        assert_array_equal(image.rows(slice(3, 5)), whole.pixels[low + 3 : low + 5, left:right])
        assert_allclose(image.origin, whole.origin + 0.05 * np.array([left, low]))
        (tmp_path / str(cells)).mkdir()
        write_image(tmp_path / str(cells), image)
        write_picture(tmp_path / str(cells), image, Overlay())
        assert_array_equal(read_map(tmp_path / str(cells)).pixels, image.rows(slice(None)))
        pictures.add((tmp_path / str(cells) / "map.png").read_bytes())
    assert len(pictures) == 1
    spot = np.zeros((40, 60), np.float32)
    spot[10:13, 20:25], spot[12, 22] = -1.0, 3.0
    image = stitch_image([Grid(spot, 0.1, np.array([-3.0, 2.0]))], np.zeros((1, 3)), tmp_path / "spot", work)
    write_image(tmp_path, image)
    assert image.shape == (3, 5)
    assert_allclose(read_map(tmp_path).occupied_points(), [[-0.75, 3.25]], atol=1e-6)
    nothing = Grid(np.zeros((4, 5), np.float32), 0.05, np.zeros(2))
    assert np.all(stitch_image([nothing], placements[:1], tmp_path / "nothing", work).rows(slice(None)) == UNKNOWN)

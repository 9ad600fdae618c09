"""Maps on disk: what nav2's map_server reads, and a picture for people.

In: a `Grid`, or many. Out: `map.pgm` and `map.yaml` (trinary: 0 occupied, 254 free, 205 unknown; the first line of
pixels is the largest y), and `map.png` with the graph over it. Law: the same grid gives the same bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from hw_profiles.errors import BadInputError
from processing.geometry import Array
from processing.occupancy_grid import Grid, StoredGrid, Window
from processing.stitching import rows_covered, stitch, stitched_window
from processing.workers import Workers

Image.MAX_IMAGE_PIXELS = None  # a mine of kilometres is no attack
OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # pixels
OCCUPIED_ABOVE = 1.0  # log-odds: more than a single hit
FREE_BELOW = -0.3  # log-odds: one look is enough
PICTURE_PIXELS = 1200, 4000  # the longer side of the picture: at least, at most (up to the whole factor)
BAND_CELLS = 4_000_000  # that are stitched, written and shrunk at once
MARGIN_PIXELS = 50  # room for the scale bar and the names at the rim
WALL, OPEN, DARK = (38, 38, 46), (255, 255, 255), (206, 208, 212)
BLUE, RED, INK = (30, 100, 200), (205, 40, 30), (20, 20, 20)

Band = tuple[slice, list[Grid | StoredGrid], Array]  # rows of a map, the grids that reach them, and where these lie


@dataclass(frozen=True, slots=True)
class MapImage:
    pixels: NDArray[np.uint8]  # (H, W) OCCUPIED, FREE or UNKNOWN; row 0 is the smallest y
    resolution_m: float
    origin: Array  # (2,) x, y of the lower-left corner of pixel [0, 0]

    @property
    def shape(self) -> tuple[int, int]:
        return self.pixels.shape

    def rows(self, which: slice) -> NDArray[np.uint8]:
        return self.pixels[which]

    def occupied_points(self) -> Array:
        """The centres (n, 2) of the occupied cells."""
        rows, columns = np.nonzero(self.pixels == OCCUPIED)
        return self.origin + self.resolution_m * (np.column_stack([columns, rows]) + 0.5)


@dataclass(frozen=True, slots=True)
class StoredImage:
    """A `MapImage` in a file of bare pixels, whose rows are read when they are needed: those of a window of it."""

    path: Path
    width: int  # of the file
    corner: tuple[int, int]  # row, column of the file where the window begins
    shape: tuple[int, int]  # (H, W) of the window
    resolution_m: float
    origin: Array  # (2,)

    def rows(self, which: slice) -> NDArray[np.uint8]:
        first, last, _ = which.indices(self.shape[0])
        top, left = self.corner
        pixels = np.fromfile(self.path, np.uint8, (last - first) * self.width, offset=(top + first) * self.width)
        return pixels.reshape(-1, self.width)[:, left : left + self.shape[1]]


@dataclass(frozen=True, slots=True)
class Overlay:
    """What the picture shows over the map, in its frame."""

    nodes: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (k, 2)
    names: Sequence[str] = ()  # k
    edges: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))  # (e, 2, 2) from, to; x, y
    trajectories: Sequence[Array] = ()  # (n, 2) each


def to_image(grid: Grid) -> MapImage:
    """The grid in three values."""
    pixels = np.empty(grid.cells.shape, dtype=np.uint8)
    _classify(grid.cells, grid.unit, pixels)
    return MapImage(pixels, grid.resolution_m, grid.origin)


@numba.njit(cache=True)
def _classify(cells: NDArray[np.float32 | np.int8], unit: np.float32, pixels: NDArray[np.uint8]) -> None:
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            log_odds = cells[row, column] * unit
            pixels[row, column] = OCCUPIED if log_odds > OCCUPIED_ABOVE else FREE if log_odds < FREE_BELOW else UNKNOWN


def stitch_image(grids: Sequence[Grid | StoredGrid], placements: Array, path: Path, work: Workers) -> StoredImage:
    """`stitch` in three values, a band of rows after the other, into the file `path`.

    Raises: ValueError: as `stitch`. OSError: the disk is full.
    """
    window = stitched_window(grids, placements)
    (height, width), step = window.shape, band_rows(window.shape[1])
    path.touch()
    covered = [rows_covered(grid.window, pose, window) for grid, pose in zip(grids, placements, strict=True)]
    bands: list[Band] = []
    for first in range(0, height, step):
        last = min(first + step, height)
        met = [k for k, (low, high) in enumerate(covered) if low < last and high > first]
        bands.append((slice(first, last), [grids[k] for k in met], placements[met]))
    known = work.map("map", partial(stitch_band, window=window, path=path), bands)
    rows = np.flatnonzero(np.concatenate([np.zeros(0, bool), *(rows for rows, _ in known)]))
    if not len(rows):
        return StoredImage(path, width, (0, 0), window.shape, window.resolution_m, window.origin)
    columns = np.flatnonzero(np.any([columns for _, columns in known], axis=0))
    corner = int(rows[0]), int(columns[0])  # the rim of which nothing is known goes
    shape = int(rows[-1]) + 1 - corner[0], int(columns[-1]) + 1 - corner[1]
    origin = window.origin + window.resolution_m * np.array(corner[::-1])
    return StoredImage(path, width, corner, shape, window.resolution_m, origin)


def stitch_band(band_of: Band, window: Window, path: Path) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Write some rows of the file. Returns: of which rows, and which columns, something is known."""
    rows, grids, placements = band_of
    band = stitch(grids, placements, window.rows(rows))
    with path.open("r+b") as file:
        file.seek(rows.start * window.shape[1])
        file.write(to_image(band).pixels.data)
    known = band.cells != 0
    return known.any(axis=1), known.any(axis=0)


def band_rows(width: int) -> int:
    """So many rows of an image are handled at once."""
    return max(1, BAND_CELLS // max(1, width))


def write_image(folder: Path, image: MapImage | StoredImage) -> None:
    """Write map.pgm and map.yaml into the folder, which exists."""
    image = _not_empty(image)
    (height, width), step = image.shape, band_rows(image.shape[1])
    with (folder / "map.pgm").open("wb") as file:
        file.write(b"P5\n%d %d\n255\n" % (width, height))
        for last in range(height, 0, -step):
            file.write(image.rows(slice(max(last - step, 0), last))[::-1].tobytes())
    x, y = (float(value) for value in np.round(image.origin, 6) + 0.0)
    (folder / "map.yaml").write_text(
        f"image: map.pgm\nmode: trinary\nresolution: {float(image.resolution_m)!r}\norigin: [{x!r}, {y!r}, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
    )


def write_picture(folder: Path, image: MapImage | StoredImage, overlay: Overlay) -> None:
    """Write map.png into the folder."""
    draw_map(image, overlay).save(folder / "map.png")


def _not_empty(image: MapImage | StoredImage) -> MapImage | StoredImage:
    """A map without cells becomes one unknown pixel: programs do not read pictures of nothing."""
    if 0 in image.shape:
        return MapImage(np.full((1, 1), UNKNOWN, dtype=np.uint8), image.resolution_m, image.origin)
    return image


def read_map(folder: Path) -> MapImage:
    """Read map.yaml and the image that it names, as `write_image` or nav2's map_saver wrote them.

    Raises:
        BadInputError: a file is missing or malformed, or the map is turned (an origin with a yaw) or negated.
    """
    path = folder / "map.yaml"
    try:
        pairs = [line.split(":", 1) for line in path.read_text(encoding="utf-8").splitlines() if ":" in line]
        entries = {key.strip(): value.strip() for key, value in pairs}
        resolution_m = float(entries["resolution"])
        x, y, yaw = (float(word) for word in entries["origin"].strip("[]").split(","))
        image_path = folder / entries["image"]
        if yaw != 0 or entries.get("negate", "0") not in ("0", "false") or not resolution_m > 0:
            raise BadInputError(f"{path}: only maps without yaw, not negated, with a resolution above 0 are read")
        with Image.open(image_path) as image:
            occupancy = 1.0 - np.asarray(image.convert("L"), dtype=np.float64)[::-1] / 255.0
    except KeyError as error:
        raise BadInputError(f"{path}: the key {error.args[0]} is missing") from error
    except (ValueError, SyntaxError) as error:
        raise BadInputError(f"{path}: {error}") from error
    except OSError as error:
        raise BadInputError(f"{path}: {error.strerror or error}") from error
    pixels = np.full(occupancy.shape, UNKNOWN, dtype=np.uint8)
    pixels[occupancy > float(entries.get("occupied_thresh", 0.65))] = OCCUPIED
    pixels[occupancy < float(entries.get("free_thresh", 0.196))] = FREE
    return MapImage(pixels, resolution_m, np.array([x, y]))


def draw_map(image: MapImage | StoredImage, overlay: Overlay) -> Image.Image:
    """The picture: walls dark, free white, unknown grey; trajectories, edges and named nodes over it; a scale bar."""
    image = _not_empty(image)
    height, width = image.shape
    least, most = PICTURE_PIXELS
    enlarge, shrink = max(1, least // max(height, width)), -(-max(height, width) // most)
    step = shrink * max(1, band_rows(width) // shrink)
    bands = [_shrink(image.rows(slice(first, first + step)), shrink) for first in range(0, height, step)]
    pixels = np.concatenate(bands)[::-1].repeat(enlarge, axis=0).repeat(enlarge, axis=1)
    colours = np.array([DARK] * 256, dtype=np.uint8)
    colours[OCCUPIED], colours[FREE] = WALL, OPEN
    framed = np.pad(pixels, MARGIN_PIXELS, constant_values=UNKNOWN)
    indexed = Image.fromarray(framed, "P")
    indexed.putpalette(colours.tobytes())
    picture = indexed.convert("RGB")
    pixels_per_m = enlarge / shrink / image.resolution_m
    draw = ImageDraw.Draw(picture)

    def place(points: Array) -> list[tuple[float, float]]:
        x, y = ((np.asarray(points) - image.origin) * pixels_per_m).T
        below = picture.height - MARGIN_PIXELS
        return [(float(a) + MARGIN_PIXELS, below - float(b)) for a, b in zip(x, y, strict=True)]

    for trajectory in overlay.trajectories:
        draw.line(place(trajectory), fill=(150, 190, 240), width=1)
    for edge in overlay.edges:
        draw.line(place(edge), fill=BLUE, width=2)
    size = max(14, max(picture.size) // 100)
    font, r = ImageFont.load_default(size=size), size // 3
    for (x, y), name in zip(place(overlay.nodes), overlay.names, strict=True):
        draw.ellipse((x - r, y - r, x + r, y + r), fill=RED, outline=OPEN)
        fits = x + 2 * r + draw.textlength(name, font=font) < picture.width
        at, anchor = (x + 2 * r, "la") if fits else (x - 2 * r, "ra")  # to the left, where the picture ends
        draw.text((at, y - 2 * r), name, fill=RED, font=font, anchor=anchor, stroke_width=2, stroke_fill=OPEN)
    _draw_scale_bar(draw, picture, pixels_per_m, font)
    return picture


@numba.njit(cache=True)
def _shrink(pixels: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """One pixel of `factor`² each: a wall shows if any is one, else free if any is."""
    height, width = pixels.shape
    out = np.full((-(-height // factor), -(-width // factor)), UNKNOWN, np.uint8)
    for row in range(height):
        line = out[row // factor]
        for column in range(width):
            pixel, at = pixels[row, column], column // factor
            if pixel == OCCUPIED or (pixel == FREE and line[at] != OCCUPIED):
                line[at] = pixel
    return out


def scale_bar_length(across_m: float) -> float:
    """1, 2 or 5 times a power of ten, about a fifth of what the picture is across."""
    decade = 10.0 ** np.floor(np.log10(across_m / 5))
    return float(decade * max(step for step in (1, 2, 5) if step * decade <= across_m / 5 * (1 + 1e-9)))


def _draw_scale_bar(
    draw: ImageDraw.ImageDraw,
    picture: Image.Image,
    pixels_per_m: float,
    font: ImageFont.ImageFont | ImageFont.FreeTypeFont,
) -> None:
    length_m = scale_bar_length((picture.width - 2 * MARGIN_PIXELS) / pixels_per_m)
    x, y = 15.0, picture.height - 15.0
    end = x + length_m * pixels_per_m
    draw.line([(x, y - 5), (x, y), (end, y), (end, y - 5)], fill=INK, width=2)
    draw.text((x + 5, y - 6), f"{length_m:g} m", fill=INK, font=font, anchor="lb", stroke_width=2, stroke_fill=OPEN)

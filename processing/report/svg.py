"""Drawings of the plane as SVG: maps with lines, points and names over them, in metres, sharp at any magnification.

In: arrays in metres, x to the right, y up. Out: an `<svg>` element as text. Law: the same drawing gives the same text.
"""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from processing.geometry import Array
from processing.map_files import DARK, FREE, OCCUPIED, OPEN, UNKNOWN, WALL, MapImage, scale_bar_length

Box = tuple[float, float, float, float]  # least x, least y, largest x, largest y [m]


@dataclass(frozen=True, slots=True)
class Drawing:
    """Elements laid over each other in the order of the calls. Widths of lines are pixels, whatever the scale; names
    are legible where the longer side is shown on `shown_px` pixels.
    """

    box: Box
    shown_px: int = 1250
    elements: list[str] = field(default_factory=list)

    def map(self, image: MapImage) -> None:
        """The map's pixels: walls dark, free white, unknown grey."""
        height, width = (side * image.resolution_m for side in image.pixels.shape)
        x, y = image.origin
        self.elements.append(
            f'<image x="{x:.3f}" y="{-y - height:.3f}" width="{width:.3f}" height="{height:.3f}" '
            f'preserveAspectRatio="none" href="data:image/png;base64,{_png(image.pixels)}"/>'
        )

    def line(self, points: Array, colour: str, width_px: float = 1.5, title: str = "") -> None:
        """A line through points (n, 2)."""
        self._path("M" + "L".join(_pairs(points)), colour, width_px, title)

    def segments(self, ends: Array, colour: str, width_px: float = 1.0, title: str = "") -> None:
        """Segments (n, 2, 2) of from, to."""
        words = _pairs(ends.reshape(-1, 2))
        moves = (f"M{a}L{b}" for a, b in zip(words[::2], words[1::2], strict=True))
        self._path("".join(moves), colour, width_px, title)

    def point(self, at: Array, name: str, colour: str, link: str = "") -> None:
        """A named point; with `link`, it leads to that place on the page."""
        r = 4 * self.size / self.shown_px
        (pair,) = _pairs(at[None, :2])
        x, y = pair.split(" ")
        mark = (
            f'<circle cx="{x}" cy="{y}" r="{r:.3f}" fill="{colour}"/><text x="{x}" y="{y}" dx="{1.5 * r:.3f}" '
            f'dy="{-1.5 * r:.3f}" font-size="{3.5 * r:.3f}" fill="{colour}" class="halo">{escape(name)}</text>'
        )
        self.elements.append(f'<a href="#{escape(link)}">{mark}</a>' if link else mark)

    def scale_bar(self) -> None:
        """A bar with its length."""
        length_m, unit = scale_bar_length(self.size), 6 * self.size / self.shown_px
        x, y = self.box[0] + 2 * unit, self.box[1] + 2 * unit
        bar = np.array([[x, y + unit], [x, y], [x + length_m, y], [x + length_m, y + unit]])
        self.line(bar, "#141414", 2)
        text = f'<text x="{x + unit:.3f}" y="{-y - unit / 2:.3f}" font-size="{2.3 * unit:.3f}" class="halo">'
        self.elements.append(f"{text}{length_m:g} m</text>")

    @property
    def size(self) -> float:
        """The longer side, m."""
        return max(self.box[2] - self.box[0], self.box[3] - self.box[1])

    def render(self) -> str:
        x0, y0, x1, y1 = self.box
        view = f"{x0:.3f} {-y1:.3f} {x1 - x0:.3f} {y1 - y0:.3f}"
        return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{view}">{"".join(self.elements)}</svg>'

    def _path(self, moves: str, colour: str, width_px: float, title: str) -> None:
        if len(moves) > 1:
            tip = f"<title>{escape(title)}</title>" if title else ""
            self.elements.append(f'<path d="{moves}" stroke="{colour}" stroke-width="{width_px:g}">{tip}</path>')


def around(points: Array, margin_m: float) -> Box:
    """The box of points (n, 2) with a margin."""
    low, high = points.min(axis=0) - margin_m, points.max(axis=0) + margin_m
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def crop(image: MapImage, box: Box) -> MapImage:
    """The part of the map in the box, in whole pixels; it may be empty."""
    first = np.floor((np.array(box[:2]) - image.origin) / image.resolution_m).astype(int).clip(0)
    last = np.ceil((np.array(box[2:]) - image.origin) / image.resolution_m).astype(int).clip(0)
    pixels = image.pixels[first[1] : last[1], first[0] : last[0]]
    return MapImage(pixels, image.resolution_m, image.origin + first * image.resolution_m)


def thin(points: Array, spacing_m: float) -> Array:
    """Those of the points (n, 2) along a drive that a line needs which is true to about `spacing_m`."""
    driven = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    wanted = np.arange(0, driven[-1] + spacing_m, spacing_m)
    return points[np.unique(np.minimum(np.searchsorted(driven, wanted), len(points) - 1))]


def _pairs(points: Array) -> Sequence[str]:
    return [f"{x:.2f} {-y:.2f}" for x, y in points.tolist()]


def _png(pixels: NDArray[np.uint8]) -> str:
    if not pixels.size:
        pixels = np.full((1, 1), UNKNOWN, np.uint8)
    classes = np.full(pixels.shape, 2, np.uint8)
    classes[pixels == OCCUPIED], classes[pixels == FREE] = 0, 1
    picture = Image.fromarray(classes[::-1]).convert("P")
    picture.putpalette([*WALL, *OPEN, *DARK])
    file = io.BytesIO()
    picture.save(file, "PNG", optimize=True, bits=2)
    return base64.b64encode(file.getvalue()).decode("ascii")

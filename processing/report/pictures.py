"""The pictures of the report: the whole map with its graph, a node close up, an edge in its own frame, its residuals.

In: what an atlas's files hold, as arrays. Out: `<svg>` elements.

Colours: blue is where links agree with the map, orange where they pull at it, red where the robust cost has all but
left them out. Of a link's squared Mahalanobis distance, 95 % lie below 7.8 if its stated covariance is the truth.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.geometry import Array
from processing.map_files import MapImage, to_image
from processing.occupancy_grid import Grid
from processing.report.svg import Drawing, around, crop, thin

PULLS, LEFT_OUT = 7.81, 25.0  # squared distances, 3 degrees of freedom: 95 %, 1 in 65,000
AGREES_COLOUR, PULLS_COLOUR, OUT_COLOUR = "#0072b2", "#e69f00", "#d62728"
NODE_COLOUR, EDGE_COLOUR = "#cd281e", "#1e64c8"
RUN_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#806000")  # told apart by all eyes
NODE_VIEW_M = 12.0  # about a node, to each side: the kinks show there
TRAIL_M = 0.5


def draw_overview(document: Mapping[str, Any], image: MapImage, trails: Mapping[str, Array]) -> str:
    """The stitched map, the runs' trails (n, 2), the edges between their nodes; names lead to their places below."""
    drawing = Drawing(around(_corners(image), 0.03 * max(image.pixels.shape) * image.resolution_m))
    drawing.map(image)
    for number, (run_id, trail) in enumerate(trails.items()):
        drawing.line(thin(trail, TRAIL_M), run_colour(number), 1, run_id)
    at = np.array([[node["x"], node["y"]] for node in document["nodes"]]).reshape(-1, 2)
    for edge in document["edges"]:
        if edge["j"] is not None:
            drawing.line(at[[edge["i"], edge["j"]]], EDGE_COLOUR, 1, f"edge {edge['id']}")
    for node, place in zip(document["nodes"], at, strict=True):
        drawing.point(place, node["epc"][-4:], NODE_COLOUR, f"node-{node['id']}")
    drawing.scale_bar()
    return drawing.render()


def draw_node(node: Mapping[str, Any], image: MapImage, trails: Mapping[str, Array]) -> str:
    """The map about a node with the trails of all runs."""
    at = np.array([node["x"], node["y"]])
    drawing = Drawing(around(at[None], NODE_VIEW_M), shown_px=300)
    drawing.map(crop(image, drawing.box))
    for number, (run_id, trail) in enumerate(trails.items()):
        near = np.abs(trail - at).max(axis=1) < NODE_VIEW_M
        starts = np.flatnonzero(np.diff(near.astype(int), prepend=0, append=0))  # where it comes in, where it leaves
        for first, last in zip(starts[::2], starts[1::2], strict=True):
            drawing.line(thin(trail[first:last], TRAIL_M / 5), run_colour(number), 1.5, run_id)
    drawing.point(at, node["epc"][-4:], NODE_COLOUR)
    drawing.scale_bar()
    return drawing.render()


def draw_edge(arrays: Mapping[str, NDArray[Any]], runs: Sequence[int]) -> str:
    """An edge in its own frame: its grid, its paths in the colours of their runs, its strong links in those of their
    residuals. `runs` holds the run's number of each path.
    """
    image = to_image(Grid(arrays["grid_log_odds"], float(arrays["grid_resolution"]), arrays["grid_origin"]))
    poses, strong, squared = arrays["poses"], arrays["link_strong"], arrays["link_squared_distances"]
    drawing = Drawing(around(_corners(image), 0.5))
    drawing.map(image)
    classes = np.digitize(squared, (PULLS, LEFT_OUT))
    for number, colour in enumerate((AGREES_COLOUR, PULLS_COLOUR, OUT_COLOUR)):
        ends = arrays["link_ends"][strong & (classes == number)]
        drawing.segments(poses[ends][:, :, :2], colour, 0.6)
    for path, run in enumerate(runs):
        first, last = arrays["path_firsts"][path : path + 2]
        drawing.line(poses[first:last, :2], run_colour(run), 2)
    drawing.scale_bar()
    return drawing.render()


def draw_residuals(squared: Array) -> str:
    """A histogram of squared Mahalanobis distances of strong links, the last bar holding all beyond."""
    bounds = np.linspace(0, 32, 33)
    counts, _ = np.histogram(np.minimum(squared, bounds[-1] - 1e-9), bounds)
    tallest = max(int(counts.max()), 1)
    bars = []
    for left, count in zip(bounds[:-1], counts, strict=True):
        colour = (AGREES_COLOUR, PULLS_COLOUR, OUT_COLOUR)[int(np.digitize(left + 0.5, (PULLS, LEFT_OUT)))]
        height = 60 * count / tallest
        tip = f"<title>{count} links</title>"
        place = f'x="{left * 8:.0f}" y="{62 - height:.1f}" width="7" height="{height:.1f}"'
        bars.append(f'<rect {place} fill="{colour}">{tip}</rect>')
    labels = "".join(f'<text x="{x * 8}" y="74" font-size="10">{x}</text>' for x in (0, 8, 16, 24))
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 264 78">{"".join(bars)}{labels}</svg>'


def run_colour(number: int) -> str:
    return RUN_COLOURS[number % len(RUN_COLOURS)]


def _corners(image: MapImage) -> Array:
    """The lower left and the upper right corner of the map, (2, 2)."""
    return np.stack([image.origin, image.origin + image.resolution_m * np.array(image.pixels.shape[::-1])])

"""`rtlog-atlas report`: an atlas as one page that a person reads, with nothing to install and nothing to fetch.

In: an atlas on disk. Out: one HTML file: the stitched map with the graph over it, what was left out and why, the runs,
every node close up, every edge in its own frame with its links and their residuals.
"""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError, RTLogError
from processing.atlas import read_document
from processing.caveats import caveats, rests_on_little
from processing.edge_arrays import read_edge_arrays
from processing.geometry import Array
from processing.map_files import MapImage, read_map
from processing.report.pictures import (
    LEFT_OUT,
    PULLS,
    draw_edge,
    draw_node,
    draw_overview,
    draw_residuals,
    run_colour,
)
from processing.tum import read_tum

TEMPLATE = Path(__file__).with_name("page.html")
SHOWN = (
    *("poses", "covariances", "path_firsts", "link_ends", "link_strong", "link_squared_distances"),
    *("grid_log_odds", "grid_resolution", "grid_origin"),
)
Document = Mapping[str, Any]


def write_report(atlas: Path, output: Path) -> None:
    """Write the page whole or not at all, over an older one.

    Raises:
        BadInputError: there is no atlas, a file of it is missing or malformed, or what is at `output` is no file.
        RTLogError: the page cannot be written.
    """
    if output.exists() and not output.is_file():
        raise BadInputError(f"{output} is there and is no file; it is left as it is")
    page = make_page(atlas)
    part = output.with_name(f".{output.name}.part")
    try:
        part.write_text(page, encoding="utf-8")
        part.replace(output)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise RTLogError(f"{output}: cannot be written: {error.strerror or error}") from error


def make_page(atlas: Path) -> str:
    document, image = read_document(atlas), read_map(atlas)
    trails = {run["id"]: read_tum(atlas / "trajectories" / f"{run['id']}.tum")[1][:, :2] for run in document["runs"]}
    numbers = {run_id: number for number, run_id in enumerate(trails)}
    edges = [(edge, read_edge_arrays(atlas / "edges" / f"{edge['id']}.npz", SHOWN)) for edge in document["edges"]]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        name=escape(atlas.resolve().name),
        summary=_summary(document, trails),
        overview=draw_overview(document, image, trails),
        remarks=_remarks(document),
        convictions=_convictions(document),
        runs=_runs(document, trails),
        nodes="".join(_node(node, image, trails) for node in document["nodes"]),
        edges=_edge_table(edges),
        edge_sections="".join(_edge(edge, arrays, numbers) for edge, arrays in edges),
        pulls=f"{PULLS:.1f}",
        left_out=f"{LEFT_OUT:.0f}",
    )


def _summary(document: Document, trails: Mapping[str, Array]) -> str:
    driven = sum(_length(trail) for trail in trails.values())
    edges = [edge for edge in document["edges"] if edge["kind"] == "edge"]
    mapped = sum(edge["length"] for edge in edges)
    parts = 1 + max(edge["part"] for edge in document["edges"])
    made = [document.get("software", ""), *(f"{k} {value}" for k, value in document.get("parameters", {}).items())]
    return (
        f"{len(trails)} runs, {driven:.0f} m driven · {len(document['nodes'])} beacons, {len(edges)} edges of "
        f"{mapped:.0f} m from beacon to beacon · {parts} connected part{'s' * (parts > 1)} · "
        f"{escape(', '.join(made))}"
    )


def _remarks(document: Document) -> str:
    told, weak = caveats(document), rests_on_little(document)
    little = [f"The map rests on little: {', '.join(weak)}."] if weak else []
    lines = _items([*little, *told["left_out"], *told["remarks"]])
    return lines or "<li>Nothing: all of every run is in the map.</li>"


def _convictions(document: Document) -> str:
    """What contradicted the rest and was not believed; nothing where all was."""
    rows = [
        (escape(found["run"]), "{} to {}".format(*found["ticks"]), escape(found["what"]), escape(found["how_much"]))
        for found in document.get("convictions", [])
    ]
    return _table(("run", "ticks", "not believed", "how much"), rows) if rows else ""


def _runs(document: Document, trails: Mapping[str, Array]) -> str:
    rows = [
        (
            f'<span style="color:{run_colour(number)}">━━</span> {escape(run["id"])}',
            run["ticks"],
            f"{_length(trails[run['id']]):.0f}",
            escape(run["profile"]),
            f"{run['wheel_scale']:.4f}" if "wheel_scale" in run else "–",
            f"<code>{run['sha256'][:12]}</code>",
        )
        for number, run in enumerate(document["runs"])
    ]
    return _table(("run", "ticks", "driven, m", "profile", "true over counted distance", "sha256"), rows)


def _node(node: Document, image: MapImage, trails: Mapping[str, Array]) -> str:
    runs = [found["run"] for found in node["passes"]]
    counted = ", ".join(f"{escape(run)} × {runs.count(run)}" for run in dict.fromkeys(runs))
    return (
        f'<figure id="node-{node["id"]}">{draw_node(node, image, trails)}<figcaption><b>{node["id"]}</b> '
        f"<code>{escape(node['epc'])}</code><br>({node['x']:.2f}, {node['y']:.2f}) m, read within "
        f"{node['range']:.1f} m<br>{len(runs)} passes: {counted}</figcaption></figure>"
    )


def _edge_table(edges: Iterable[tuple[Document, Mapping[str, NDArray[Any]]]]) -> str:
    rows = []
    for edge, arrays in edges:
        squared = arrays["link_squared_distances"][arrays["link_strong"]]
        doubt_m = np.sqrt(np.linalg.eigvalsh(arrays["covariances"][:, :2, :2])[:, -1].max())
        rows.append(
            (
                f'<a href="#edge-{escape(edge["id"])}">{escape(edge["id"])}</a>',
                edge["kind"],
                "–" if edge["length"] is None else f"{edge['length']:.2f}",
                f"{doubt_m:.3f}",
                len(edge["paths"]),
                len(arrays["poses"]),
                edge["links"]["weak"],
                edge["links"]["strong"],
                _share(squared > PULLS),
                _share(squared > LEFT_OUT),
            )
        )
    heads = ("edge", "kind", "length, m", "largest σ, m", "paths", "key frames", "weak links", "strong links")
    return _table((*heads, "pull", "outvoted"), rows)


def _edge(edge: Document, arrays: Mapping[str, NDArray[Any]], numbers: Mapping[str, int]) -> str:
    paths = _items(
        f"{path['run']}, ticks {path['from']} to {path['to']}, {'forwards' if path['direction'] > 0 else 'backwards'}"
        for path in edge["paths"]
    )
    squared = arrays["link_squared_distances"][arrays["link_strong"]]
    return (
        f'<section id="edge-{escape(edge["id"])}"><h3>{escape(edge["id"])}</h3>'
        f"{draw_edge(arrays, [numbers[path['run']] for path in edge['paths']])}"
        f'<div class="beside"><ul>{paths}</ul><div class="residuals">{draw_residuals(squared)}</div></div></section>'
    )


def _length(trail: Array) -> float:
    return float(np.hypot(*np.diff(trail, axis=0).T).sum())


def _share(flags: NDArray[np.bool_]) -> str:
    return f"{100 * flags.mean():.1f} %" if flags.size else "–"


def _items(lines: Iterable[str]) -> str:
    return "".join(f"<li>{escape(line)}</li>" for line in lines)


def _table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """An HTML table; the cells of `rows` are HTML already."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

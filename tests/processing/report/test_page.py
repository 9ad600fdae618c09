"""The report shows every run, beacon and edge of the atlas, says what was left out, and needs nothing but a browser."""

import base64
import io
import json
import re
import shutil
import subprocess
import sys
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hw_profiles.errors import BadInputError
from processing.map_files import FREE, OCCUPIED, UNKNOWN, MapImage
from processing.report.page import make_page
from processing.report.pictures import draw_residuals
from processing.report.svg import Drawing, around, crop, thin

VOID = {"meta", "link", "br", "path", "circle", "image", "rect"}


class Page(HTMLParser):
    """What stands in a page: its ids, where its links lead, the places that it would fetch from, its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.sources: list[str] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {key: value or "" for key, value in attrs}
        self.ids += [given["id"]] if "id" in given else []
        if "href" in given:
            (self.links if tag == "a" else self.sources).append(given["href"])
        self.sources += [given["src"]] if "src" in given else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module")
def page(small_atlas: Path) -> Page:
    return Page(make_page(small_atlas))


def test_every_run_beacon_and_edge_is_shown(small_atlas: Path, page: Page) -> None:
    document = json.loads((small_atlas / "atlas.json").read_text(encoding="utf-8"))
    wanted = [f"node-{node['id']}" for node in document["nodes"]] + [f"edge-{e['id']}" for e in document["edges"]]
    assert Counter(wanted) == Counter(page.ids)
    text = " ".join(page.words)
    assert all(run["id"] in text and run["sha256"][:12] in text for run in document["runs"])
    assert all(node["epc"] in text for node in document["nodes"])
    assert all(f"{edge['length']:.2f}" in text for edge in document["edges"] if edge["kind"] == "edge")


def test_the_page_is_well_formed_and_fetches_nothing(page: Page) -> None:
    assert page.open == []
    assert {link.removeprefix("#") for link in page.links} <= set(page.ids)
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert len(page.sources) == 1 + len(page.ids)  # the whole, and one for each beacon and edge


def test_what_was_left_out_is_said(small_atlas: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(small_atlas, tmp_path / "a<b>.atlas")
    document = json.loads((copy / "atlas.json").read_text(encoding="utf-8"))
    document["left_out"] = [{"what": "tag <X>", "run": "r", "ticks": [7, 9], "reason": "it was moved"}]
    document["remarks"] = ["one & all"]
    document["convictions"] = [{"run": "r & r", "ticks": [40, 55], "what": "wheels", "how_much": "2.5° <a tick>"}]
    (copy / "atlas.json").write_text(json.dumps(document), encoding="utf-8")
    page = Page(make_page(copy))
    assert "tag <X> is left out of run r, ticks 7, 9: it was moved" in page.words
    assert "one & all" in page.words
    assert "The map rests on little: 1 stretch not believed." in page.words
    at = page.words.index("r & r")
    assert page.words[at : at + 4] == ["r & r", "40 to 55", "wheels", "2.5° <a tick>"]
    assert page.words.count("a<b>.atlas") == 2


def test_the_verb_writes_a_page_whole_or_not_at_all(small_atlas: Path, tmp_path: Path) -> None:
    def report(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "processing.cli", "report", *arguments]
        return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)

    copy = shutil.copytree(small_atlas, tmp_path / "level.atlas")
    result = report(copy)
    assert (result.returncode, result.stderr) == (0, "")
    first = (tmp_path / "level.report.html").read_text(encoding="utf-8")
    assert report(".", cwd=copy).returncode == 0
    assert (tmp_path / "level.report.html").read_text(encoding="utf-8") == first
    next((copy / "edges").iterdir()).write_bytes(b"PK\x03\x04 torn")
    result = report(copy, "-o", tmp_path / "torn.html")
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)
    assert f"{copy / 'edges'}" in result.stderr
    result = report(small_atlas, "-o", tmp_path)
    assert (result.returncode, result.stderr) == (
        2,
        f"rtlog-atlas: {tmp_path} is there and is no file; it is left as it is\n",
    )
    result = report(small_atlas, "-o", tmp_path / "absent" / "page.html")
    assert result.returncode == 1
    assert f"{tmp_path / 'absent' / 'page.html'}: cannot be written: No such file or directory" in result.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"level.atlas", "level.report.html"}


def test_an_atlas_without_its_map_is_refused(small_atlas: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(small_atlas, tmp_path / "level.atlas")
    (copy / "map.yaml").unlink()
    with pytest.raises(BadInputError, match=r"map\.yaml: No such file"):
        make_page(copy)


def test_a_map_lies_where_its_metres_are() -> None:
    pixels = np.full((4, 6), UNKNOWN, np.uint8)
    pixels[0, 0], pixels[3, 5] = OCCUPIED, FREE  # lower left, upper right
    drawing = Drawing((0.0, 0.0, 10.0, 10.0))
    drawing.map(MapImage(pixels, 0.5, np.array([2.0, 1.0])))
    place = dict(re.findall(r'(x|y|width|height)="([-.\d]+)"', drawing.elements[0]))
    assert {key: float(value) for key, value in place.items()} == {"x": 2, "y": -3, "width": 3, "height": 2}
    data = base64.b64decode(re.search(r"base64,([^\"]+)", drawing.elements[0])[1])  # type: ignore[index]
    shown = np.asarray(Image.open(io.BytesIO(data)).convert("L"))
    assert shown.shape == (4, 6)
    assert shown[3, 0] == shown.min()
    assert shown[0, 5] == shown.max() == 255


def test_a_crop_keeps_its_place() -> None:
    pixels = np.arange(80, dtype=np.uint8).reshape(8, 10)
    image = MapImage(pixels, 0.5, np.array([-1.0, 2.0]))
    part = crop(image, (0.0, 2.6, 1.0, 99.0))
    np.testing.assert_array_equal(part.pixels, pixels[1:, 2:4])
    np.testing.assert_allclose(part.origin, [0.0, 2.5])
    assert crop(image, (50.0, 50.0, 60.0, 60.0)).pixels.size == 0


def test_lines_keep_their_ends_when_thinned() -> None:
    line = np.column_stack([np.linspace(0, 10, 1001), np.zeros(1001)])
    few = thin(line, 0.5)
    assert len(few) == 21
    np.testing.assert_allclose(few[[0, -1]], line[[0, -1]])
    np.testing.assert_array_equal(thin(line[:1], 0.5), line[:1])  # standing still all the time
    assert around(few, 1.0) == (-1.0, -1.0, 11.0, 1.0)


def test_residuals_are_counted_by_what_they_mean() -> None:
    picture = draw_residuals(np.array([0.1, 0.2, 0.3, 9.0, 9.5, 1000.0]))
    bars = re.findall(r'fill="(#\w+)"><title>(\d+) links', picture)
    assert Counter({colour: sum(int(n) for c, n in bars if c == colour) for colour, _ in bars}) == Counter(
        {"#0072b2": 3, "#e69f00": 2, "#d62728": 1}
    )
    assert "<rect" in draw_residuals(np.zeros(0))  # an edge without strong links

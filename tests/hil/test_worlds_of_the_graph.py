"""Every case of the graph that a mine brings: a world, mapped by the program, held against its truth and what is told.

Each world takes ten to thirty seconds: too long for `make test`, where the same cases stand on the small mine.
"""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from processing.comparison import compare_truth

pytestmark = pytest.mark.timeout(1800)
EPC = "E20034120000000000000"


@dataclass(frozen=True)
class Mapped:
    document: dict[str, Any]
    said: list[str]
    truth: dict[str, Any]

    @property
    def ate_m(self) -> float:
        return float(self.truth["ate"]["rmse_m"])

    def edges(self) -> dict[str, int]:
        """Edges by the last digits of their tags, and how many paths each has."""
        epcs = [node["epc"][-2:] for node in self.document["nodes"]]
        return {
            f"{epcs[edge['i']]}-{epcs[edge['j']]}": len(edge["paths"])
            for edge in self.document["edges"]
            if edge["kind"] == "edge"
        }


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "processing.cli", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=900)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Mapped]:
    """mapped(world, *options): a shipped world, simulated, built and compared."""
    folder = tmp_path_factory.mktemp("worlds")

    def build(world: str, *options: str) -> Mapped:
        if not (folder / world).exists():
            run("simulate", world, "-o", folder / world)
        atlas = folder / f"{world}{''.join(options)}.atlas"
        said = run("build", *sorted((folder / world).glob("*.mcap")), "-o", atlas, *options).stderr.splitlines()
        document = json.loads((atlas / "atlas.json").read_text(encoding="utf-8"))
        return Mapped(document, said, compare_truth(atlas, folder / world)["truth"])

    return build


def test_missed_tags_are_recognised_and_the_paths_split(mapped: Callable[..., Mapped]) -> None:
    """Three in a row by one run, one by all runs but the first."""
    found = mapped("missed_tags")
    assert found.ate_m < 0.05
    assert found.truth["walls"]["precision"] > 0.99
    assert found.edges() == {
        "01-02": 2, "01-07": 1, "02-03": 2, "02-07": 1, "03-04": 3, "04-05": 3, "05-06": 3, "06-07": 2
    }  # fmt: skip
    unread = [
        (node["epc"][-2:], each["run"].split("-")[1])
        for node in found.document["nodes"]
        for each in node["passes"]
        if not each["read"]
    ]
    assert unread == [("03", "second"), ("04", "second"), ("04", "third"), ("05", "second"), ("06", "third")]
    assert sum("without reading it; it is cut there" in line for line in found.said) == 5


def test_a_missed_tag_makes_no_edge_of_its_own(mapped: Callable[..., Mapped]) -> None:
    found = mapped("missed_tag")
    assert found.ate_m < 0.05
    assert found.edges() == {"01-02": 2, "01-05": 1, "02-03": 3, "02-05": 1, "03-04": 2, "04-05": 2}


def test_moved_and_cloned_tags_are_named_and_left_out(mapped: Callable[..., Mapped]) -> None:
    """Between runs, during a run, and two tags of one EPC, with five tags around that stay."""
    found = mapped("moved_tags")
    assert found.ate_m < 0.05
    assert found.truth["walls"]["precision"] > 0.99
    assert [node["epc"] for node in found.document["nodes"]] == [f"{EPC}A0{k}" for k in range(1, 6)]
    assert {item["what"] for item in found.document["left_out"]} == {f"tag {EPC}A0{k}" for k in (6, 7, 8)}
    for k in (6, 7, 8):
        assert any(f"tag {EPC}A0{k} is left out of run moved_tags-first, ticks" in line for line in found.said)


def test_a_moved_tag_is_named_where_only_one_other_is_there(mapped: Callable[..., Mapped]) -> None:
    found = mapped("moved_tag")
    assert found.ate_m < 0.05
    assert found.truth["parts"] == 1
    assert [node["epc"] for node in found.document["nodes"]] == [f"{EPC}B01"]
    assert {item["what"] for item in found.document["left_out"]} == {f"tag {EPC}B02"}


@pytest.mark.parametrize(("options", "ate_m"), [((), 0.05), (("--assembly", "paper"), 0.3)])
def test_tags_read_together_are_both_kept_and_told(
    mapped: Callable[..., Mapped], options: tuple[str, ...], ate_m: float
) -> None:
    found = mapped("side_by_side", *options)
    assert found.ate_m < ate_m
    assert len(found.document["nodes"]) == 6
    for a, b in ((2, 3), (5, 6)):
        assert any(f"the read clouds of {EPC}D0{a} and {EPC}D0{b} overlap" in line for line in found.said)


def test_turn_arounds_standing_still_and_lost_ticks(mapped: Callable[..., Mapped]) -> None:
    found = mapped("shuttle")
    assert found.ate_m < 0.05
    passes = {node["epc"][-2:]: [each["run"][8:] for each in node["passes"]] for node in found.document["nodes"]}
    assert passes == {"01": ["between", "between", "to_and_fro"], "02": ["to_and_fro"] * 3}  # 20 s under it: one pass
    spurs = [(edge["i"], edge["paths"][0]["run"][8:]) for edge in found.document["edges"] if edge["kind"] == "spur"]
    assert sorted(spurs) == [(0, "between")] * 3 + [(0, "to_and_fro")] + [(1, "to_and_fro")] * 3
    assert found.edges() == {"01-02": 1}


def test_unconnected_parts_and_runs_of_few_tags(mapped: Callable[..., Mapped]) -> None:
    found = mapped("islands")
    assert found.truth["ate_each_part"]["rmse_m"] < 0.05
    assert found.truth["parts"] == 4
    said = "\n".join(found.said)
    assert "the map falls into 4 unconnected parts" in said
    assert "run islands-blind passed 0 tags: it is mapped alone" in said
    assert "run islands-stope passed 1 tag: it is mapped alone" in said
    assert "run islands-level_two shares no tag with the others: it is mapped alone" in said
    assert "islands-level_one, islands-level_one_back, islands-one_tag" in said


def test_two_drifts_between_two_tags_are_two_edges(mapped: Callable[..., Mapped]) -> None:
    """One of them also driven the other way round, one in reverse."""
    found = mapped("two_drifts")
    assert found.ate_m < 0.03
    directions = [
        sorted((path["run"][11:], path["direction"]) for path in edge["paths"])
        for edge in found.document["edges"]
        if edge["kind"] == "edge"
    ]
    assert sorted(directions) == [[("back", -1), ("out", 1)], [("out", -1), ("out", 1)]]

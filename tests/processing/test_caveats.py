"""What a user is told of a map: every line there is to know, and whether the map rests on little."""

from typing import Any

import pytest

from processing.caveats import caveats, rests_on_little


def document(passed: dict[str, list[str]], parts: dict[str, int] | None = None, **more: Any) -> dict[str, Any]:
    """An atlas of these runs, each with the tags that it passed, all in one part unless it is said."""
    parts = parts or dict.fromkeys(passed, 0)
    epcs = sorted({(epc, parts[run]) for run, of in passed.items() for epc in of})
    nodes = [
        {
            "id": k,
            "epc": epc,
            "part": part,
            "passes": [{"run": r} for r in passed if epc in passed[r] and parts[r] == part],
        }
        for k, (epc, part) in enumerate(epcs)
    ]
    runs = [{"id": run, "scans": 1000, "scans_unused": 100} for run in passed]
    edges = [{"part": parts[run], "paths": [{"run": run}]} for run in passed]
    return {"runs": runs, "nodes": nodes, "edges": edges, "remarks": [], **more}


def test_what_is_to_know_is_told_by_its_kind() -> None:
    convictions = [{"run": "a", "ticks": [7, 19], "what": "wheels", "how_much": "2.5° a tick too much"}]
    left_out = [{"what": "tag E1", "run": "a", "ticks": [3, 5], "reason": "it was moved"}]
    told = caveats(document({"a": []}, convictions=convictions, left_out=left_out, remarks=["so it is"]))
    assert told == {
        "convictions": ["run a, ticks 7 to 19: wheels not believed, 2.5° a tick too much"],
        "left_out": ["tag E1 is left out of run a, ticks 3, 5: it was moved"],
        "remarks": ["so it is"],
    }
    assert not any(caveats(document({"a": []})).values())  # an atlas need not have convictions


def test_a_map_rests_on_enough_where_two_tags_join_what_it_is_made_of() -> None:
    assert rests_on_little(document({"a": ["E1"]})) == []
    assert rests_on_little(document({"a": ["E1", "E2", "E3"], "b": ["E2", "E3"], "c": ["E1", "E3"]})) == []


@pytest.mark.parametrize(
    ("passed", "hanging"),
    [
        ({"a": ["E1", "E2"], "b": ["E2", "E3"]}, ["run b hangs on tag E2 alone"]),
        ({"a": ["E1", "E2"], "b": ["E1", "E2"], "c": ["E2"]}, ["run c hangs on tag E2 alone"]),
        (
            {"a": ["E1", "E2"], "b": ["E1", "E2"], "c": ["E2", "E3", "E4"], "d": ["E3", "E4"], "e": ["E1", "E2"]},
            ["run c, d hangs on tag E2 alone"],
        ),
    ],
)
def test_what_one_tag_joins_is_named(passed: dict[str, list[str]], hanging: list[str]) -> None:
    assert rests_on_little(document(passed)) == hanging


def test_parts_unused_scans_and_what_was_not_believed_are_named() -> None:
    convictions = [{"what": of} for of in ("wheels", "scan", "profile", "tag")]
    found = document({"a": ["E1", "E2"], "b": ["E1", "E2"]}, {"a": 0, "b": 1}, convictions=convictions)
    found["runs"][1]["scans_unused"] = 101
    assert rests_on_little(found) == [
        "2 parts that nothing joins",
        "run b has 101 of 1000 scans unused",
        "2 stretches not believed",
    ]

"""Tags reviewed on the small mine: one EPC read at two places is left out by name, with its ticks, and nothing else."""

from dataclasses import replace

import pytest

from processing.beacons import Pass
from processing.pipeline import DrivenRun
from processing.tag_review import leave_out_moved


def rename(found: Pass, old: str, new: str) -> Pass:
    return replace(found, epc=new) if found.epc == old else found


def test_tags_that_stay_are_kept(driven: list[DrivenRun]) -> None:
    runs, left_out = leave_out_moved(driven)
    assert left_out == []
    assert [run.passes for run in runs] == [run.passes for run in driven]


@pytest.mark.parametrize("swapped", [False, True])
def test_one_epc_at_two_places_is_left_out(driven: list[DrivenRun], swapped: bool) -> None:
    """The second run reads the first one's last tag where its second one hangs; the walls clear the tag between."""
    second, last = (f"E200341200000000000004{number}" for number in ("02", "04"))
    around, back = driven
    back = replace(back, passes=[rename(found, second, last) for found in back.passes])
    runs, left_out = leave_out_moved([back, around] if swapped else [around, back])
    assert {(item["what"], item["run"]) for item in left_out} == {
        (f"tag {last}", "small-around"),
        (f"tag {last}", "small-back"),
    }
    for item in left_out:
        of = around if item["run"] == "small-around" else back
        assert item["ticks"] == [int(of.run.scan_ticks[found.centre]) for found in of.passes if found.epc == last]
        assert "moved, or two tags of one EPC" in item["reason"]
    assert sorted({found.epc[-3:] for run in runs for found in run.passes}) == ["401", "402", "403"]
    assert [len(run.passes) for run in runs] == ([2, 5] if swapped else [5, 2])


def test_a_tag_that_rides_along_is_no_beacon(driven: list[DrivenRun]) -> None:
    epc, count = "E200000000000000000000FF", len(driven[0].loop)
    rider = Pass(epc, driven[0].loop.keyframes[50], 0, count - 1, 0.0, 0.0, 10.0, read_m=200.0)
    runs, left_out = leave_out_moved([replace(driven[0], passes=[rider, *driven[0].passes]), driven[1]])
    assert [(item["what"], item["run"]) for item in left_out] == [(f"tag {epc}", "small-around")]
    assert left_out[0]["reason"].endswith("it rides along")
    assert [run.passes for run in runs] == [run.passes for run in driven]

"""Convictions: contradictions close to each other are one stretch, told with run, ticks, witness, and how much."""

from dataclasses import replace

import numpy as np
import pytest

from processing.chain import Contradiction
from processing.convictions import TOGETHER_S, convictions
from processing.geometry import relative
from processing.odometry import Motions
from processing.pipeline import DrivenRun


@pytest.fixture
def honest(driven: list[DrivenRun]) -> DrivenRun:
    """A drive in which both witnesses say the same of every step."""
    poses = driven[0].loop.poses
    odometry = Motions(relative(poses[:-1], poses[1:]), driven[0].loop.odometry.covariances)
    return replace(driven[0], put_right=[], loop=replace(driven[0].loop, odometry=odometry, contradictions=[]))


def contradicted(of: DrivenRun, *scans: int, wheels: bool = True, missed: tuple[float, ...] = (0, 0, 0)) -> DrivenRun:
    more = [Contradiction(k, wheels, np.array(missed)) for k in scans]
    return replace(of, loop=replace(of.loop, contradictions=[*of.loop.contradictions, *more]))


def test_of_an_honest_drive_nothing_is_told(honest: DrivenRun) -> None:
    assert convictions(honest) == []


def test_a_pause_parts_two_stretches(honest: DrivenRun) -> None:
    ticks, pause = honest.run.scan_ticks, round(TOGETHER_S * 10)
    told = convictions(contradicted(honest, 100, 101, 101 + pause - 2, 300, 300 + pause + 2))
    assert [of["ticks"] for of in told] == [
        [ticks[99], ticks[101 + pause - 2]],  # from the last scan that was in doubt of nothing
        [ticks[299], ticks[300]],
        [ticks[301 + pause], ticks[302 + pause]],
    ]
    assert {of["run"] for of in told} == {honest.run.run_id}


def test_either_witness_has_stretches_of_its_own_in_the_order_of_the_drive(honest: DrivenRun) -> None:
    both = contradicted(contradicted(honest, 100, 103, 200), 101, 102, 150, wheels=False)
    assert [of["what"] for of in convictions(both)] == ["wheels", "scan", "scan", "wheels"]


def test_wheels_are_told_with_all_that_they_would_have_led_astray(honest: DrivenRun) -> None:
    deltas = honest.loop.odometry.deltas.copy()
    deltas[100:110, 2] += np.radians(4.0)
    slipped = replace(honest.loop, odometry=Motions(deltas, honest.loop.odometry.covariances))
    (told,) = convictions(contradicted(replace(honest, loop=slipped), *range(101, 111)))
    assert "and 40.0° off the walls within 1.0 s" in told["how_much"]


def test_scans_are_told_with_the_worst_of_them(honest: DrivenRun) -> None:
    found = contradicted(honest, 100, wheels=False, missed=(0.3, 0.4, np.radians(-2)))
    (told,) = convictions(contradicted(found, 102, wheels=False, missed=(-0.1, 0.0, np.radians(1))))
    assert told["how_much"].startswith("2 scans up to 0.50 m and 2.0° off the wheels")


def test_what_was_filled_in_or_put_right_is_told_too(honest: DrivenRun) -> None:
    guessed, ticks = np.zeros(len(honest.loop) - 1, bool), honest.run.scan_ticks
    guessed[50:60] = guessed[-1] = True
    odometry = replace(honest.loop.odometry, guessed=guessed)
    mended = replace(honest, put_right=["its scanner is turned"], loop=replace(honest.loop, odometry=odometry))
    profile, skid, last = convictions(mended)
    assert (profile["what"], profile["ticks"], profile["how_much"]) == (
        "profile",
        [ticks[0], ticks[-1]],
        "its scanner is turned",
    )
    assert (skid["what"], skid["ticks"]) == ("wheels", [ticks[50], ticks[60]])
    assert last["ticks"] == [ticks[-2], ticks[-1]]

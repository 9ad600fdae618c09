"""Encoders that come out of a replay are held to the angles that went in, and their turns are counted."""

import math

import numpy as np
import pytest
from compared_drive import JOINTS, MS, NOTHING, OFFSET, PERIOD, START, TICKS, Compare, Rows, fault, found, report

from rtlog_server.messages import JointState, header


def test_encoders_are_held_to_their_track(compare: Compare) -> None:
    def change(out: Rows) -> None:
        out[JOINTS, 30].position[0] += 0.1  # at 4 rad/s: 25 ms
        del out[JOINTS, 31]
        out[JOINTS, 32].position[0] += 0.02  # 5 ms

    assert found(compare(change), "encoders") == [("changed", 30, ""), ("lost", 31, "")]


def test_an_encoder_that_is_left_out_is_lost(compare: Compare) -> None:
    def change(out: Rows) -> None:
        stamp_ns = START + OFFSET + 30 * PERIOD - 10 * MS
        out[JOINTS, 30] = JointState(header(stamp_ns, ""), ["left"], np.array([4 * 2.99]), NOTHING, NOTHING)

    comparison = compare(change)
    assert found(comparison, "encoders") == [("lost", 30, "")]
    assert comparison.devices[1].differences[0].detail == "right"


def test_turns_that_nobody_saw_are_told_once(compare: Compare) -> None:
    def change(out: Rows) -> None:
        for k in range(30, TICKS):
            out[JOINTS, k].position[1] -= math.tau

    assert found(compare(change), "encoders") == [("turns", 30, "")]
    comparison = compare(change, report(fault("cut", "encoders", 20, 30)))
    assert found(comparison, "encoders") == [("turns", 30, "cut of encoders at 2.0–3.0 s")]
    figures = comparison.devices[1].figures
    assert figures["right_turned_in_rad"] - figures["right_turned_out_rad"] == pytest.approx(math.tau, abs=1e-3)
    assert figures["left_turned_in_rad"] == pytest.approx(figures["left_turned_out_rad"], abs=1e-3)

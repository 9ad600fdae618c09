"""Drives go in at the wire and come out of a recording: what is the same, and what a fault took."""

from typing import Any

import pytest

SECONDS = 12.0
DEVICES = ("laser/primary", "encoders", "rfid")
KINDS = {
    "drop": "for_s = 0.3",
    "delay": "for_s = 1.0\nby_s = 0.25",
    "cut": "for_s = 1.5",
    "restart": "for_s = 1.0",
    "garble": "for_s = 1.0\nshare = 0.1",
}


def script(kind: str) -> str:
    """The fault at one device after the other."""
    return "".join(
        f'[[fault]]\ndevice = "{device}"\nkind = "{kind}"\nat_s = {2.0 + 4 * number}\n{KINDS[kind]}\n'
        for number, device in enumerate(DEVICES)
    )


def test_what_comes_out_is_what_went_in(rig: Any, make_drive: Any) -> None:
    played = rig.play(make_drive(SECONDS))
    assert played.unexplained() == []
    assert played.summary["lost"] == {}
    for name in ("laser/primary", "encoders"):
        assert played.device(name)["went_in"] in range(119, 123)
        assert played.device(name)["same"] > 100


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_fault_takes_is_accounted_for(rig: Any, make_drive: Any, kind: str) -> None:
    played = rig.play(make_drive(15.0), script(kind))
    assert played.unexplained() == []
    assert [fault["device"] for fault in played.report["faults"]] == list(DEVICES)
    for name in DEVICES:
        causes = [difference["cause"] for difference in played.device(name)["differences"]]
        assert [cause for cause in causes if cause.startswith(f"{kind} of {name}")], name

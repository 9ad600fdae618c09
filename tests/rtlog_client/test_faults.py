"""The fault script is checked at the door: one line that says which fault is wrong, and in what."""

from pathlib import Path

import pytest

from hw_profiles.errors import BadInputError
from rtlog_client.faults import check_devices, load_faults, parse_faults

CUT = '[[fault]]\ndevice = "rfid"\nkind = "cut"\nat_s = 1\nfor_s = 2\n'
SWAP = '[[fault]]\ndevice = "laser/primary"\nkind = "swap"\nother = "laser/auxiliary"\nat_s = 2.5\nfor_s = 1\n'


def test_a_script_reads_as_it_is_written(tmp_path: Path) -> None:
    (tmp_path / "f.toml").write_text(f"seed = 7\n{CUT}{SWAP}")
    script = load_faults(tmp_path / "f.toml")
    assert [(fault.kind, fault.at_s, fault.for_s) for fault in script.fault] == [("cut", 1.0, 2.0), ("swap", 2.5, 1.0)]
    assert (script.seed, script.devices) == (7, {"rfid", "laser/primary", "laser/auxiliary"})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CUT.replace('"cut"', '"bite"'), r"faults f: Invalid enum value 'bite' at `fault\[0\]\.kind`"),
        (CUT.replace('"rfid"', '"sonar"'), "Invalid enum value 'sonar'"),
        (CUT.replace("for_s", "fro_s"), r"unknown key fault\[0\]\.fro_s; the nearest known one is for_s"),
        (CUT.replace("for_s = 2", "for_s = 0"), r"fault\[0\] \(cut\): for_s is 0\.0; it must be above 0"),
        (CUT.replace("at_s = 1", "at_s = -1"), r"at_s is -1\.0; it must be 0 or more"),
        (CUT.replace("at_s = 1", "at_s = nan"), r"fault\[0\]\.at_s is no finite number"),
        (CUT + "by_s = 1\n", "by_s belongs to delay only"),
        (CUT.replace('"cut"', '"delay"'), r"fault\[0\] \(delay\): by_s is missing"),
        (CUT.replace('"cut"', '"delay"') + "by_s = -1\n", r"by_s is -1\.0; it must be above 0"),
        (CUT.replace('"cut"', '"garble"') + "share = 1.5\n", r"share is 1\.5; it must lie above 0, up to 1"),
        (SWAP.replace("laser/auxiliary", "laser/primary"), "a device is not swapped with itself"),
        (SWAP + CUT.replace("rfid", "laser/auxiliary"), r"laser/auxiliary: a fault begins at 2\.5 s, before the one"),
        ("[[fault]\n", "not TOML"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(text: str, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        parse_faults(text, "f")


def test_what_the_vehicle_lacks_cannot_fail(tmp_path: Path) -> None:
    check_devices(parse_faults(CUT, "f"), ["rfid"], "bench")
    with pytest.raises(BadInputError, match=r"fault\[0\]: profile bench has no rfid to emulate; it has laser/primary"):
        check_devices(parse_faults(CUT, "f"), ["laser/primary"], "bench")
    with pytest.raises(BadInputError, match=r"faults .*missing\.toml: No such file"):
        load_faults(tmp_path / "missing.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(BadInputError, match="not UTF-8 text"):
        load_faults(tmp_path / "binary.toml")

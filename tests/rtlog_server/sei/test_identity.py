"""What `identify_bus` tells of encoders that are there, silent or set otherwise than the profile says."""

from pathlib import Path

import pytest

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.devices.sei.identity import EncoderIdentity, identify_bus

LEFT = Encoder(name="left", role="left_wheel", address=0, wheel_radius_m=0.35)
RIGHT = Encoder(name="right", role="right_wheel", address=5, wheel_radius_m=0.35)


def position(address: int, _at_ns: int) -> int:
    return 3 * 4096 + 100 + address


@pytest.mark.parametrize("turns", ["single", "multi"])
@pytest.mark.parametrize("echo", [False, True])
@pytest.mark.parametrize("baud", [9600, 115200])
def test_each_encoder_tells_serial_number_mode_and_position(tmp_path: Path, turns: str, echo: bool, baud: int) -> None:
    bus = SeiBus(port=str(tmp_path / "sei"), turns=turns, baud=baud)  # type: ignore[arg-type]
    with SeiBusEmulator(tmp_path / "sei", {0: 4096, 5: 4096}, position, echo, turns == "multi") as emulator:
        left, right = identify_bus(bus, [LEFT, RIGHT])
        emulator.mute(0)
        silent, still = identify_bus(bus, [LEFT, RIGHT])
    assert left == EncoderIdentity("left", 0, 61000, 4096, turns, 100, "ok")  # type: ignore[arg-type]
    assert right == still == EncoderIdentity("right", 5, 61005, 4096, turns, 105, "ok")  # type: ignore[arg-type]
    assert silent == EncoderIdentity("left", 0, None, 4096, "", None, "silent")
    assert str(silent) == "address 0, silent"


def test_a_position_beyond_the_profiles_resolution_is_the_status(tmp_path: Path) -> None:
    with SeiBusEmulator(tmp_path / "sei", {0: 65536, 5: 4096}, lambda address, _: 50_000 if address == 0 else 7):
        left, right = identify_bus(SeiBus(port=str(tmp_path / "sei")), [LEFT, RIGHT])
    assert left.status == "position 50000 lies beyond the 4096 counts of a turn"
    assert (left.mode, left.position, left.serial_number) == ("single", None, 61000)
    assert right.status == "ok"


def test_a_bus_without_an_answer_is_an_error(tmp_path: Path) -> None:
    with (
        SeiBusEmulator(tmp_path / "sei", {1: 4096}, position),
        pytest.raises(DeviceError, match="no encoder answers"),
    ):
        identify_bus(SeiBus(port=str(tmp_path / "sei")), [LEFT, RIGHT])

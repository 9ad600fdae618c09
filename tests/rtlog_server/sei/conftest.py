"""A driver that runs against emulated encoders, over a real pseudo-terminal."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from wheels import Wheels

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.sei.driver import SeiEncoders

COUNTS = 4096
PERIOD_NS = 33_300_000  # no multiple of the 4 ms in which an encoder looks at its disc
ENCODERS = (
    Encoder(name="left_wheel", role="left_wheel", address=0, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=5, wheel_radius_m=0.35, reversed=True),
)
TURNS_PER_S = {0: 2.3, 5: -1.7}


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "sei"


@pytest.fixture
def counts() -> dict[int, int]:
    """The encoders on the bus, by address."""
    return {0: COUNTS, 5: COUNTS}


@pytest.fixture
def turning() -> Wheels:
    """Two wheels at a steady speed."""
    return Wheels(TURNS_PER_S, COUNTS)


@pytest.fixture
def start(link: Path, start_encoders: Callable[..., Any]) -> Callable[..., Any]:
    """Starts a driver of the bus behind the link, with settings of the profile."""

    def start_bus(encoders: tuple[Encoder, ...] = ENCODERS, **settings: object) -> Any:
        bus = SeiBus(**{"port": str(link), **settings})  # type: ignore[arg-type]
        return start_encoders(SeiEncoders("encoders", bus, encoders), PERIOD_NS)

    return start_bus

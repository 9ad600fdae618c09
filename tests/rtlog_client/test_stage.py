"""The emulators of a stage are the devices that the profile tells of."""

import time
from pathlib import Path

from hw_profiles.profile import Encoder, Profile, SeiBus
from rtlog_client.stage import Stage
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.port import SeiPort


def test_encoders_in_strobe_mode_answer_where_they_were_at_the_strobe(tmp_path: Path) -> None:
    bus = SeiBus(port=str(tmp_path / "sei"), strobe=True)
    wheel = Encoder(name="wheel", role="left_wheel", address=0, wheel_radius_m=0.35)
    asked_ns: list[int] = []

    def angle(_name: str, at_ns: int) -> float:
        asked_ns.append(at_ns)
        return 0.0

    with Stage(Profile(schema=1, name="bench", encoders=[wheel], encoder_bus=bus), angle):
        port = SeiPort(bus)
        port.strobe()
        time.sleep(0.1)
        later_ns = time.monotonic_ns()
        port.exchange(protocol.position_request(0), 2)
        port.close()
    assert 0 < asked_ns[-1] < later_ns - 20_000_000  # an encoder that looks by itself did so 4 ms ago at most

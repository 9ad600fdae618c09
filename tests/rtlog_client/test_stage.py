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
        for _ in range(2):
            port.strobe()
            for _ in range(2):
                time.sleep(0.01)  # in which an encoder that looks by itself would look again
                port.exchange(protocol.position_request(0), 2)
        port.close()
    first, again, second, again_of_second = asked_ns
    assert first == again < second == again_of_second

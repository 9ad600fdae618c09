"""Where the profile says that the reader's console is."""

import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Profile, parse_profile


def parse(device: str) -> Profile:
    return parse_profile(f'schema = 1\nname = "v"\n[rfid]\ndevice = {{ {device} }}\n', "v.toml")


@pytest.mark.parametrize(
    ("device", "place"),
    [
        ('host = "10.0.0.7"', "10.0.0.7:23"),
        ('host = "10.0.0.7", port = 4001', "10.0.0.7:4001"),
        ('serial_port = "/dev/ttyS0", stream_host = "10.0.0.1"', "/dev/ttyS0"),
    ],
)
def test_the_console_is_on_the_network_or_on_a_serial_line(device: str, place: str) -> None:
    reader = parse(device).rfid
    assert reader is not None
    assert reader.device is not None
    assert reader.device.place == place


@pytest.mark.parametrize("device", ["port = 23", 'host = "10.0.0.7", serial_port = "/dev/ttyS0"'])
def test_neither_or_both_are_refused(device: str) -> None:
    with pytest.raises(BadInputError, match="it must be one of the two"):
        parse(device)

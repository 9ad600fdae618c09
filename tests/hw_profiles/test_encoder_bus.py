"""What a profile must not say of the encoders on a bus."""

import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import SHIPPED, CanBus, parse_profile, read_profile_text, shipped_profiles


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("address = 1", "address = 0", r"encoders share an address on the bus: \[0, 0\]"),
        ("address = 1", "address = 15", r"encoders\[1\]\.address is 15; .* 0 … 14"),
        ("address = 1", "", r"encoders\[1\]\.address is None"),
        ("counts_per_turn = 4096", "counts_per_turn = 65537", r"encoders\[0\]\.counts_per_turn is 65537; .* 65536"),
    ],
)
def test_an_encoder_that_the_bus_cannot_have_is_refused(right: str, wrong: str, complaint: str) -> None:
    text = read_profile_text("simulated")
    assert right in text
    with pytest.raises(BadInputError, match=complaint):
        parse_profile(text.replace(right, wrong), "test")


@pytest.mark.parametrize("name", shipped_profiles())
def test_the_shipped_profiles_are_right(name: str) -> None:
    assert parse_profile((SHIPPED / f"{name}.toml").read_text(), name).name == name


CAN_BUS = 'kind = "can"\nchannel = "can0"'


def with_can_bus(bus: str = CAN_BUS) -> str:
    sei = 'kind = "sei"\nport = "/tmp/rtlog-sei"'
    text = read_profile_text("simulated")
    assert sei in text
    return text.replace(sei, bus).replace("address = 0", "address = 5")


def test_a_can_bus_is_one_of_the_kinds() -> None:
    bus = parse_profile(with_can_bus(), "test").encoder_bus
    assert bus == CanBus(channel="can0", interface="socketcan", bitrate=500_000, trigger="sync")
    assert bus.place == "socketcan:can0"


@pytest.mark.parametrize(
    ("addition", "complaint"),
    [
        ("bitrat = 500000", r"unknown key encoder_bus\.bitrat; the nearest known one is bitrate"),
        ('port = "/dev/ttyACM0"', r"unknown key encoder_bus\.port; "),
        ("bitrate = 83300", r"encoder_bus\.bitrate"),
        ('interface = "pcan"', r"encoder_bus\.interface"),
        ('interface = "udp_multicast"', r"encoder_bus\.channel is 'can0'; udp_multicast needs a group"),
        ("timer_ms = 0", r"encoder_bus\.timer_ms is 0; it must lie in 1 … 1000"),
        ("udp_port = 70000", r"encoder_bus\.udp_port is 70000; it must lie in 1 … 65535"),
    ],
)
def test_what_a_can_bus_cannot_be_is_refused(addition: str, complaint: str) -> None:
    with pytest.raises(BadInputError, match=complaint):
        parse_profile(with_can_bus(f"{CAN_BUS}\n{addition}"), "test")


@pytest.mark.parametrize(("right", "wrong"), [("address = 1", "address = 128"), ("address = 5", "address = 0")])
def test_node_ids_lie_in_1_to_127(right: str, wrong: str) -> None:
    with pytest.raises(BadInputError, match=r"an encoder on a CAN bus has one in 1 … 127"):
        parse_profile(with_can_bus().replace(right, wrong), "test")


def test_a_bus_of_no_known_kind_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"'profibus' at `encoder_bus\.kind`"):
        parse_profile(with_can_bus('kind = "profibus"'), "test")

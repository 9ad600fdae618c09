"""What a profile must not say of the encoders on a bus."""

import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import SHIPPED, parse_profile, read_profile_text, shipped_profiles


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

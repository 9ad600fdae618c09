"""What a profile may say of what a laser cannot see."""

import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import parse_profile, read_profile_text


def with_laser(keys: str) -> str:
    text = read_profile_text("canmet_trailer")
    assert "[lasers.primary]\n" in text
    return text.replace("[lasers.primary]\n", f"[lasers.primary]\n{keys}\n")


def test_a_laser_has_blind_sectors_a_least_range_and_noise() -> None:
    keys = "blind_sectors_deg = [[80.0, 110], [170, -170]]\nmin_range_m = 0.6\nrange_noise_m = 0.03"
    laser = parse_profile(with_laser(keys), "test").lasers.primary
    assert laser.blind_sectors_deg == ((80.0, 110.0), (170.0, -170.0))
    assert (laser.min_range_m, laser.range_noise_m) == (0.6, 0.03)


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ("blind_sectors_deg = [[110, 80]]", r"lasers\.primary\.blind_sectors_deg\[0\] is \[110.*counter-clockwise"),
        ("blind_sectors_deg = [[0, 10], [20, 20]]", r"lasers\.primary\.blind_sectors_deg\[1\] is \[20"),
        ("blind_sectors_deg = [[0, 1000]]", r"lasers\.primary\.blind_sectors_deg\[0\]"),
        ("blind_sectors_deg = [[10]]", r"lasers\.primary\.blind_sectors_deg"),
        ("blind_sectors_deg = [[nan, 10]]", r"lasers\.primary\.blind_sectors_deg"),
        ("min_range_m = -1", r"lasers\.primary\.min_range_m is -1.*0 … 5"),
        ("range_noise_m = 0", r"lasers\.primary\.range_noise_m is 0.*0\.001 … 0\.2"),
        ("blind_sector_deg = [[0, 10]]", r"unknown key lasers\.primary\.blind_sector_deg; .* blind_sectors_deg"),
    ],
)
def test_what_a_laser_cannot_be_is_refused(keys: str, complaint: str) -> None:
    with pytest.raises(BadInputError, match=complaint) as error:
        parse_profile(with_laser(keys), "test")
    assert "\n" not in str(error.value)


def test_the_second_laser_is_checked_as_well() -> None:
    with pytest.raises(BadInputError, match=r"lasers\.auxiliary\.min_range_m is 9"):
        parse_profile(with_laser("") + "\n[lasers.auxiliary]\nmin_range_m = 9.0\n", "test")

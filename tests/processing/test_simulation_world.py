"""Worlds: what is wrong in a TOML is named; ways between places follow the drifts."""

import pytest

from hw_profiles.errors import BadInputError
from processing.simulation.world import parse_world, read_world_text, route, shipped_worlds, without_noise

WORLD = """
schema = 1
name = "w"
profile = "canmet_trailer"
[places]
a = [0, 0]
b = [30, 0]
c = [30, 20]
d = [0, 20]
[[drifts]]
points = ["a", "b", "c", "d", "a"]
width_m = 4.0
[[drifts]]
points = ["a", [-20, 0]]
width_m = 4.0
[[tags]]
epc = "E20034120000000000000001"
at = [15, 1]
[[runs]]
name = "r"
waypoints = ["a", "c", [-10, 0]]
speed_m_s = 2.0
"""


def test_a_world_has_its_drifts_tags_and_runs() -> None:
    world = parse_world(WORLD, "w.toml")
    assert [drift.width_m for drift in world.drifts] == [4.0, 4.0]
    assert world.tags[0].at == (15.0, 1.0)
    assert world.point("c") == (30.0, 20.0)


HAZARD = 'schema = 1\nhazards = [{ kind = "slip", KEY }]'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("width_m = 4.0", "widht_m = 4.0", r"unknown key drifts\[0\].widht_m; the nearest known one is width_m"),
        ("width_m = 4.0", "width_m = nan", r"drifts\[0\].width_m is no finite number"),
        ("width_m = 4.0", "width_m = -4.0", r"`float` >= 1.0 at `drifts\[0\].width_m`"),
        ('"c", [-10, 0]', '"cc", [-10, 0]', r"run r: there is no 'cc' in \[places\]"),
        ("speed_m_s = 2.0", "speed_m_s = 2.0\nstops_s = { e = 2.0 }", r"run r: there is no 'e' in \[places\]"),
        ('"E20034120000000000000001"', '"e2"', "epc"),
        ("at = [15, 1]", 'at = [15, 1]\nunread_by = ["s"]', "unread_by names no run: s"),
        ('"canmet_trailer"', '"canmet_trailr"', "profile canmet_trailr"),
        ('name = "w"', 'name = "a/b"', "name"),
        (
            "[places]",
            "[noise]\nwheel_radius_error_percent = { drive_wheel = 1.0 }\n[places]",
            "has no wheel drive_wheel",
        ),
        ("schema = 1", "schema = ", "not TOML"),
        (
            "schema = 1",
            'schema = 1\nhazards = [{ kind = "slid", times = 2 }]',
            r"unknown kind 'slid' at `hazards\[0\].kind`; the nearest known one is slide",
        ),
        ("schema = 1", HAZARD.replace("KEY", "facter = 0.5"), r"unknown key hazards\[0\].facter; .* is factor"),
        ("schema = 1", HAZARD.replace("KEY", "factor = 0.0"), r"`float` >= 0.1 at `hazards\[0\].factor`"),
        ("schema = 1", HAZARD.replace("KEY", "at_s = nan"), r"hazards\[0\].at_s is no finite number"),
        ("schema = 1", HAZARD.replace("KEY", 'run = "s"'), r"hazards\[0\] \(slip\): there is no run s"),
        (
            "schema = 1",
            HAZARD.replace("KEY", 'wheel = "drive_wheel"'),
            r"hazards\[0\] \(slip\): profile canmet_trailer of run r has no drive_wheel",
        ),
        (
            "schema = 1",
            'schema = 1\nhazards = [{ kind = "dead_tag", epc = "E20034120000000000000002" }]',
            r"hazards\[0\] \(dead_tag\): there is no tag E20034120000000000000002",
        ),
        ("speed_m_s = 2.0", 'speed_m_s = 2.0\nprofile = "cu_ss53"', "profile cu_ss53: "),
    ],
)
def test_what_is_wrong_is_named_in_one_line(old: str, new: str, message: str) -> None:
    with pytest.raises(BadInputError, match=message) as caught:
        parse_world(WORLD.replace(old, new, 1), "w.toml")
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(("world w.toml: ", "profile "))


def test_two_runs_of_one_name_are_refused() -> None:
    with pytest.raises(BadInputError, match="two runs share a name: r, r"):
        parse_world(WORLD + '[[runs]]\nname = "r"\nwaypoints = ["a", "b"]\nspeed_m_s = 1.0\n', "w.toml")


def test_a_missing_world_names_the_shipped_ones() -> None:
    with pytest.raises(BadInputError, match=r"world nowhere: .*shipped worlds are demo, .*loop, "):
        read_world_text("nowhere")


def test_the_way_between_two_places_follows_the_drift() -> None:
    world = parse_world(WORLD, "w.toml")
    names = [place for place, _ in route(world, world.runs[0])]
    assert names == ["a", "b", "c", (-10.0, 0.0)]
    backwards = parse_world(WORLD.replace('"a", "c", [-10, 0]', '"d", "b"'), "w.toml")
    assert [place for place, _ in route(backwards, backwards.runs[0])] == ["d", "c", "b"]


def test_a_choice_of_two_drifts_is_refused_unless_one_is_direct() -> None:
    bow = '[[drifts]]\npoints = ["b", [40, 10], "c"]\nwidth_m = 4.0\n'
    direct = WORLD.replace('"a", "c", [-10, 0]', '"b", "c"')
    for text in (direct + bow, direct.replace("[[drifts]]", bow + "[[drifts]]", 1)):
        world = parse_world(text, "w.toml")
        assert len(route(world, world.runs[0])) == 2
    two_bows = bow + '[[drifts]]\npoints = ["b", [50, 10], "d"]\nwidth_m = 4.0\n'
    world = parse_world(WORLD.replace('"a", "c", [-10, 0]', '"b", "d"') + two_bows, "w.toml")
    with pytest.raises(BadInputError, match="run r: more than one drift joins b and d"):
        route(world, world.runs[0])


def test_without_noise_only_the_sensors_change() -> None:
    world = parse_world(read_world_text("demo"), "demo")
    quiet = without_noise(world)
    assert quiet.noise.range_m == quiet.noise.slip_m_per_sqrt_m == quiet.noise.missed_pass_probability == 0.0
    assert not quiet.noise.wheel_radius_error_percent
    slipping = parse_world(WORLD.replace("schema = 1", HAZARD.replace("KEY", "times = 2")), "w.toml")
    assert (len(slipping.hazards), without_noise(slipping).hazards) == (1, [])
    assert (quiet.runs, quiet.drifts, quiet.walls) == (world.runs, world.drifts, world.walls)


def test_every_shipped_world_is_sound() -> None:
    assert {"demo", "loop", "mine_level", "missed_tag", "moved_tags", "straight", "tunnels"} < set(shipped_worlds())
    assert all(parse_world(read_world_text(name), name).name == name for name in shipped_worlds())

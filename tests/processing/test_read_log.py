"""Recordings of ours and of others, whole and damaged, as arrays."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from recorded_drive import (
    NOTHING,
    TICKS,
    TRAILER,
    Message,
    drive,
    joints,
    odom,
    ours,
    scan,
    tags,
    theirs,
    tick_ns,
)

from hw_profiles.errors import BadInputError
from hw_profiles.profile import load_profile, parse_profile
from processing.read_log import join_windows, read_log, read_window
from processing.recordings import cut_windows, survey
from rtlog_client.log_file import LogWriter
from rtlog_server.messages import (
    JointState,
    encode,
    header,
)

Record = Callable[..., Path]


@pytest.fixture
def record(tmp_path: Path) -> Record:
    def write(messages: list[Message], profile: str | None = None, cut: str | None = None) -> Path:
        """`cut`: a topic whose last message lacks its last bytes."""
        path = tmp_path / "monday.mcap"
        last = max((n for n, message in enumerate(messages) if message[0] == cut), default=None)
        with LogWriter(path, {}, profile) as log:
            for n, (topic, log_time_ns, message) in enumerate(messages):
                data = encode(message)[:-9] if n == last else encode(message)
                log.write(topic, message.__msgtype__, data, log_time_ns, log_time_ns)
        return path

    return write


def test_our_own_recording(record: Record) -> None:
    path = record(drive(ours), TRAILER)
    run = read_log(path)
    assert run.run_id == "monday"
    assert run.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert run.profile == load_profile("canmet_trailer")
    assert run.ticks == TICKS
    assert run.odometry is None
    assert_array_equal(run.scans.stamps_ns, [tick_ns(k) - 30_000_000 for k in range(TICKS)])
    assert_array_equal(run.motion_ns, [tick_ns(k) - 12_000_000 for k in range(TICKS)])
    assert_allclose(run.wheels, np.outer(np.arange(TICKS), [0.5, 0.6]))
    assert run.scans.ranges.shape == (TICKS, 541)
    assert_allclose(run.scans.ranges[:, 270], 4.0 + 0.1 * np.arange(TICKS), rtol=1e-6)
    assert_allclose(np.degrees(run.scans.angles[[0, 270, 540]]), [-135, 0, 135], atol=1e-4)
    assert_array_equal(run.scan_ticks, np.arange(TICKS))
    assert run.tags.epcs.tolist() == ["E2003412000000000000000A"]
    # one clock: scans, wheels and reads keep their distances
    assert_allclose(run.motion_times - run.scans.times, 0.018, atol=1e-9)
    assert_allclose(run.tags.times - run.scans.times[7], -0.010, atol=1e-9)


def test_windows_of_a_recording_make_the_whole(record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def jumbled(k: int) -> list[Message]:  # log times run backwards now and then
        *before, (topic, log_time_ns, message) = ours(k)
        return [*before, (topic, log_time_ns - 250_000_000 * (k % 7 == 3), message)]

    monkeypatch.setattr("rtlog_client.log_file.CHUNK_BYTES", 5000)
    path = record(drive(jumbled), TRAILER)
    whole = read_log(path)
    monkeypatch.setattr("rtlog_client.log_file.STRETCH_BYTES", 1)
    source = survey((path,), None)
    windows = cut_windows(source)
    assert len(windows) > 10
    run = join_windows(source, [read_window(window, tmp_path) for window in windows], tmp_path)
    for field in ("scan_ticks", "motion_ns", "motion_times", "wheels"):
        assert_array_equal(getattr(run, field), getattr(whole, field), field)
    for field in ("stamps_ns", "times"):
        assert_array_equal(getattr(run.scans, field), getattr(whole.scans, field), field)
    assert_array_equal(run.scans.ranges[:], whole.scans.ranges)
    assert_array_equal(run.tags.times, whole.tags.times)
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".ranges"] == ["monday.ranges"]


def test_wheels_come_by_their_roles_not_by_their_order(record: Record) -> None:
    messages = [m for m in drive(ours) if m[0] != "/encoders/joint_states"]
    messages += [("/encoders/joint_states", tick_ns(k), joints(tick_ns(k), other=9.0, b=2.0, a=1.0)) for k in range(3)]
    profile = TRAILER.replace('name = "left_wheel"', 'name = "a"').replace('name = "right_wheel"', 'name = "b"')
    assert_array_equal(read_log(record(messages, profile)).wheels, [[1.0, 2.0]] * 3)


def test_another_system_needs_no_profile(record: Record) -> None:
    run = read_log(record(drive(theirs)))
    assert run.wheels is None
    assert run.scans.ranges.shape == (TICKS, 181)
    assert_allclose(run.scans.angles, np.radians(np.arange(-90, 91)), atol=1e-5)
    headings = np.arctan2(np.sin(0.4 * np.arange(TICKS) - 3), np.cos(0.4 * np.arange(TICKS) - 3))
    assert_allclose(run.odometry, np.column_stack([0.2 * np.arange(TICKS), 0.1 * np.arange(TICKS), headings]))
    assert run.profile.lasers.primary.mount.x_m == 0
    assert run.ticks == TICKS
    assert len(run.tags.epcs) == 0
    assert_array_equal(run.scan_ticks, np.arange(TICKS))


def test_a_named_profile_stands_in_for_the_attached_one(record: Record) -> None:
    named = parse_profile(TRAILER.replace("canmet_trailer", "corrected"), "test")
    path = record(drive(ours), TRAILER)
    assert read_log(path).profile.name == "canmet_trailer"
    assert read_log(path, named).profile == named


def test_a_named_profile_stands_in_for_none(record: Record) -> None:
    path = record(drive(ours))
    assert read_log(path, load_profile("canmet_trailer")).wheels is not None


def test_returns_beyond_reach_or_below_it_are_no_walls(record: Record) -> None:
    """REP-117: +inf no return, NaN invalid, -inf too near; drivers that know no REP say 0 or the longest range."""
    ranges = np.full(541, 5.0)
    ranges[:8] = [np.inf, 20.0, 31.0, np.nan, -np.inf, 0.0, -1.0, 0.049]
    messages = drive(ours, but=lambda topic, _: "scan" in topic)
    messages += [("/laser/primary/scan", tick_ns(k), scan(tick_ns(k), ranges)) for k in range(TICKS)]
    read = read_log(record(messages, TRAILER)).scans.ranges[3, :9]
    assert_array_equal(read, np.float32([np.inf, np.inf, np.inf, *[np.nan] * 5, 5.0]))


def test_blind_sectors_and_what_is_too_near_say_nothing(record: Record) -> None:
    keys = (
        "[lasers.primary]\nblind_sectors_deg = [[80.0, 110.0], [-135, -130]]\nmin_range_m = 0.6\nrange_noise_m = 0.02"
    )
    ranges = np.full(541, 5.0)
    ranges[[100, 101]] = 0.59, 0.61
    messages = drive(ours, but=lambda topic, _: "scan" in topic)
    messages += [("/laser/primary/scan", tick_ns(k), scan(tick_ns(k), ranges)) for k in range(TICKS)]
    scans = read_log(record(messages, TRAILER.replace("[lasers.primary]", keys))).scans
    degrees = np.round(np.degrees(scans.angles), 3)
    blind = ((degrees >= 80) & (degrees <= 110)) | (degrees <= -130)
    blind[100] = True
    assert_array_equal(np.isnan(scans.ranges), np.tile(blind, (TICKS, 1)))
    assert scans.range_noise_m == 0.02


@pytest.mark.parametrize("turn", [1, -1], ids=["counter-clockwise", "clockwise"])
def test_a_blind_sector_may_pass_half_a_turn(record: Record, turn: int) -> None:
    profile = parse_profile('schema = 1\nname = "a"\n[lasers.primary]\nblind_sectors_deg = [[170, -170]]', "a test")
    messages = drive(theirs, but=lambda topic, _: topic == "/scan")
    angles = (-np.pi * turn, np.radians(turn))
    messages += [("/scan", tick_ns(k), scan(tick_ns(k), np.full(360, 3.0), angles)) for k in range(TICKS)]
    scans = read_log(record(messages), profile).scans
    degrees = np.degrees(scans.angles)
    assert_array_equal(np.isnan(scans.ranges[0]), np.round(np.cos(np.radians(degrees)), 6) <= -0.984808)
    assert np.isnan(scans.ranges[0]).sum() == 21


def test_shorter_scans_are_padded_with_nothing(record: Record) -> None:
    messages = drive(ours)
    short = scan(tick_ns(0) - 30_000_000, np.full(500, 2.0))
    messages[1] = ("/laser/primary/scan", tick_ns(0), short)
    ranges = read_log(record(messages, TRAILER)).scans.ranges
    assert ranges.shape == (TICKS, 541)
    assert np.all(ranges[0, :500] == 2.0)
    assert np.all(np.isnan(ranges[0, 500:]))
    assert np.all(np.isfinite(ranges[1:]))


def test_clockwise_scans_are_turned_around(record: Record) -> None:
    """The beam at +90° is the first in the message and the last in the array; a short scan is padded at its end."""
    ramp = np.linspace(1, 5, 181)
    messages = drive(theirs, but=lambda topic, _: topic == "/scan")
    angles = (np.pi / 2, -np.pi / 180)
    messages += [("/scan", tick_ns(k), scan(tick_ns(k), ramp[: 181 - k], angles)) for k in range(TICKS)]
    scans = read_log(record(messages)).scans
    assert_allclose(scans.angles, np.radians(np.arange(-90, 91)), atol=1e-5)
    assert_allclose(scans.ranges[0], ramp[::-1], rtol=1e-6)
    assert np.all(np.isnan(scans.ranges[4, :4]))
    assert_allclose(scans.ranges[4, 4:], ramp[:-4][::-1], rtol=1e-6)
    assert scans.time_increment_s == pytest.approx(-2e-5)  # the last beam is measured first


def test_missing_ticks_and_scans_leave_holes(record: Record) -> None:
    """Ticks are counted as recorded; a scan belongs to the tick that it came with."""
    run = read_log(
        record(drive(ours, but=lambda topic, k: k in (4, 5) or (k == 9 and topic == "/laser/primary/scan")), TRAILER)
    )
    assert run.ticks == TICKS - 2
    assert len(run.scans.times) == TICKS - 3
    assert_allclose(np.diff(run.scans.times), [0.1, 0.1, 0.1, 0.3, 0.1, 0.1, 0.2, *[0.1] * 9])
    kept = [k for k in range(TICKS) if k not in (4, 5)]
    assert_array_equal(run.scan_ticks, [n for n, k in enumerate(kept) if k != 9])


def test_readings_that_lack_a_wheel_are_left_out(record: Record) -> None:
    messages = drive(ours)
    for k, position in ((2, {"left_wheel": 1.0}), (3, {"left_wheel": 1.0, "right_wheel": np.nan})):
        messages[4 * k + 2] = ("/encoders/joint_states", tick_ns(k), joints(tick_ns(k) - 12_000_000, **position))
    empty = JointState(header(tick_ns(4), ""), ["left_wheel", "right_wheel"], NOTHING, NOTHING, NOTHING)
    messages[4 * 4 + 2] = ("/encoders/joint_states", tick_ns(4), empty)
    run = read_log(record(messages, TRAILER))
    assert_array_equal(run.motion_ns, [tick_ns(k) - 12_000_000 for k in range(TICKS) if k not in (2, 3, 4)])
    assert np.all(np.isfinite(run.wheels))


def test_stamps_that_run_backwards_keep_their_order(record: Record) -> None:
    messages = drive(ours, but=lambda topic, _: "scan" in topic)
    back = {5: -300, 6: -200, 12: -1000}  # ms
    for k in range(TICKS):
        stamp_ns = tick_ns(k) - 30_000_000 + back.get(k, 0) * 1_000_000
        messages.append(("/laser/primary/scan", tick_ns(k), scan(stamp_ns, np.full(541, 4.0 + 0.1 * k))))
    run = read_log(record(messages, TRAILER))
    assert np.all(np.diff(run.scans.times) > 0)
    assert_allclose(run.scans.ranges[:, 0], 4.0 + 0.1 * np.arange(TICKS), rtol=1e-6)  # as recorded
    assert run.scans.stamps_ns[12] == tick_ns(12) - 1_030_000_000  # and stamps as they came
    sound = np.array([k for k in range(TICKS) if k not in back])
    since_wheels = run.scans.times - run.motion_times
    assert_allclose(since_wheels[sound], -0.018, atol=1e-9)  # the others are where they were
    assert_allclose(since_wheels[list(back)], -0.018, atol=1e-6)  # and these where the order puts them


def test_a_scan_with_the_stamp_of_an_odometry_message_belongs_to_it(record: Record) -> None:
    """Some systems stamp both alike, and then both run backwards together."""
    stamps = [tick_ns(k) for k in range(TICKS)]
    stamps[8] = tick_ns(4) + 1
    messages = []
    for k, stamp_ns in enumerate(stamps):
        messages += [("/odom", tick_ns(k), odom(stamp_ns, 0.2 * k, 0.0, 0.0))]
        messages += [("/scan", tick_ns(k), scan(stamp_ns, np.full(181, 3.0)))] if k != 7 else []
    run = read_log(record(messages))
    assert_allclose(run.scans.times, np.delete(run.motion_times, 7), atol=1e-6)
    assert np.all(np.diff(run.scans.times) > 0)


@pytest.mark.parametrize(
    ("messages", "profile", "words"),
    [
        (drive(ours, but=lambda topic, _: "scan" in topic), TRAILER, ["/laser/primary/scan", "/scan"]),
        (drive(ours, but=lambda topic, _: "joint" in topic), TRAILER, ["/encoders/joint_states", "/odom"]),
        (drive(ours), None, ["profile", "--profile"]),
        (
            drive(ours),
            TRAILER.replace('name = "left_wheel"', 'name = "front_left"'),
            ["/encoders/joint_states", "front_left"],
        ),
        (drive(ours)[:5], TRAILER, ["/laser/primary/scan", "1"]),
        (
            [m for k in range(TICKS) for m in ours(k)[2:] if m[0] != "/rfid/tags"]
            + [
                ("/laser/primary/scan", tick_ns(k), scan(tick_ns(k), np.ones(541), (-1.0, 0.01 + (k > 5) * 0.001)))
                for k in range(9)
            ],
            TRAILER,
            ["angles"],
        ),
        (
            drive(theirs, but=lambda topic, _: topic == "/scan")
            + [("/scan", tick_ns(k), scan(tick_ns(k), np.ones(181), (0.0, 0.0))) for k in range(9)],
            None,
            ["angle_increment"],
        ),
        (
            drive(theirs, but=lambda topic, _: topic == "/scan")
            + [("/scan", tick_ns(k), scan(tick_ns(k), np.ones(4))) for k in range(9)],
            None,
            ["4 beams"],
        ),
        (
            drive(theirs, but=lambda topic, _: topic == "/scan") + [("/scan", tick_ns(k), tags(0)) for k in range(9)],
            None,
            ["/scan", "TagReads", "LaserScan"],
        ),
        (
            drive(theirs, but=lambda topic, _: topic == "/scan")
            + [("/scan", tick_ns(k), scan(tick_ns(k + 10_000), np.ones(181))) for k in range(9)],
            None,
            ["/scan", "/odom", "time"],
        ),
    ],
    ids=[
        "no laser",
        "no odometry",
        "no profile",
        "a profile of other encoders",
        "one scan",
        "angles that change",
        "no angle",
        "four beams",
        "no scans on /scan",
        "other clocks",
    ],
)
def test_what_cannot_be_mapped_is_said(record: Record, messages: list, profile: str | None, words: list[str]) -> None:
    path = record(messages, profile)
    with pytest.raises(BadInputError) as error:
        read_log(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("topic", ["/laser/primary/scan", "/encoders/joint_states", "/rfid/tags"])
def test_a_message_cut_short_is_named(record: Record, topic: str) -> None:
    path = record(drive(ours), TRAILER, cut=topic)
    with pytest.raises(BadInputError, match=f"monday.mcap: {topic} at {tick_ns(TICKS - 1)} ns"):
        read_log(path)


def test_a_file_cut_off_names_its_cure(record: Record) -> None:
    path = record(drive(ours), TRAILER)
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(BadInputError, match="rtlog-client recover"):
        read_log(path)
    with pytest.raises(BadInputError, match=r"absent\.mcap"):
        read_log(path.with_name("absent.mcap"))

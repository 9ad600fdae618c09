"""CARMEN logs become recordings: stamps, angles, units and special ranges as the logs mean them."""

import gzip
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hw_profiles.errors import BadInputError
from hw_profiles.profile import parse_profile
from processing.import_carmen import import_carmen
from rtlog_client.log_file import read_info, read_messages
from rtlog_server.messages import decode, to_ns

REAL = Path("../shared/data/carmen")


def odom(t: str, x: float = 0.0, theta: float = 0.0) -> str:
    return f"ODOM {x} 0.5 {theta} 0 0 0 {t} host 7.0\n"


def flaser(t: str, ranges: list[float], x: float = 0.0) -> str:
    return f"FLASER {len(ranges)} {' '.join(map(str, ranges))} 9 9 9 {x} 0.5 0.0 {t} host 7.0\n"


def write(folder: Path, *lines: str, packed: bool = False) -> Path:
    path = folder / "run.log"
    path.write_bytes(gzip.compress("".join(lines).encode()) if packed else "".join(lines).encode())
    return path


def messages(path: Path) -> list[tuple[str, int, int, object]]:
    return [(m.topic, m.log_time_ns, m.publish_time_ns, decode(m.data, m.msgtype)) for m in read_messages(path)]


@pytest.mark.parametrize("packed", [False, True])
def test_scan_and_odometry_come_out_as_logged(tmp_path: Path, packed: bool) -> None:
    ranges = [1.0, 0.0, 79.99, 80.0, 81.91] + [2.5] * 175
    log = write(
        tmp_path, "# a comment\n", odom("976052857.337531", 1.0, 3.0), flaser("976052858.5", ranges), packed=packed
    )
    counts = import_carmen(log, tmp_path / "out.mcap")
    assert (counts.scans, counts.odometry, counts.backward_stamps, counts.spread_stamps) == (1, 2, 0, 0)
    first, second, third = messages(tmp_path / "out.mcap")
    assert (first[0], second[0], third[0]) == ("/odom", "/odom", "/laser/primary/scan")
    assert first[1] == first[2] == to_ns(first[3].header.stamp) == 976052857337531000
    pose = first[3].pose.pose
    assert (pose.position.x, pose.position.y) == (1.0, 0.5)
    assert_allclose(2 * np.arctan2(pose.orientation.z, pose.orientation.w), 3.0)
    scan = third[3]
    assert_allclose(scan.ranges[[0, 2, 5]], [1.0, 79.99, 2.5], rtol=1e-6)
    assert np.isnan(scan.ranges[1])
    assert np.isposinf(scan.ranges[3:5]).all()
    assert read_info(tmp_path / "out.mcap").profile_toml is None


@pytest.mark.parametrize(
    ("beams", "step_deg", "last_deg"), [(180, 1, 89), (181, 1, 90), (360, 0.5, 89.5), (361, 0.5, 90)]
)
def test_beams_look_from_right_to_left(tmp_path: Path, beams: int, step_deg: float, last_deg: float) -> None:
    import_carmen(write(tmp_path, flaser("1", [1.0] * beams)), tmp_path / "out.mcap")
    scan = messages(tmp_path / "out.mcap")[1][3]
    assert_allclose(np.degrees([scan.angle_min, scan.angle_increment, scan.angle_max]), [-90, step_deg, last_deg])


def test_backward_stamps_are_kept_and_log_time_keeps_the_order(tmp_path: Path) -> None:
    log = write(tmp_path, odom("10.0", 1), odom("9.2", 2), flaser("9.4", [1.0] * 180, 3), odom("10.5", 4))
    assert import_carmen(log, tmp_path / "out.mcap").backward_stamps == 1
    got = messages(tmp_path / "out.mcap")
    assert [m[2] / 1e9 for m in got] == [10.0, 9.2, 9.4, 9.4, 10.5]
    assert [m[1] / 1e9 for m in got] == [10.0, 10.0, 10.0, 10.0, 10.5]
    assert [m[3].pose.pose.position.x for m in got if m[0] == "/odom"] == [1, 2, 3, 4]


def test_a_scan_repeating_its_odom_line_gives_one_odometry(tmp_path: Path) -> None:
    log = write(tmp_path, odom("1.0", 1), flaser("1.0", [1.0] * 180, 1))
    counts = import_carmen(log, tmp_path / "out.mcap")
    assert (counts.scans, counts.odometry) == (1, 1)


def test_rounded_stamps_are_spread_in_order(tmp_path: Path) -> None:
    lines = [odom("5", x) for x in range(4)] + [flaser("5", [1.0] * 180, 3)]
    lines += [odom("5.2", x) for x in range(4, 8)] + [flaser("100", [1.0] * 180, 8), odom("100", 9)]
    counts = import_carmen(write(tmp_path, *lines), tmp_path / "out.mcap")
    got = [m[2] / 1e9 for m in messages(tmp_path / "out.mcap") if m[0] == "/odom"]
    # 0.2 s hold four instants, the scan being one with its ODOM line; the gap of 94.8 s is filled no wider than 0.1 s
    assert_allclose(got, [5, 5.05, 5.1, 5.15, 5.2, 5.3, 5.4, 5.5, 100, 100.1])
    assert counts.spread_stamps == 8


@pytest.mark.parametrize(
    ("stamps", "told"),
    [
        (["5", "6", "5.9"], "1 lines are stamped earlier than the one before"),
        (["5", "5", "5", "5", "6"], "3 lines had rounded stamps and are spread out"),
    ],
)
def test_the_command_tells_which_stamps_are_no_good(tmp_path: Path, stamps: list[str], told: str) -> None:
    log = write(tmp_path, *(odom(t, x) for x, t in enumerate(stamps)), flaser("7", [1.0] * 180, 6))
    command = [sys.executable, "-m", "processing.cli", "import", "carmen", log, "-o", tmp_path / "out.mcap"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, f"rtlog-atlas: {told}\n")


def test_l_lines_are_centimetres_and_tell_the_mount(tmp_path: Path) -> None:
    theta, laser = np.pi / 2, "100 225"
    line = f"L 100 200 {theta} {laser} {theta} {' '.join(['300'] * 179)} 8183 0.25\n"
    counts = import_carmen(write(tmp_path, "O 99 200 0 0.1\n", line), tmp_path / "out.mcap")
    assert counts.skipped == {"O": 1}
    odometry, scan = (m[3] for m in messages(tmp_path / "out.mcap"))
    assert_allclose([odometry.pose.pose.position.x, odometry.pose.pose.position.y], [1.0, 2.0])
    assert_allclose(scan.ranges[:179], 3.0)
    assert np.isposinf(scan.ranges[179])
    profile = parse_profile(read_info(tmp_path / "out.mcap").profile_toml or "", "test")
    assert (profile.lasers.primary.mount.x_m, profile.lasers.primary.mount.yaw_deg) == (0.25, 0.0)


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (["ODOM 1 2\n"], "line 1: ODOM: 2 fields"),
        (["# x\n", odom("nan")], "line 2: ODOM: the time is no number"),
        ([odom("-1")], "line 1: ODOM: the time -1 lies outside"),
        ([odom("1").replace("0.5", "inf")], "line 1: ODOM: the pose"),
        ([flaser("1", [1.0] * 180), flaser("2", [1.0] * 170)], "line 2: FLASER: 170 beams"),
        ([flaser("1", [1.0] * 180).replace("1.0 ", "", 1)], "line 1: FLASER: 189 fields"),
        ([flaser("1", [1.0] * 180).replace("1.0 ", "x ", 1)], "line 1: FLASER: could not convert"),
        (["L 1 2 3\n"], "line 1: L: 3 fields"),
        ([odom("1"), "PARAM a b\n"], "no FLASER or L line.*PARAM"),
        (["\x89PNG\r\n"], "no FLASER or L line"),
        ([""], "no FLASER or L line"),
    ],
)
def test_bad_logs_are_refused_and_leave_nothing(tmp_path: Path, lines: list[str], complaint: str) -> None:
    with pytest.raises(BadInputError, match=complaint) as caught:
        import_carmen(write(tmp_path, *lines), tmp_path / "out.mcap")
    assert "\n" not in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.log"]


def test_cut_gzip_and_missing_files_are_refused(tmp_path: Path) -> None:
    log = write(tmp_path, *[odom(str(t), t**0.5) for t in range(500)], packed=True)
    log.write_bytes(log.read_bytes()[:-200])
    with pytest.raises(BadInputError, match="cut off or damaged"):
        import_carmen(log, tmp_path / "out.mcap")
    with pytest.raises(BadInputError, match="No such file"):
        import_carmen(tmp_path / "none.log", tmp_path / "out.mcap")


def test_same_log_same_bytes(tmp_path: Path) -> None:
    log = write(tmp_path, odom("1"), flaser("2", [1.0] * 181))
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        import_carmen(log, tmp_path / folder / "out.mcap")
    assert (tmp_path / "a/out.mcap").read_bytes() == (tmp_path / "b/out.mcap").read_bytes()


@pytest.mark.skipif(not REAL.exists(), reason="the real logs in ../shared/data/carmen are not here")
@pytest.mark.parametrize(
    ("name", "scans", "odometry", "backward", "spread"),
    [
        ("intel-merged-raw", 7819, 13610, 1022, 0),
        ("belgioioso-raw", 395, 4047, 0, 4441),
        ("freiburg-101-raw", 292, 4277, 0, 0),
        ("wean-robotdata1", 713, 713, 0, 0),
    ],
)
def test_real_logs(tmp_path: Path, name: str, scans: int, odometry: int, backward: int, spread: int) -> None:
    counts = import_carmen(REAL / f"{name}.log.gz", tmp_path / "out.mcap")
    assert (counts.scans, counts.odometry, counts.backward_stamps, counts.spread_stamps) == (
        scans,
        odometry,
        backward,
        spread,
    )
    info = read_info(tmp_path / "out.mcap")
    assert info.message_counts == {"/laser/primary/scan": scans, "/odom": odometry}
    assert (info.profile_toml is not None) == name.startswith("wean")

"""Simulated recordings: readable by anyone, true to the walls, the same bytes every time, whole or not there."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from hw_profiles.profile import load_profile
from processing.simulation import simulate as simulate_module
from processing.simulation.simulate import build_drive, build_space, clearance, simulate
from processing.simulation.world import parse_world, read_world_text
from rtlog_client.log_file import read_info, read_messages
from rtlog_server.messages import OK, STALE, decode, to_ns

Array = NDArray[np.float64]

WORLD = """
schema = 1
name = "small"
seed = 3
profile = "canmet_trailer"
[walls]
roughness_m = 0.15
[[drifts]]
points = [[0, 0], [30, 0], [30, 20]]
width_m = 4.6
[[tags]]
epc = "E20034120000000000000001"
at = [12, 1]
[[tags]]
epc = "E20034120000000000000002"
at = [30, 12]
unread_by = ["back"]
[[runs]]
name = "there"
waypoints = [[3, 0], [30, 0], [30, 16]]
speed_m_s = 2.5
[[runs]]
name = "back"
waypoints = [[30, 16], [30, 0], [3, 0]]
speed_m_s = 2.5
[noise]
wheel_radius_error_percent = { left_wheel = 1.0, right_wheel = 0.8 }
slip_m_per_sqrt_m = 0.005
dropped_scan_probability = 0.05
dropped_tick_probability = 0.05
"""


@pytest.fixture(scope="module")
def world_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("world") / "small.toml"
    path.write_text(WORLD)
    return path


@pytest.fixture(scope="module")
def noisy(world_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("noisy") / "out"
    simulate(world_path, folder)
    return folder


@pytest.fixture(scope="module")
def clean(world_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clean") / "out"
    simulate(world_path, folder, noise=False)
    return folder


def truth(path: Path) -> dict[int, Array]:
    """Poses x, y, heading by stamp in nanoseconds."""
    poses = {}
    for line in path.read_text().splitlines():
        stamp, x, y, z, qx, qy, qz, qw = line.split()
        seconds, nanoseconds = stamp.split(".")
        assert (z, qx, qy, len(nanoseconds)) == ("0", "0", "0", 9)
        poses[int(seconds + nanoseconds)] = np.array([float(x), float(y), 2 * np.arctan2(float(qz), float(qw))])
    return poses


def decoded(path: Path, topic: str) -> list:
    return [decode(m.data, m.msgtype) for m in read_messages(path, [topic])]


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def test_the_folder_holds_recordings_truth_and_world(noisy: Path) -> None:
    names = ["small-back.mcap", "small-back.tum", "small-there.mcap", "small-there.tum"]
    assert [path.name for path in sorted(noisy.iterdir())] == [*names, "tags.csv", "walls.csv", "world.toml"]
    assert (noisy / "world.toml").read_text() == WORLD
    assert (noisy / "tags.csv").read_text().splitlines()[:2] == ["epc,x,y", "E20034120000000000000001,12.0000,1.0000"]
    assert (noisy / "walls.csv").read_text().startswith("x1,y1,x2,y2\n")


def test_a_recording_says_what_the_contract_asks(clean: Path) -> None:
    info = read_info(clean / "small-there.mcap")
    assert info.run_id == "small-there"
    assert {"vehicle", "profile", "boot_id", "software"} <= set(info.metadata)
    assert info.profile_toml is not None
    assert "canmet_trailer" in info.profile_toml
    ticks = info.message_counts["/rtlog/tick"]
    topics = ("/rtlog/tick", "/laser/primary/scan", "/encoders/joint_states", "/rfid/tags")
    assert info.message_counts == dict.fromkeys(topics, ticks)
    for message in read_messages(clean / "small-there.mcap"):
        assert message.publish_time_ns == to_ns(decode(message.data, message.msgtype).header.stamp)
        assert -1_000_000 < message.log_time_ns - message.publish_time_ns < 40_000_000
        assert (message.log_time_ns - info.start_ns) % 100_000_000 == 0


def test_truth_covers_every_stamp(noisy: Path) -> None:
    for run in ("there", "back"):
        poses = truth(noisy / f"small-{run}.tum")
        messages = list(read_messages(noisy / f"small-{run}.mcap"))
        assert {m.log_time_ns for m in messages} <= set(poses)
        sensors = ("/laser/primary/scan", "/encoders/joint_states")
        assert {m.publish_time_ns for m in messages if m.topic in sensors} <= set(poses)
        assert list(poses) == sorted(poses)


def test_what_the_laser_sees_are_the_walls(clean: Path) -> None:
    walls = np.loadtxt(clean / "walls.csv", delimiter=",", skiprows=1)
    tree = shapely.STRtree(shapely.linestrings(walls.reshape(-1, 2, 2)))
    poses = truth(clean / "small-there.tum")
    mount = load_profile("canmet_trailer").lasers.primary.mount
    distances = []
    for scan in decoded(clean / "small-there.mcap", "/laser/primary/scan")[:15]:  # still standing
        x, y, heading = poses[to_ns(scan.header.stamp)]
        laser = np.array([x + mount.x_m * np.cos(heading), y + mount.x_m * np.sin(heading)])
        angles = heading + np.radians(mount.yaw_deg) + scan.angle_min + np.arange(541) * scan.angle_increment
        points = (laser + scan.ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))[
            np.isfinite(scan.ranges)
        ]
        distances.append(tree.query_nearest(shapely.points(points), return_distance=True, all_matches=False)[1])
    assert len(np.concatenate(distances)) > 5000
    assert np.concatenate(distances).max() < 6e-4  # half a millimetre of rounding


def test_wheels_and_truth_tell_the_same_way(clean: Path) -> None:
    poses = truth(clean / "small-there.tum")
    joints = decoded(clean / "small-there.mcap", "/encoders/joint_states")
    rolled = 0.35 * np.array([joint.position for joint in joints])
    position = np.array([poses[to_ns(joint.header.stamp)] for joint in joints])
    way = np.sum(np.hypot(*np.diff(position[:, :2], axis=0).T))
    assert np.mean(rolled[-1] - rolled[0]) == pytest.approx(way, abs=0.02)
    assert np.diff(rolled[-1] - rolled[0])[0] / 1.6 == pytest.approx(position[-1, 2] - position[0, 2], abs=1e-3)


def test_noise_is_in_the_sensors_and_not_in_the_drive(noisy: Path, clean: Path) -> None:
    assert (noisy / "small-there.tum").read_bytes() == (clean / "small-there.tum").read_bytes()
    assert (noisy / "walls.csv").read_bytes() == (clean / "walls.csv").read_bytes()
    rolled = [
        np.mean(np.ptp([joint.position for joint in decoded(folder / "small-there.mcap", "/encoders/joint_states")], 0))
        for folder in (noisy, clean)
    ]
    assert rolled[0] / rolled[1] == pytest.approx(1 / 1.009, abs=2e-3)


def test_losses_are_holes_that_can_be_counted(noisy: Path) -> None:
    ticks = [tick.index for tick in decoded(noisy / "small-there.mcap", "/rtlog/tick")]
    assert 0 < ticks[-1] + 1 - len(ticks) < 0.15 * ticks[-1]
    sequences = [m.sequence for m in read_messages(noisy / "small-there.mcap", ["/rtlog/tick"])]
    assert sequences == ticks
    info = read_info(noisy / "small-there.mcap")
    assert 0.85 * len(ticks) < info.message_counts["/laser/primary/scan"] < len(ticks)


def test_tags_are_read_near_them_by_those_who_can(noisy: Path) -> None:
    places = {"E20034120000000000000001": (12, 1), "E20034120000000000000002": (30, 12)}
    for run, expected in (("there", set(places)), ("back", {"E20034120000000000000001"})):
        poses = truth(noisy / f"small-{run}.tum")
        stamps, known = np.array(list(poses)), np.array(list(poses.values()))
        seen = set()
        for message in decoded(noisy / f"small-{run}.mcap", "/rfid/tags"):
            for read in message.reads:
                pose = known[np.argmin(np.abs(stamps - to_ns(read.stamp)))]
                assert np.hypot(*(pose[:2] - places[read.epc])) < 3.0 + 0.2
                assert 1 <= read.count <= 3
                seen.add(read.epc)
        assert seen == expected


def test_the_same_world_gives_the_same_bytes(world_path: Path, noisy: Path, tmp_path: Path) -> None:
    simulate(world_path, tmp_path / "again")
    assert digests(tmp_path / "again") == digests(noisy)
    results = simulate(world_path, tmp_path / "one", runs=["back"])
    assert [result.path for result in results] == [tmp_path / "one" / "small-back.mcap"]
    assert digests(tmp_path / "one")["small-back.mcap"] == digests(noisy)["small-back.mcap"]
    simulate(world_path, tmp_path / "other", seed=4)
    other = digests(tmp_path / "other")
    assert all(other[name] != digests(noisy)[name] for name in ("small-there.mcap", "small-there.tum", "walls.csv"))


HAZARDS = """
[[hazards]]
kind = "stuck"
run = "there"
[[hazards]]
kind = "odometry_missing"
run = "there"
at_s = 4.0
[[hazards]]
kind = "wrong_mount"
[[hazards]]
kind = "changed_walls"
"""


def test_hazards_are_in_the_recordings_and_not_in_the_truth(world_path: Path, noisy: Path, tmp_path: Path) -> None:
    struck = tmp_path / "struck.toml"
    struck.write_text(WORLD + HAZARDS)
    for folder in ("out", "again"):
        simulate(struck, tmp_path / folder)
    assert digests(tmp_path / "out") == digests(tmp_path / "again")
    for run in ("there", "back"):
        name = f"small-{run}"
        assert (tmp_path / "out" / f"{name}.tum").read_bytes() == (noisy / f"{name}.tum").read_bytes()
        profiles = [read_info(folder / f"{name}.mcap").profile_toml for folder in (tmp_path / "out", noisy)]
        assert profiles[0] == profiles[1]
    gone = dict.fromkeys(("there", "back"), 0)
    for run in gone:
        counts = [read_info(f / f"small-{run}.mcap").message_counts for f in (noisy, tmp_path / "out")]
        gone[run] = counts[0]["/encoders/joint_states"] - counts[1]["/encoders/joint_states"]
    assert 25 <= gone["there"] <= 30
    assert gone["back"] == 0
    ticks = decoded(tmp_path / "out" / "small-there.mcap", "/rtlog/tick")
    states = {tick.index: {each.name: each.state for each in tick.sensors}["encoders"] for tick in ticks}
    assert {state for k, state in states.items() if k < 40} == {OK}
    assert {state for k, state in states.items() if 45 <= k <= 70} == {STALE}
    assert len((tmp_path / "out" / "walls.csv").read_text()) > len((noisy / "walls.csv").read_text())


def test_each_run_may_have_a_vehicle_of_its_own(world_path: Path, tmp_path: Path) -> None:
    both = tmp_path / "both.toml"
    both.write_text(WORLD.replace('name = "back"', 'name = "back"\nprofile = "cu_ss534"'))
    simulate(both, tmp_path / "out")
    names = {run: read_info(tmp_path / "out" / f"small-{run}.mcap").metadata["profile"] for run in ("there", "back")}
    assert names == {"there": "canmet_trailer", "back": "cu_ss534"}
    joints = decoded(tmp_path / "out" / "small-back.mcap", "/encoders/joint_states")
    assert joints[0].name == ["drive_wheel", "steering"]


def test_an_existing_output_is_left_alone(world_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(BadInputError, match="out exists already"):
        simulate(world_path, out)
    assert list(tmp_path.rglob("*")) == [out]


def test_a_failure_leaves_nothing(world_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(run: str, done: int, count: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(world_path, tmp_path / "out", on_progress=interrupted)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(BadInputError, match="no run nowhere; there are there, back"):
        simulate(world_path, tmp_path / "out", runs=["nowhere"])


@dataclass(frozen=True)
class Shipped:
    """What the comment at the head of a shipped world says of it."""

    drifts_m: float
    driven_m: float
    tags: int
    runs: int


SHIPPED = {
    "demo": Shipped(drifts_m=629, driven_m=902, tags=10, runs=2),
    "dusty": Shipped(drifts_m=148, driven_m=330, tags=4, runs=2),
    "loop": Shipped(drifts_m=287, driven_m=580, tags=6, runs=1),
    "mine_level": Shipped(drifts_m=987, driven_m=2556, tags=13, runs=3),
    "missed_tag": Shipped(drifts_m=269, driven_m=628, tags=5, runs=2),
    "slip": Shipped(drifts_m=161, driven_m=306, tags=5, runs=2),
    "straight": Shipped(drifts_m=416, driven_m=788, tags=2, runs=1),
    "tunnels": Shipped(drifts_m=3062, driven_m=7893, tags=28, runs=7),
    "two_drifts": Shipped(drifts_m=243, driven_m=569, tags=2, runs=2),
    "vehicles": Shipped(drifts_m=211, driven_m=459, tags=5, runs=3),
}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_worlds_are_what_they_say(name: str) -> None:
    world, said = parse_world(read_world_text(name), name), SHIPPED[name]
    lines = [shapely.LineString([world.point(place) for place in drift.points]) for drift in world.drifts]
    assert sum(line.length for line in lines) == pytest.approx(said.drifts_m, abs=1)
    assert (len(world.tags), len(world.runs)) == (said.tags, said.runs)
    space = build_space(world, world.seed)
    assert len(shapely.get_parts(space)) == 1
    drives = {run.name: build_drive(world, run, world.seed, space) for run in world.runs}
    assert sum(drive.length_m for drive in drives.values()) == pytest.approx(said.driven_m, abs=3)
    for drive in drives.values():
        assert clearance(drive.pose[::10, :2], space).min() > 0.8
        assert np.abs(drive.curvature).max() < 1 / 2.5
    for tag in world.tags:  # every tag is passed well within its range, and no other tag is heard there
        near = [np.hypot(*(drive.pose[:, :2] - world.point(tag.at)).T).min() for drive in drives.values()]
        assert min(near) < tag.read_range_m - 0.3
        others = [other for other in world.tags if other is not tag]
        apart = [np.hypot(*np.subtract(world.point(tag.at), world.point(other.at))) for other in others]
        assert min(apart) > 3 * tag.read_range_m


def test_the_demo_world_suits_the_demo(tmp_path: Path) -> None:
    results = {result.path.stem: result for result in simulate("demo", tmp_path / "demo")}
    first = results["demo-first"]
    assert 65 < first.duration_s < 75
    reads = {name: decoded(result.path, "/rfid/tags") for name, result in results.items()}
    epcs = {name: {read.epc[-2:] for message in found for read in message.reads} for name, found in reads.items()}
    assert epcs["demo-first"] == {"01", "02", "03"}
    assert epcs["demo-rest"] == {"01", "03", "04", "05", "06", "07", "08", "09", "0A"}
    in_spur = [k for k, message in enumerate(reads["demo-rest"]) if any(r.epc.endswith("0A") for r in message.reads)]
    assert in_spur[-1] - in_spur[0] < 40  # one pass: on the way out the tag was missed


def test_runs_start_on_stamps_of_their_own(noisy: Path) -> None:
    start = {run: read_info(noisy / f"small-{run}.mcap").start_ns for run in ("there", "back")}
    assert start["back"] - start["there"] == pytest.approx(simulate_module.BETWEEN_RUNS_NS, abs=1e9)

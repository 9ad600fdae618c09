"""What is wrong with the input is said in one clear line with exit status 2; nothing is written and nothing is lost.

The commands that map, as their users call them. Those of the server and the client are tested beside their programs.
"""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import processing.cli
import rtlog_client.cli
import rtlog_server.cli
from hw_profiles.profile import read_profile_text
from processing.build import Config, build
from rtlog_client.log_file import LogWriter
from rtlog_server.messages import JointState, LaserScan, TagReads, Tick, encode, header, to_time
from rtlog_server.topics import BY_NAME, JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

START_NS = 1_767_592_800 * 10**9
PROFILE = read_profile_text("canmet_trailer")
WORLD = """
schema = 1
name = "short"
profile = "canmet_trailer"
drifts = [{ points = [[0, 0], [30, 0]], width_m = 5.0 }]
runs = [{ name = "there", waypoints = [[5, 0], [25, 0]], speed_m_s = 2.0 }]
"""
MAIN = {
    "rtlog-atlas": processing.cli.main,
    "rtlog-client": rtlog_client.cli.main,
    "rtlog-server": rtlog_server.cli.main,
}


def record(path: Path, profile: str | None = PROFILE, without: str = "") -> None:
    """Three seconds of standing in a drift."""
    nothing = np.empty(0)
    ranges = (2.5 / np.maximum(np.abs(np.sin(np.radians(np.arange(-135, 135.5, 0.5)))), 0.2)).astype(np.float32)
    with LogWriter(path, {"vehicle": "trailer"}, profile) as log:
        for k in range(30):
            at = START_NS + k * 10**8
            messages = {
                TICK: Tick(header(at, ""), k, to_time(at), 0.0, []),
                PRIMARY_SCAN: LaserScan(
                    header(at, "laser_primary"),
                    -2.356,
                    2.356,
                    0.00873,
                    2e-5,
                    0.02,
                    0.1,
                    20,
                    ranges,
                    np.float32(nothing),
                ),
                JOINT_STATES: JointState(header(at, ""), ["left_wheel", "right_wheel"], np.zeros(2), nothing, nothing),
                TAGS: TagReads(header(at, "rfid"), []),
            }
            for topic, message in messages.items():
                if topic.name != without:
                    log.write(topic.name, BY_NAME[topic.name].msgtype, encode(message), at, at)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good and bad input of every kind."""
    folder = tmp_path_factory.mktemp("input")
    record(folder / "good.mcap")
    record(folder / "bare.mcap", profile=None)
    record(folder / "old.mcap", profile=PROFILE.replace("track_width_m", "track_m"))
    record(folder / "blind.mcap", without=PRIMARY_SCAN.name)
    record(folder / "wheelless.mcap", without=JOINT_STATES.name)
    whole = (folder / "good.mcap").read_bytes()
    middle = len(whole) // 2
    (folder / "copy.mcap").write_bytes(whole)
    (folder / "cut.mcap").write_bytes(whole[: 2 * middle // 3])
    (folder / "tail.mcap").write_bytes(whole[:-1])
    (folder / "bent.mcap").write_bytes(whole[:middle] + bytes([whole[middle] ^ 0x55]) + whole[middle + 1 :])
    (folder / "text.mcap").write_text("dear diary\n" * 100)
    (folder / "empty.mcap").touch()
    (folder / "folder.mcap").mkdir()
    (folder / "typo.toml").write_text(PROFILE.replace("track_width_m", "track_wdith_m"))
    (folder / "prose.toml").write_text("wheels: two")
    (folder / "world.toml").write_text(WORLD)
    (folder / "typo_world.toml").write_text(WORLD.replace("speed_m_s", "sped_m_s"))
    (folder / "carmen.log").write_text(f"FLASER 180 {'2.5 ' * 180}0 0 0 0 0 0 976052857.3 host 0.1\n")
    (folder / "log.gz").write_bytes(b"\x1f\x8b\x08 no, not really")
    build([folder / "good.mcap"], None, Config(), folder / "good.atlas")
    (folder / "there.atlas").mkdir()
    (folder / "there.atlas" / "atlas.json").write_text("dear to someone")
    (folder / "new.atlas").mkdir()
    (folder / "new.atlas" / "atlas.json").write_text('{"schema": 99}')
    return folder


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """The commands take SIGTERM, and what destructors swallow, for themselves."""
    handler, hook = signal.getsignal(signal.SIGTERM), sys.unraisablehook
    yield
    signal.signal(signal.SIGTERM, handler)
    sys.unraisablehook = hook


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    paths = sorted(folder.rglob("*"))
    return {str(path): (path.read_bytes() if path.is_file() else b"", path.stat().st_mtime_ns) for path in paths}


BUILD = "rtlog-atlas build good.mcap -o a.atlas"
CASES = [
    # a wrong profile
    (f"{BUILD} --profile typo.toml", r"profile typo\.toml: unknown key vehicle\.track_wdith_m; .* track_width_m"),
    (f"{BUILD} --profile prose.toml", r"profile prose\.toml: not TOML: .*line 1, column 7\)"),
    (
        f"{BUILD} --profile canmet",
        r"profile canmet: No such file or directory; shipped profiles are .*canmet_trailer.*",
    ),
    (
        "rtlog-atlas build old.mcap -o a.atlas",
        r"profile inside old\.mcap: unknown key vehicle\.track_m; .*track_width_m",
    ),
    ("rtlog-atlas build bare.mcap -o a.atlas", r"bare\.mcap: .*no profile.*--profile"),
    ("rtlog-server run --profile canmet", r"profile canmet: No such file or directory; shipped profiles are .*"),
    ("rtlog-server check --profile canmet", r"profile canmet: No such file or directory; shipped profiles are .*"),
    # what is no whole recording
    ("rtlog-atlas build text.mcap -o a.atlas", r"text\.mcap: not an MCAP recording"),
    ("rtlog-atlas build log.gz -o a.atlas", r"log\.gz: not an MCAP recording"),
    ("rtlog-atlas build empty.mcap -o a.atlas", r"empty\.mcap: the file is empty"),
    ("rtlog-atlas build none.mcap -o a.atlas", r"none\.mcap: No such file or directory"),
    ("rtlog-atlas build folder.mcap -o a.atlas", r"folder\.mcap: Is a directory"),
    (
        "rtlog-atlas build cut.mcap -o a.atlas",
        r"cut\.mcap: cut off or damaged \(\w+\); rtlog-client recover cut\.mcap.*",
    ),
    ("rtlog-atlas build tail.mcap -o a.atlas", r"tail\.mcap: cut off or damaged \(\w+\); rtlog-client recover tail.*"),
    ("rtlog-atlas build bent.mcap -o a.atlas", r"bent\.mcap: cut off or damaged \(\w+\); rtlog-client recover bent.*"),
    ("rtlog-atlas build good.mcap cut.mcap -o a.atlas", r"cut\.mcap: cut off or damaged .*"),
    # a recording of something else
    ("rtlog-atlas build blind.mcap -o a.atlas", r"blind\.mcap: no laser scans .*there is nothing to map"),
    ("rtlog-atlas build good.mcap blind.mcap -o a.atlas --jobs 2", r"blind\.mcap: no laser scans .*"),
    (
        "rtlog-atlas build wheelless.mcap -o a.atlas",
        r"wheelless\.mcap: neither /encoders.* nor /odom; the motion is unknown",
    ),
    (f"{BUILD} --profile cu_ss534", r"good\.mcap: no message on /encoders/joint_states holds a reading of .*"),
    # the same one twice
    ("rtlog-atlas build good.mcap good.mcap -o a.atlas", r"good\.mcap is named twice"),
    (
        "rtlog-atlas build good.mcap copy.mcap -o a.atlas",
        r"good\.mcap and copy\.mcap hold the same time of run good; which .*",
    ),
    # where the output cannot go
    ("rtlog-atlas build good.mcap -o there.atlas", r"there\.atlas exists already; it is left as it is"),
    ("rtlog-atlas build none.mcap -o there.atlas", r"there\.atlas exists already; .*"),  # told before any work
    ("rtlog-atlas build good.mcap -o good.mcap", r"good\.mcap exists already; it is left as it is"),
    ("rtlog-atlas build good.mcap -o none/a.atlas", r"none: no such folder"),
    ("rtlog-atlas simulate world.toml -o there.atlas", r"there\.atlas exists already; it is left as it is"),
    ("rtlog-atlas import carmen carmen.log -o good.mcap", r"good\.mcap exists already; it is left as it is"),
    ("rtlog-client recover cut.mcap -o good.mcap", r"good\.mcap exists already.*"),
    # other verbs, other files
    ("rtlog-atlas simulate moon -o w", r"world moon: No such file or directory; shipped worlds are .*loop.*"),
    (
        "rtlog-atlas simulate typo_world.toml -o w",
        r"world typo_world\.toml: unknown key runs\[0\]\.sped_m_s; .*speed_m_s",
    ),
    ("rtlog-atlas simulate world.toml -o w --run back", r"world world\.toml: no run back; there are there"),
    ("rtlog-atlas import carmen none.log -o b.mcap", r"none\.log: No such file or directory"),
    ("rtlog-atlas import carmen log.gz -o b.mcap", r"log\.gz: the gzip stream is cut off or damaged .*"),
    ("rtlog-atlas import carmen text.mcap -o b.mcap", r"text\.mcap: no FLASER or L line, .*"),
    ("rtlog-atlas import carmen carmen.log -o none/b.mcap", r".*none.*: No such file or directory"),
    ("rtlog-atlas info none.atlas", r"none\.atlas: no atlas here \(No such file or directory\)"),
    ("rtlog-atlas info good.mcap", r"good\.mcap: no atlas here \(Not a directory\)"),
    ("rtlog-atlas info there.atlas", r"there\.atlas/atlas\.json: not JSON.*"),
    ("rtlog-atlas info new.atlas", r"new\.atlas/atlas\.json: schema is not 1; another version of rtlog-atlas wrote it"),
    ("rtlog-atlas compare good.atlas", r"compare with what\? --truth DIR or --relations FILE"),
    ("rtlog-atlas compare none.atlas --truth .", r"none\.atlas: no atlas here \(No such file or directory\)"),
    ("rtlog-atlas compare good.atlas --truth none", r"none: holds no truth of good .*"),
    ("rtlog-atlas compare good.atlas --truth good.mcap", r"good\.mcap: holds no truth of good .*"),
    ("rtlog-atlas compare good.atlas --relations none", r"none: No such file or directory"),
    ("rtlog-atlas compare good.atlas --relations typo.toml", r"typo\.toml, line 2: .*"),
    ("rtlog-atlas compare none.atlas --relations log.gz", r"none\.atlas: no atlas here \(No such file or directory\)"),
]


@pytest.mark.parametrize(("line", "complaint"), CASES, ids=[line for line, _ in CASES])
def test_one_clear_line(
    files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], line: str, complaint: str
) -> None:
    monkeypatch.chdir(files)
    before = contents(files)
    program, *arguments = line.split()
    assert MAIN[program](arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert re.fullmatch(f"{program}: {complaint}\n", output.err), output.err
    assert contents(files) == before


@pytest.mark.parametrize("line", ["rtlog-atlas build cut.mcap -o a.atlas", "rtlog-atlas simulate moon -o w"])
def test_the_programs_themselves_say_the_same(files: Path, line: str) -> None:
    before = contents(files)
    program, *arguments = line.split()
    command = [Path(sys.executable).with_name(program), *arguments]
    result = subprocess.run(command, cwd=files, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert re.fullmatch(f"{program}: {dict(CASES)[line]}\n", result.stderr), result.stderr
    assert contents(files) == before


def test_good_input_is_good(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without this, each refusal above might be for a reason of its own."""
    assert processing.cli.main(["build", f"{files}/good.mcap", "-o", f"{tmp_path}/a.atlas"]) == 0
    assert processing.cli.main(["simulate", f"{files}/world.toml", "-o", f"{tmp_path}/w"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.atlas", "w"]
    bare = ["build", f"{files}/bare.mcap", "-o", f"{tmp_path}/b.atlas", "--profile", "canmet_trailer"]
    assert processing.cli.main(bare) == 0

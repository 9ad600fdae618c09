"""`rtlog-atlas` as a user meets it: help at once, answers for scripts, and an end without remains when interrupted."""

import json
import os
import re
import select
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from patience import PATIENCE_S, wait_until

COMMAND = [sys.executable, "-m", "processing.cli"]
VERBS = ["build", "info", "report", "compare", "simulate", "import"]
HEAVY = ("numba", "numpy", "PIL", "scipy", "shapely", "zenoh", "tqdm", "mcap")


def run(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *arguments], cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("verb", VERBS)
def test_help_has_an_example_and_does_not_wait_for_compilers_and_solvers(verb: str) -> None:
    script = (
        "import sys, atexit, processing.cli\n"
        f"atexit.register(lambda: print('loaded:', *[name for name in {HEAVY} if name in sys.modules]))\n"
        f"processing.cli.main([{verb!r}, '--help'])\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert f"example:\n  rtlog-atlas {verb} " in result.stdout
    assert result.stdout.splitlines()[-1].strip() == "loaded:"


def test_help_lists_the_verbs() -> None:
    result = run("--help")
    assert result.returncode == 0
    assert all(f"\n    {verb} " in result.stdout for verb in VERBS)


def test_the_command_is_installed() -> None:
    program = Path(sys.executable).with_name("rtlog-atlas")
    result = subprocess.run([program, "info", "--help"], capture_output=True, text=True, check=False)
    assert result.returncode == 0
    assert "usage: rtlog-atlas info" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "which verb?"),
        (["paint"], "invalid choice: 'paint'"),
        (["build", "-o", "a.atlas"], "required: RUN.mcap"),
        (["build", "a.mcap"], "required: -o/--output"),
        (["build", "a.mcap", "-o", "a.atlas", "--jobs", "0"], "0 is no number of processes"),
        (["build", "a.mcap", "-o", "a.atlas", "--jobs", "two"], "two is no number of processes"),
        (["build", "a.mcap", "-o", "a.atlas", "--matcher", "icp"], "invalid choice: 'icp'"),
        (["import", "rosbag", "a.bag", "-o", "a.mcap"], "invalid choice: 'rosbag'"),
    ],
)
def test_wrong_usage_is_status_2(tmp_path: Path, arguments: list[str], complaint: str) -> None:
    result = run(*arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert complaint in result.stderr.splitlines()[-1]
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())


def test_info_tells_what_is_in_an_atlas(small_atlas: Path) -> None:
    result = run("info", small_atlas)
    assert (result.returncode, result.stderr) == (0, "")
    kinds = [line.split()[0] for line in result.stdout.splitlines()]
    assert [kinds.count(kind) for kind in ("run", "node", "edge", "spur")] == [2, 4, 4, 5]
    assert "run   small-around: 756 ticks, profile canmet_trailer" in result.stdout
    assert "E20034120000000000000401" in result.stdout


def test_info_for_scripts_is_all_of_atlas_json(small_atlas: Path) -> None:
    result = run("info", small_atlas, "--json")
    assert json.loads(result.stdout) == json.loads((small_atlas / "atlas.json").read_text())


def test_build_tells_what_it_made_and_leaves_nothing_else(small_world: Path, tmp_path: Path) -> None:
    recording = small_world / "small-back.mcap"
    result = run("build", recording, "-o", tmp_path / "a.atlas", "--method", "global", "--json")
    assert result.returncode == 0
    summary = json.loads(result.stdout)
    assert summary.pop("seconds") > 0
    counts = {kind: summary.pop(kind) for kind in ("convictions", "left_out", "remarks")}
    assert sum(counts.values()) == len(result.stderr.splitlines())
    made = {"atlas": f"{tmp_path}/a.atlas", "runs": 1, "nodes": 0, "edges": 0, "parts": 1, "rests_on_little": []}
    assert summary == made
    assert all(line.startswith("rtlog-atlas: run small-back ") for line in result.stderr.splitlines())
    assert [path.name for path in tmp_path.iterdir()] == ["a.atlas"]


FINISHING = """
import json, sys
import processing.build
from pathlib import Path
from processing.atlas import Atlas
from processing.cli import main

document = json.loads((Path(sys.argv[1]) / "atlas.json").read_text())
processing.build.build = lambda *_: Atlas(document, {})
sys.exit(main(["build", "a.mcap", "-o", sys.argv[1]]))
"""


def finish(atlas: Path, document: dict[str, Any]) -> subprocess.CompletedProcess[str]:
    """What `build` says in the end where the map that it made has this document."""
    atlas.mkdir()
    (atlas / "atlas.json").write_text(json.dumps(document))
    command = [sys.executable, "-c", FINISHING, atlas]
    return subprocess.run(command, capture_output=True, text=True, check=True)


def test_a_build_of_which_there_is_nothing_to_know_says_no_more(small_atlas: Path, tmp_path: Path) -> None:
    document = json.loads((small_atlas / "atlas.json").read_text()) | {"remarks": [], "left_out": []}
    said = finish(tmp_path / "a.atlas", document)
    assert said.stderr == ""
    assert said.stdout.endswith(f"; look at {tmp_path / 'a.atlas' / 'map.png'}\n")


def test_a_build_that_rests_on_little_is_no_plain_success(small_atlas: Path, tmp_path: Path) -> None:
    slips = [
        {"run": "small-back", "ticks": [k, k + 9], "what": "wheels", "how_much": "slip"} for k in range(0, 300, 10)
    ]
    document = json.loads((small_atlas / "atlas.json").read_text())
    said = finish(tmp_path / "a.atlas", document | {"convictions": slips, "remarks": ["the last thing to know"]})
    assert said.stderr.splitlines()[19:] == [
        "rtlog-atlas: run small-back, ticks 190 to 199: wheels not believed, slip",
        f"rtlog-atlas: 10 more convictions; rtlog-atlas info {tmp_path / 'a.atlas'} shows all",
        "rtlog-atlas: the last thing to know",
    ]
    assert said.stdout.endswith(", with 31 things to know above; it rests on little: 30 stretches not believed\n")
    notes = [line for line in run("info", tmp_path / "a.atlas").stdout.splitlines() if line.startswith("note")]
    assert len(notes) == 32
    assert notes[-1] == "note  the map rests on little: 30 stretches not believed"


@contextmanager
def building(recordings: Path, atlas: Path, jobs: int) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """A build on a terminal of its own, once it is at work, and its workers too; yields the terminal as well."""
    terminal, its_end = os.openpty()
    termios.tcsetwinsize(its_end, (24, 100))
    command = [*COMMAND, "build", *sorted(recordings.glob("*.mcap")), "-o", atlas, "--jobs", str(jobs)]
    with subprocess.Popen(command, stdout=its_end, stderr=its_end, start_new_session=True) as process:
        os.close(its_end)
        try:
            said = b""
            while b"runs:" not in said:
                assert select.select([terminal], [], [], PATIENCE_S)[0], said
                said += os.read(terminal, 4096)
            wait_until(lambda: len(workers_of(process.pid)) >= (jobs if jobs > 1 else 0))
            yield process, terminal
        finally:
            for left in session_of(process.pid):
                os.kill(left, signal.SIGKILL)
            os.close(terminal)


def workers_of(parent: int) -> list[int]:
    """The processes of a pool that have come as far as to load their compiler."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return [int(child) for child in children if "llvmlite" in Path(f"/proc/{child}/maps").read_text()]


def is_blocked(process: int, number: signal.Signals) -> bool:
    mask = re.search(r"SigBlk:\s*(\w+)", Path(f"/proc/{process}/status").read_text())
    assert mask is not None
    return bool(int(mask[1], 16) >> (number - 1) & 1)


def last_words(terminal: int) -> list[str]:
    """The lines that remain on the terminal until the program closes it; the bars were wiped out."""
    said = b""
    try:
        while select.select([terminal], [], [], PATIENCE_S)[0]:
            said += os.read(terminal, 4096)
    except OSError:  # EIO: nobody has the other end open any more
        pass
    lines = said.decode().replace("\x1b[A", "").splitlines()
    return [line for line in lines if line.strip() and "it/s]" not in line and "?it" not in line]


def session_of(leader: int) -> list[int]:
    """The processes that a program started, and itself, as long as they run."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, *_, session = stat.read_text().rpartition(")")[2].split()[:4]
        except OSError:  # it ended meanwhile
            continue
        if int(session) == leader and state != "Z":
            found.append(int(stat.parent.name))
    return found


def assert_alone(leader: int) -> None:
    wait_until(lambda: not session_of(leader), lambda: session_of(leader))


@pytest.mark.parametrize(
    ("number", "whole_group", "jobs"),
    [(signal.SIGINT, True, 2), (signal.SIGTERM, False, 2), (signal.SIGTERM, False, 1)],
    ids=["Ctrl-C", "SIGTERM", "SIGTERM alone"],
)
def test_an_interrupted_build_leaves_nothing_behind(
    small_world: Path, tmp_path: Path, number: int, whole_group: bool, jobs: int
) -> None:
    with building(small_world, tmp_path / "a.atlas", jobs) as (process, terminal):
        for worker in workers_of(process.pid):
            assert is_blocked(worker, signal.SIGINT)  # a Ctrl-C is the parent's business
            os.kill(worker, signal.SIGSTOP)  # busy with something that takes for ever
        (os.killpg if whole_group else os.kill)(process.pid, number)
        assert last_words(terminal) == ["rtlog-atlas: interrupted"]
        # 130, as a shell says it; CPython itself dies of SIGINT if that was handled within a string that it executed
        assert process.wait(timeout=PATIENCE_S) in (130, -signal.SIGINT)
        assert_alone(process.pid)
    assert not list(tmp_path.iterdir())


def test_a_process_that_dies_is_one_line(small_world: Path, tmp_path: Path) -> None:
    with building(small_world, tmp_path / "a.atlas", jobs=2) as (process, terminal):
        os.kill(workers_of(process.pid)[0], signal.SIGKILL)
        assert last_words(terminal) == [
            "rtlog-atlas: a process died, perhaps for want of memory; try fewer --jobs",
        ]
        assert process.wait(timeout=PATIENCE_S) == 1
        assert_alone(process.pid)
    assert not list(tmp_path.iterdir())


def test_a_program_that_is_killed_takes_its_processes_along(
    small_world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # nobody is left to clear away what is in there
    with building(small_world, tmp_path / "a.atlas", jobs=2) as (process, _):
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait(timeout=PATIENCE_S) == -signal.SIGKILL
        assert_alone(process.pid)
    assert not (tmp_path / "a.atlas").exists()


SWALLOWING = """
import os, signal, sys, time
from processing import cli

class Loading:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)

def verb(args):
    Loading()
    time.sleep(60)

cli._info = verb
sys.exit(cli.main(["info", "any.atlas"]))
"""


def test_an_interrupt_that_a_destructor_swallows_comes_again() -> None:
    command = [sys.executable, "-c", SWALLOWING]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (130, "rtlog-atlas: interrupted\n")

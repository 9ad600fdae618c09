"""Verbs: exit statuses, and one line for whatever went wrong. Run as real processes."""

import subprocess
import sys

import pytest

PROGRAM = """
import argparse, sys
from hw_profiles.command import add_verb, run_verbs
from hw_profiles.errors import BadInputError, RTLogError

def fail(kind):
    def verb(args):
        raise kind("a.toml: something\\nis wrong")
    return verb

def speak(args):
    for k in range(100000):
        print(k)

parser = argparse.ArgumentParser(prog="prog")
verbs = parser.add_subparsers(metavar="VERB")
add_verb(verbs, "good", lambda args: None, "do well", "prog good")
add_verb(verbs, "three", lambda args: 3, "give 3", "prog three")
add_verb(verbs, "bad", fail(BadInputError), "bad input", "prog bad")
add_verb(verbs, "broken", fail(RTLogError), "fail", "prog broken")
add_verb(verbs, "interrupted", fail(KeyboardInterrupt), "be interrupted", "prog interrupted")
add_verb(verbs, "speak", speak, "print a lot", "prog speak | head")
sys.exit(run_verbs(parser, None))
"""


def run(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", PROGRAM, *args], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("verb", "status", "stderr"),
    [
        ("good", 0, ""),
        ("three", 3, ""),
        ("bad", 2, "prog: a.toml: something is wrong\n"),
        ("broken", 1, "prog: a.toml: something is wrong\n"),
        ("interrupted", 130, "prog: interrupted\n"),
    ],
)
def test_a_verb_ends_with_its_status_and_at_most_one_line(verb: str, status: int, stderr: str) -> None:
    result = run(verb)
    assert (result.returncode, result.stdout, result.stderr) == (status, "", stderr)


def test_wrong_usage_is_status_2() -> None:
    assert run().returncode == 2
    assert "which verb?" in run().stderr
    assert run("unheard-of").returncode == 2


def test_help_of_a_verb_has_an_example() -> None:
    result = run("speak", "--help")
    assert result.returncode == 0
    assert "example:\n  prog speak | head" in result.stdout


def test_a_reader_that_went_away_is_no_traceback() -> None:
    command = [sys.executable, "-c", PROGRAM, "speak"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.read(10)
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 141

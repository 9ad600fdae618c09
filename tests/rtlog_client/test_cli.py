"""The commands: help with examples, exit statuses, one line for what is wrong."""

import json
from pathlib import Path
from typing import Any

import pytest

from rtlog_client.cli import main
from rtlog_client.log_file import LogWriter
from rtlog_server.topics import BY_NAME


@pytest.fixture
def recording(tmp_path: Path, bench: Any) -> Path:
    with LogWriter(tmp_path / "run.mcap", {"vehicle": "bench"}, None) as log:
        for k in range(20):
            for topic, data in bench.messages(k).items():
                log.write(topic, BY_NAME[topic].msgtype, data, bench.tick_ns(k), bench.tick_ns(k))
    return tmp_path / "run.mcap"


@pytest.mark.parametrize("verb", ["record", "recover", "audit", "replay", "compare"])
def test_help_has_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    assert f"example:\n  rtlog-client {verb} " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["recover", "{folder}/nowhere.mcap"], 2, "nowhere.mcap: No such file or directory"),
        (["recover", "{folder}/text.mcap"], 2, "text.mcap: not an MCAP recording"),
        (["recover", "{folder}/empty.mcap"], 2, "empty.mcap: the file is empty"),
        (["recover", "{folder}/head.mcap"], 1, "head.mcap: nothing to recover"),
        (["recover", "{folder}/run.mcap", "-o", "{folder}/text.mcap"], 2, "text.mcap exists already"),
        (["audit", "{folder}/cut.mcap"], 2, "cut.mcap: cut off or damaged"),
        (["replay", "{folder}/text.mcap", "--to", "devices"], 2, "text.mcap: not an MCAP recording"),
        (["replay", "{folder}/run.mcap", "--to", "devices", "--profile", "nil"], 2, "profile nil: No such file"),
        (["replay", "{folder}/run.mcap", "--to", "zenoh", "--start", "60"], 2, "nothing to replay after 60 s"),
        (["replay", "{folder}/run.mcap", "--to", "devices", "--profile", "cu_ss534"], 2, "lacks drive_wheel, steering"),
        (["compare", "{folder}/run.mcap", "{folder}/nowhere.mcap"], 2, "nowhere.mcap: No such file or directory"),
        (["compare", "{folder}/run.mcap", "{folder}/empty.mcap"], 2, "empty.mcap: the file is empty"),
        (["compare", "{folder}/run.mcap", "{folder}/text.mcap"], 2, "text.mcap: not an MCAP recording"),
        (["compare", "{folder}/run.mcap", "{folder}/run.mcap"], 2, "run.mcap: no profile in it"),
        (["compare", "{folder}/run.mcap", "{folder}/cut.mcap"], 2, "cut.mcap: cut off or damaged"),
        (["record", "-o", "{folder}/text.mcap"], 2, "text.mcap: cannot be written"),
        (["record", "-o", "{folder}", "--connect", "nonsense"], 2, "nonsense: no zenoh endpoint"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    tmp_path: Path, recording: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], status: int, line: str
) -> None:
    whole = recording.read_bytes()
    for name, content in [("text", b"hello, this is text"), ("empty", b""), ("head", whole[:60]), ("cut", whole[:-99])]:
        (tmp_path / f"{name}.mcap").write_bytes(content)
    before = sorted((path.name, path.read_bytes()) for path in tmp_path.iterdir())
    assert main([argument.format(folder=tmp_path) for argument in arguments]) == status
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("rtlog-client: ")
    assert line in output.err
    assert output.err.count("\n") == 1
    assert sorted((path.name, path.read_bytes()) for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("option", "value", "line"),
    [
        ("--start", "-1", "-1 is no number of seconds from 0 on"),
        ("--start", "soon", "soon is no number of seconds from 0 on"),
        ("--duration", "0", "0 is no number of seconds above 0"),
        ("--duration", "nan", "nan is no number of seconds above 0"),
        ("--rate", "0", "0 is neither max nor a number above 0"),
        ("--rate", "fast", "fast is neither max nor a number above 0"),
    ],
)
def test_numbers_without_sense_are_refused(
    option: str, value: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["replay", "run.mcap", "--to", "devices", option, value])
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith(f"argument {option}: {line}\n")


def test_recover_tells_what_came_back(tmp_path: Path, recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = tmp_path / "run.mcap.part"
    part.write_bytes(recording.read_bytes()[:-500])
    recording.unlink()
    assert main(["recover", str(part), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["path"] == str(recording)
    assert answer["messages"]["/rtlog/tick"] == 20
    assert not answer["was_whole"]
    assert main(["audit", str(recording), "--json"]) == 1
    assert {check["rule"] for check in json.loads(capsys.readouterr().out)["checks"] if not check["ok"]} == {
        "metadata `rtlog` is complete",
        "profile.toml is there and valid",
        "publish_time is the header's stamp",
    }

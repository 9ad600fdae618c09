"""The audit finds nothing wrong with a good recording, and names what is wrong with any other."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import read_profile_text
from rtlog_client.audit import audit
from rtlog_client.cli import main
from rtlog_client.log_file import LOSS_NAME, LogWriter
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import BY_NAME, DIAGNOSTICS, PRIMARY_SCAN, TAGS, TICK

METADATA = {"vehicle": "v", "profile": "simulated", "boot_id": "b", "software": "s"}


@dataclass(frozen=True)
class Row:
    tick: int
    topic: str
    data: bytes
    log_ns: int
    publish_ns: int
    sequence: int


def rows(bench: Any, ticks: int = 30) -> list[Row]:
    found = []
    for k in range(ticks):
        for topic, data in bench.messages(k).items():
            stamp_ns = to_ns(decode(data, BY_NAME[topic].msgtype).header.stamp)
            sequence = k // 10 if topic == DIAGNOSTICS.name else k
            found.append(Row(k, topic, data, bench.tick_ns(k), stamp_ns, sequence))
    return found


def write(path: Path, content: list[Row], profile: str | None = None) -> Path:
    with LogWriter(path, METADATA, profile or read_profile_text("simulated")) as log:
        for row in content:
            log.write(row.topic, BY_NAME[row.topic].msgtype, row.data, row.log_ns, row.publish_ns, row.sequence)
    return path


def test_a_good_recording(tmp_path: Path, bench: Any, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a.mcap", rows(bench))
    result = audit(path)
    assert result.ok, [check for check in result.checks if not check.ok]
    [scans] = [row for row in result.topics if row.topic == PRIMARY_SCAN.name]
    assert (scans.messages, scans.lost) == (30, 0)
    assert scans.rate_hz == pytest.approx(10.0)
    assert scans.longest_gap_s == pytest.approx(0.1)
    assert main(["audit", str(path)]) == 0
    assert "WRONG" not in capsys.readouterr().out


def is_scan(row: Row) -> bool:
    return row.topic == PRIMARY_SCAN.name


Break = Callable[[list[Row]], list[Row]]


@pytest.mark.parametrize(
    ("rule", "detail", "break_it"),
    [
        (
            "nothing was lost",
            "2 of /laser/primary/scan",
            lambda r: [x for x in r if not (is_scan(x) and x.tick in (7, 8))],
        ),
        ("tick indices have no gaps", "11→13", lambda r: [x for x in r if x.tick != 12]),
        (
            "no message is there twice",
            "/rfid/tags 9",
            lambda r: r + [x for x in r if x.topic == TAGS.name and x.tick == 9],
        ),
        ("every message decodes as its type says", "/rfid/tags 9", lambda r: [cut(x) for x in r]),
        (
            "publish_time is the header's stamp",
            "/laser/primary/scan 3",
            lambda r: [shift(x, 3, publish_ns=5) for x in r],
        ),
        (
            "every message is logged at a tick",
            "/laser/primary/scan 3",
            lambda r: [shift(x, 3, log_ns=50_000) for x in r],
        ),
        (
            "log_time never runs backwards",
            "/laser/primary/scan 4",
            lambda r: [shift(x, 3, log_ns=200_000_000) for x in r],
        ),
        (
            "samples are from just before their tick",
            "/laser/primary/scan 3",
            lambda r: [shift(x, 3, log_ns=-100_000_000) for x in r],
        ),
        ("/rtlog/tick is there", "no message", lambda r: [x for x in r if x.topic != TICK.name]),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, bench: Any, rule: str, detail: str, break_it: Break) -> None:
    result = audit(write(tmp_path / "a.mcap", break_it(rows(bench))))
    assert not result.ok
    [check] = [check for check in result.checks if check.rule == rule]
    assert not check.ok
    assert detail in check.detail
    assert main(["audit", str(tmp_path / "a.mcap")]) == 1


def cut(row: Row) -> Row:
    return replace(row, data=row.data[:10]) if row.topic == TAGS.name and row.tick == 9 else row


def shift(row: Row, tick: int, log_ns: int = 0, publish_ns: int = 0) -> Row:
    if not (is_scan(row) and row.tick == tick):
        return row
    return replace(row, log_ns=row.log_ns + log_ns, publish_ns=row.publish_ns + publish_ns)


def test_what_the_recorder_lost_counts(tmp_path: Path, bench: Any) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path, METADATA, read_profile_text("simulated")) as log:
        for row in rows(bench):
            log.write(row.topic, BY_NAME[row.topic].msgtype, row.data, row.log_ns, row.publish_ns, row.sequence)
        log.add_metadata(LOSS_NAME, {TAGS.name: '{"received": 30, "lost": 4, "holes": [[30, 33]]}'})
    result = audit(path)
    assert [check.detail for check in result.checks if not check.ok] == ["4 of /rfid/tags"]


def test_a_bad_profile_is_named(tmp_path: Path, bench: Any) -> None:
    result = audit(write(tmp_path / "a.mcap", rows(bench), profile="schema = 1\nname = 'x'\ntypo = 1\n"))
    [check] = [check for check in result.checks if not check.ok]
    assert "unknown key typo" in check.detail


def test_no_recording(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("hello, this is text")
    with pytest.raises(BadInputError, match="not an MCAP"):
        audit(tmp_path / "a.mcap")

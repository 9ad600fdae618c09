"""One run of a server: what counts as lost from where on, and where samples lie whose Tick is late or lost."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from rtlog_client.log_file import LogWriter, read_messages
from rtlog_client.run_log import RunLog
from rtlog_server.attachment import Attachment
from rtlog_server.topics import BY_NAME, JOINT_STATES, PRIMARY_SCAN, TICK

BOOT = uuid4()
Add = Callable[..., None]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[RunLog]:
    run = RunLog(BOOT, lambda: LogWriter(tmp_path / "run.mcap", {}, None), 100_000_000)
    yield run
    if run.log is not None and run.log.part.exists():
        run.log.abandon()


@pytest.fixture
def add(run: RunLog, bench: Any) -> Add:
    """add(topic, tick, sequence)"""

    def add_sample(topic: Any, tick: int, sequence: int) -> None:
        run.add(topic, bench.messages(tick)[topic.name], Attachment(BOOT, tick, sequence))

    return add_sample


def test_before_the_first_heartbeat_nothing_is_missed(run: RunLog, add: Add) -> None:
    add(TICK, 7, 7)
    run.heartbeat({TICK.name: 7, PRIMARY_SCAN.name: 6})
    assert run.lost == {}
    add(PRIMARY_SCAN, 9, 9)  # the heartbeat said 6
    add(JOINT_STATES, 9, 2)  # the heartbeat knew of none
    run.heartbeat({TICK.name: 8, PRIMARY_SCAN.name: 9, JOINT_STATES.name: 2, "/rfid/tags": 3})
    assert run.lost == {TICK.name: 1, PRIMARY_SCAN.name: 2, JOINT_STATES.name: 2, "/rfid/tags": 4}


def test_samples_lie_at_their_tick(run: RunLog, add: Add, bench: Any, tmp_path: Path) -> None:
    add(PRIMARY_SCAN, 3, 0)  # before any Tick: waits
    assert list(tmp_path.iterdir()) == []
    add(TICK, 5, 5)
    add(PRIMARY_SCAN, 5, 1)
    add(PRIMARY_SCAN, 8, 2)  # Tick 8 is late
    add(TICK, 8, 8)
    summary = run.finish()
    assert summary is not None
    found = [(m.topic, m.log_time_ns) for m in read_messages(summary.path)]
    times = {3: PRIMARY_SCAN, 5: PRIMARY_SCAN, 8: PRIMARY_SCAN}
    expected = [(topic.name, bench.tick_ns(k)) for k, topic in times.items()]
    assert sorted(found) == sorted([*expected, (TICK.name, bench.tick_ns(5)), (TICK.name, bench.tick_ns(8))])


def test_without_a_tick_there_is_no_file(run: RunLog, add: Add, tmp_path: Path) -> None:
    add(PRIMARY_SCAN, 3, 0)
    assert run.finish() is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("topic", [TICK.name, PRIMARY_SCAN.name])
def test_bytes_that_are_no_message_are_refused_and_missed(run: RunLog, add: Add, bench: Any, topic: str) -> None:
    with pytest.raises(ValueError, match="bytes are no"):
        run.add(BY_NAME[topic], bench.messages(1)[topic][:9], Attachment(BOOT, 1, 1))
    run.heartbeat({topic: 1})
    add(BY_NAME[topic], 2, 2)
    add(BY_NAME[topic], 4, 4)
    assert run.lost == {topic: 1}

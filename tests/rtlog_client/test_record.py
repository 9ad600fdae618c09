"""Recording over real zenoh sessions: everything that was published is in the file, and what was lost is counted."""

import json
import logging
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from patience import PATIENCE_S, wait_until
from rosbags.highlevel import AnyReader

from hw_profiles.errors import BadInputError, RTLogError
from rtlog_client.log_file import LOSS_NAME, read_info, read_messages
from rtlog_client.record import record
from rtlog_client.recorder import Progress, RecordConfig
from rtlog_client.run_log import RunSummary
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import DIAGNOSTICS, JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

EVERY_TICK = (TICK.name, PRIMARY_SCAN.name, JOINT_STATES.name, TAGS.name)
StartServer = Callable[..., Any]
StartRecording = Callable[..., Any]


class Recording:
    """`record` in a thread."""

    def __init__(self, config: RecordConfig, pool: ThreadPoolExecutor) -> None:
        self.stopping = threading.Event()
        self.progress: Progress | None = None
        self.future: Future[list[RunSummary]] = pool.submit(record, config, self.stopping, self._show)

    def _show(self, progress: Progress) -> None:
        self.progress = progress

    def wait(self, condition: Callable[[Progress], bool]) -> Progress:
        def is_so() -> bool:
            assert not self.future.done(), self.future.exception()
            return self.progress is not None and condition(self.progress)

        wait_until(is_so, lambda: self.progress)
        assert self.progress is not None
        return self.progress

    def stop(self) -> list[RunSummary]:
        self.stopping.set()
        return self.future.result(PATIENCE_S)


@pytest.fixture
def start_recording(tmp_path: Path) -> Iterator[StartRecording]:
    recordings = []
    with ThreadPoolExecutor() as pool:

        def start(endpoint: str, **options: Any) -> Recording:
            recordings.append(Recording(RecordConfig(tmp_path, endpoint, **options), pool))
            return recordings[-1]

        yield start
        for recording in recordings:
            recording.stopping.set()


def metadata_of(path: Path) -> dict[str, dict[str, str]]:
    with path.open("rb") as file:
        return {record.name: record.metadata for record in make_reader(file).iter_metadata()}


def test_what_is_published_is_recorded(
    start_server: StartServer, start_recording: StartRecording, tmp_path: Path
) -> None:
    server = start_server()
    recording = start_recording(server.endpoint, name="run")
    server.wait_for_subscriber()
    for k in range(50):
        server.tick(k, twice=k == 20)
    server.heartbeat()
    progress = recording.wait(lambda progress: progress.ticks == 50)
    assert progress.last_tag is not None
    assert progress.last_tag.epc == f"E200{49:020X}"
    assert progress.there
    [summary] = recording.stop()
    assert summary.path == tmp_path / "run.mcap"
    assert (summary.ticks, summary.lost) == (50, {})
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]

    info = read_info(summary.path)
    assert info.run_id == "run"
    assert info.profile_toml is not None
    assert 'name = "bench"' in info.profile_toml
    expected = {"vehicle": "bench", "profile": "bench", "boot_id": str(server.boot_id), "server": "bench 1"}
    assert info.metadata.items() >= expected.items()
    assert info.metadata["software"].startswith("rtlog-client ")
    assert info.message_counts == {**dict.fromkeys(EVERY_TICK, 50), DIAGNOSTICS.name: 5} == summary.messages
    for message in read_messages(summary.path):
        k = message.sequence * (10 if message.topic == DIAGNOSTICS.name else 1)
        assert message.data == server.messages(k)[message.topic]
        assert message.log_time_ns == server.tick_ns(k)
        assert message.publish_time_ns == to_ns(decode(message.data, message.msgtype).header.stamp)


def test_third_party_readers_agree(start_server: StartServer, start_recording: StartRecording, tmp_path: Path) -> None:
    server = start_server()
    recording = start_recording(server.endpoint)
    server.wait_for_subscriber()
    for k in range(20):
        server.tick(k)
    recording.wait(lambda progress: progress.ticks == 20)
    [summary] = recording.stop()

    with AnyReader([summary.path]) as reader:  # knows our types from the file alone
        messages = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
    assert len(messages) == 82
    ticks = [(m.index, t) for topic, t, m in messages if topic == TICK.name]
    assert ticks == [(k, server.tick_ns(k)) for k in range(20)]
    epcs = [read.epc for topic, _, m in messages if topic == TAGS.name for read in m.reads]
    assert epcs == [f"E200{k:020X}" for k in (0, 7, 14)]

    with summary.path.open("rb") as file:
        rows = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        decoded = [(channel.topic, message) for _, channel, _, message in rows]
    assert len(decoded) == 82
    assert [m.index for topic, m in decoded if topic == TICK.name] == list(range(20))
    assert [read.epc for topic, m in decoded if topic == TAGS.name for read in m.reads] == epcs
    names = [m.name for topic, m in decoded if topic == JOINT_STATES.name]
    assert names == [["left_wheel", "right_wheel"]] * 20


def test_losses_are_counted_exactly(
    start_server: StartServer, start_recording: StartRecording, caplog: pytest.LogCaptureFixture
) -> None:
    server = start_server()
    for k in range(30):
        server.tick(k)  # before anybody listens: not a loss
    recording = start_recording(server.endpoint)
    server.wait_for_subscriber()
    server.heartbeat()
    server.tick(30, lose=[PRIMARY_SCAN.name])  # the very first after the heartbeat
    for k in range(31, 80):
        lose = [PRIMARY_SCAN.name] if k in (40, 41, 42, 60) else []
        lose += [TICK.name] if k == 50 else []
        lose += [TAGS.name] if k >= 75 else []  # a tail that only the heartbeat tells of
        lose += [DIAGNOSTICS.name]  # all of a topic
        server.tick(k, lose)
    with caplog.at_level(logging.WARNING):
        server.heartbeat()
        expected = {PRIMARY_SCAN.name: 5, TICK.name: 1, TAGS.name: 5, DIAGNOSTICS.name: 4}
        recording.wait(lambda progress: progress.lost == sum(expected.values()))
    assert "lost 5 of /laser/primary/scan (5 in all), last sequence numbers 30, 40–42, 60" in caplog.messages
    [summary] = recording.stop()
    assert summary.lost == expected | {DIAGNOSTICS.name: summary.lost[DIAGNOSTICS.name]}
    record_of = {topic: json.loads(text) for topic, text in metadata_of(summary.path)[LOSS_NAME].items()}
    assert record_of[PRIMARY_SCAN.name] == {"received": 45, "lost": 5, "holes": [[30, 30], [40, 42], [60, 60]]}
    assert record_of[TAGS.name]["holes"] == [[75, 79]]
    assert record_of[JOINT_STATES.name] == {"received": 50, "lost": 0, "holes": []}
    # the samples of the tick whose Tick was lost lie at its time all the same
    times = {m.sequence: m.log_time_ns for m in read_messages(summary.path, [PRIMARY_SCAN.name])}
    assert times[50] == server.tick_ns(50)


def test_a_link_that_breaks_leaves_a_counted_hole(
    start_server: StartServer, start_recording: StartRecording, open_link: Any
) -> None:
    server = start_server()
    link = open_link(server)
    recording = start_recording(link.endpoint, name="run")
    server.wait_for_subscriber()
    for k in range(10):
        server.tick(k)
    recording.wait(lambda progress: progress.ticks == 10)
    link.cut()
    recording.wait(lambda progress: not progress.there)
    for k in range(10, 25):
        server.tick(k)  # nobody hears it
    link.mend()
    server.wait_for_subscriber()
    for k in range(25, 30):
        server.tick(k)
    server.heartbeat()
    recording.wait(lambda progress: progress.there and progress.ticks == 15 and progress.lost == 62)
    [summary] = recording.stop()
    assert summary.path.name == "run.mcap"
    assert summary.lost == {**dict.fromkeys(EVERY_TICK, 15), DIAGNOSTICS.name: 2}


def test_another_run_of_the_server_is_another_file(
    start_server: StartServer, start_recording: StartRecording, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    first = start_server()
    recording = start_recording(first.endpoint, name="run")
    first.wait_for_subscriber()
    for k in range(10):
        first.tick(k)
    recording.wait(lambda progress: progress.ticks == 10)
    first.close()
    recording.wait(lambda progress: not progress.there)
    second = start_server(port=int(first.endpoint.rsplit(":")[-1]))
    second.wait_for_subscriber()
    for k in range(7):
        second.tick(k)
    recording.wait(lambda progress: progress.ticks == 7)
    summaries = recording.stop()
    assert [(s.path.name, s.ticks, s.boot_id) for s in summaries] == [
        ("run.mcap", 10, str(first.boot_id)),
        ("run_2.mcap", 7, str(second.boot_id)),
    ]
    assert read_info(tmp_path / "run_2.mcap").metadata["boot_id"] == str(second.boot_id)
    assert any("the server is gone" in line for line in caplog.messages)
    assert any("started anew" in line for line in caplog.messages)


def test_a_disk_that_fills_up_leaves_a_finished_file(
    start_server: StartServer, start_recording: StartRecording, tmp_path: Path
) -> None:
    server = start_server()
    free = shutil.disk_usage(tmp_path).free
    margin = min(2 * 10**9, free // 4)  # more than other programs write or delete meanwhile
    ballast = tmp_path / "ballast"
    recording = start_recording(server.endpoint, name="run", reserve_bytes=free - margin)
    server.wait_for_subscriber()
    for k in range(20):
        server.tick(k)
    recording.wait(lambda progress: progress.ticks == 20)
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, 2 * margin)
    with pytest.raises(RTLogError, match="the disk is full"):
        recording.future.result(PATIENCE_S)
    ballast.unlink()
    assert read_info(tmp_path / "run.mcap").message_counts[TICK.name] == 20


def test_the_door(start_server: StartServer, tmp_path: Path) -> None:
    idle = threading.Event()
    (tmp_path / "file").touch()
    (tmp_path / "taken.mcap.part").touch()
    for config, word in [
        (RecordConfig(tmp_path / "file"), "file: cannot be written"),
        (RecordConfig(Path("/proc/nowhere")), "cannot be written"),
        (RecordConfig(tmp_path, name="taken"), r"taken\.mcap\.part exists already"),
        (RecordConfig(tmp_path, connect="nonsense"), "nonsense: no zenoh endpoint"),
    ]:
        with pytest.raises(BadInputError, match=word):
            record(config, idle)
    stopped = threading.Event()
    stopped.set()
    with pytest.raises(RTLogError, match=r"no server was found at tcp/127\.0\.0\.1:9"):
        record(RecordConfig(tmp_path, connect="tcp/127.0.0.1:9"), stopped)
    with pytest.raises(RTLogError, match="the disk is full"):
        record(RecordConfig(tmp_path, reserve_bytes=10**18), idle)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "taken.mcap.part"]


def test_several_vehicles_are_named(start_server: StartServer, tmp_path: Path) -> None:
    server = start_server(vehicle="one")
    server.declare_presence("two")
    with pytest.raises(BadInputError, match=r"several vehicles .*: one, two"):
        record(RecordConfig(tmp_path, server.endpoint), threading.Event())

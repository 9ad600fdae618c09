"""A recording that is published again and recorded again is the same."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from patience import PATIENCE_S, wait_until

import rtlog_client.republish
from hw_profiles.errors import RTLogError
from hw_profiles.profile import parse_profile, read_profile_text
from rtlog_client.log_file import LogWriter, read_info, read_messages
from rtlog_client.record import record
from rtlog_client.recorder import RecordConfig
from rtlog_client.republish import republish
from rtlog_server.bundle import ServerInfo
from rtlog_server.messages import decode, to_ns
from rtlog_server.publish import Publisher
from rtlog_server.topics import BY_NAME


class Lead(threading.Event):
    """Lets the first tick wait until the recorder listens, however long that takes."""

    def __init__(self, publishers: list[Publisher]) -> None:
        super().__init__()
        self._publishers = publishers

    def wait(self, timeout: float | None = None) -> bool:
        while self._publishers:
            probe = self._publishers.pop()._session.declare_publisher("rtlog/bench/rtlog/tick")
            wait_until(lambda: probe.matching_status.matching)  # noqa: B023
            probe.undeclare()
        return super().wait(timeout)


@pytest.fixture
def publishers(monkeypatch: pytest.MonkeyPatch) -> list[Publisher]:
    """Those that `republish` opens."""
    opened: list[Publisher] = []

    class Known(Publisher):
        def __init__(self, info: ServerInfo) -> None:
            super().__init__(info)
            opened.append(self)

    monkeypatch.setattr(rtlog_client.republish, "Publisher", Known)
    return opened


def test_a_recording_goes_round(tmp_path: Path, bench: Any, free_port: int, publishers: list[Publisher]) -> None:
    with LogWriter(tmp_path / "in.mcap", {"vehicle": "bench"}, 'schema = 1\nname = "bench"\n') as log:
        for k in range(5, 20):
            for topic, data in bench.messages(k).items():
                stamp_ns = to_ns(decode(data, BY_NAME[topic].msgtype).header.stamp)
                log.write(topic, BY_NAME[topic].msgtype, data, bench.tick_ns(k), stamp_ns)
    endpoint = f"tcp/127.0.0.1:{free_port}"
    text = read_profile_text("simulated").replace("tcp/127.0.0.1:7447", endpoint)
    profile, ended, heard = parse_profile(text, "test"), threading.Event(), []
    with ThreadPoolExecutor() as pool:
        recording = pool.submit(record, RecordConfig(tmp_path, endpoint, name="out"), ended, heard.append)
        try:
            report = republish(tmp_path / "in.mcap", profile, text, Lead(publishers), lead_s=0.0)
            wait_until(lambda: bool(heard) and heard[-1].ticks == 15)
        finally:
            ended.set()
        [summary] = recording.result(PATIENCE_S)
    assert report.ticks == 15 == summary.ticks
    assert summary.lost == {}
    assert list(read_messages(tmp_path / "out.mcap")) == list(read_messages(tmp_path / "in.mcap"))
    assert read_info(tmp_path / "out.mcap").profile_toml == 'schema = 1\nname = "bench"\n'
    assert read_info(tmp_path / "out.mcap").metadata["vehicle"] == "bench"


def test_an_endpoint_that_is_taken_is_named(tmp_path: Path, bench: Any, start_server: Any) -> None:
    with LogWriter(tmp_path / "in.mcap", {}, None) as log:
        for k in range(2):
            log.write(
                "/rtlog/tick", BY_NAME["/rtlog/tick"].msgtype, bench.messages(k)["/rtlog/tick"], bench.tick_ns(k), 0
            )
    server = start_server()
    text = read_profile_text("simulated").replace("tcp/127.0.0.1:7447", server.endpoint)
    with pytest.raises(RTLogError, match=server.endpoint):
        republish(tmp_path / "in.mcap", parse_profile(text, "test"), text, threading.Event())

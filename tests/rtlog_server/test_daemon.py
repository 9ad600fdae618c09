"""The server as a process, heard by a real zenoh client; its devices are away unless a test says otherwise."""

import json
import os
import signal
import time
import tomllib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from patience import PATIENCE_S

from rtlog_server.messages import MISSING, decode, to_ns
from rtlog_server.topics import BY_NAME

PERIOD_NS = 100_000_000
CLOCKS_NS = 1_000_000  # by which wall clock and monotonic clock may part while a server runs
StartServer = Callable[..., Any]


@pytest.fixture(scope="module")
def server(start_server: StartServer) -> Any:
    server = start_server()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 12)
    return server


def ticks_of(server: Any) -> list[Any]:
    return [decode(sample.payload, BY_NAME["/rtlog/tick"].msgtype) for sample in server.on("rtlog/tick")]


def test_ticks_flow_on_the_grid_whatever_the_devices_do(server: Any) -> None:
    ticks = ticks_of(server)
    first = ticks[0].index
    assert [tick.index for tick in ticks] == list(range(first, first + len(ticks)))
    scheduled = [to_ns(tick.scheduled) for tick in ticks]
    assert {later - earlier for earlier, later in pairwise(scheduled)} == {PERIOD_NS}
    assert all(min(stamp % PERIOD_NS, -stamp % PERIOD_NS) == 0 for stamp in scheduled)
    assert server.started_ns < scheduled[0] < scheduled[-1] < time.time_ns()
    for tick in ticks:
        assert {sensor.name: sensor.state for sensor in tick.sensors} == dict.fromkeys(
            ("laser/primary", "encoders", "rfid"), MISSING
        )
        assert all(sensor.age == float("inf") for sensor in tick.sensors)
        assert to_ns(tick.header.stamp) - to_ns(tick.scheduled) == pytest.approx(tick.lateness * 1e9, abs=2)
    assert {sample.key.split("/", 2)[2] for sample in server.received} == {"rtlog/tick", "diagnostics", "@heartbeat"}


def test_every_sample_says_boot_tick_and_sequence(server: Any) -> None:
    samples = server.on("rtlog/tick")
    for sample, tick in zip(samples, ticks_of(server), strict=False):
        assert sample.attachment.tick == sample.attachment.sequence == tick.index
        assert sample.encoding == "application/cdr;rtlog_msgs/msg/Tick"
    assert {str(sample.attachment.boot_id) for sample in samples} == {server.status()["boot_id"]}
    diagnostics = [sample.attachment.sequence for sample in server.on("diagnostics")]
    assert diagnostics == list(range(diagnostics[0], diagnostics[0] + len(diagnostics)))


def test_heartbeats_tell_the_last_numbers(server: Any) -> None:
    server.wait_until(lambda: len(server.on("@heartbeat")) >= 3)
    beats = [json.loads(beat.payload) for beat in server.on("@heartbeat")]
    assert {beat["boot_id"] for beat in beats} == {server.status()["boot_id"]}
    assert beats[-1]["last_tick"] > beats[-2]["last_tick"]  # the first may come before the first ticks
    assert beats[-1]["last_sequence"]["/rtlog/tick"] == beats[-1]["last_tick"]


def test_liveliness_token_names_the_boot(server: Any) -> None:
    replies = server.session.liveliness().get(f"rtlog/{server.name}/@server/*", timeout=PATIENCE_S)
    keys = [str(reply.ok.key_expr) for reply in replies]
    assert keys == [f"rtlog/{server.name}/@server/{server.status()['boot_id']}"]


def test_profile_is_the_toml_as_written(server: Any) -> None:
    text = server.get("@profile").payload.to_string()
    assert text == (server.stderr.parent / "profile.toml").read_text()
    assert tomllib.loads(text)["name"] == server.name


def test_status_says_how_the_server_is(server: Any) -> None:
    status = server.status()
    assert status["vehicle"] == server.name
    assert status["software"].startswith("rtlog ")
    assert status["uptime_s"] > 1
    assert status["published"]["/rtlog/tick"] >= 12
    ticks = status["ticks"]
    assert ticks["sampled"] == status["published"]["/rtlog/tick"] + ticks["dropped"]
    assert ticks["sampled"] >= sum(bin_["count"] for bin_ in ticks["histogram"]) >= 10  # of the report, a second old
    assert 0 < ticks["lateness_s"]["p50"] <= ticks["lateness_s"]["p99"] <= ticks["lateness_s"]["max"]
    assert ticks["dropped"] == 0
    assert status["realtime"].keys() == {"scheduler", "memory"}
    assert {name: device["state"] for name, device in status["devices"].items()} == dict.fromkeys(
        ("laser/primary", "encoders", "rfid"), "MISSING"
    )
    assert "absent" in status["devices"]["encoders"]["message"]
    assert status["devices"]["encoders"]["age_s"] is None


def test_diagnostics_name_what_is_missing_each_second_of_ticks(server: Any) -> None:
    server.wait_until(lambda: len(server.on("diagnostics")) >= 2)
    latest = decode(server.on("diagnostics")[-1].payload, BY_NAME["/diagnostics"].msgtype)
    levels = {status.name: status.level for status in latest.status}
    assert levels.keys() == {"laser/primary", "encoders", "rfid", "server"}
    assert levels["encoders"] == levels["rfid"] == levels["laser/primary"] == 2
    ticks = [sample.attachment.tick for sample in server.on("diagnostics")]
    assert {later - earlier for earlier, later in pairwise(ticks)} == {10}


def test_nobody_is_looked_for(server: Any) -> None:
    """One listener and no discovery: nothing on the network hears of the server unless it asks there."""
    process = Path(f"/proc/{server.publisher_id()}")
    ours = {str(link.readlink()) for link in (process / "fd").iterdir() if link.is_symlink()}
    udp = [line.split() for line in (process / "net/udp").read_text().splitlines()[1:]]
    tcp = [line.split() for line in (process / "net/tcp").read_text().splitlines()[1:]]
    listening = "0A"
    assert not [line for line in udp if f"socket:[{line[9]}]" in ours]
    assert len([line for line in tcp if f"socket:[{line[9]}]" in ours and line[3] == listening]) == 1


def test_zenoh_and_sampling_are_two_processes(server: Any) -> None:
    assert "zenoh" not in Path(f"/proc/{server.process.pid}/maps").read_text()
    assert "zenoh" in Path(f"/proc/{server.publisher_id()}/maps").read_text()
    assert os.sched_getscheduler(server.publisher_id()) == os.SCHED_OTHER  # real time is for the sampling alone


def test_a_tick_that_was_missed_comes_late_and_says_so(start_server: StartServer) -> None:
    server = start_server()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 5)
    server.process.send_signal(signal.SIGSTOP)
    stopped_ns = time.time_ns()
    time.sleep(0.5)
    continued_ns = time.time_ns()
    server.process.send_signal(signal.SIGCONT)
    server.wait_until(lambda: to_ns(ticks_of(server)[-1].scheduled) > continued_ns + 3e8)
    ticks = ticks_of(server)
    assert [tick.index for tick in ticks] == list(range(ticks[0].index, ticks[0].index + len(ticks)))
    missed = [tick for tick in ticks if stopped_ns < to_ns(tick.scheduled) < continued_ns]
    assert len(missed) >= 4
    began_ns = [to_ns(tick.header.stamp) for tick in missed]
    assert began_ns == sorted(began_ns)
    for tick, at_ns in zip(missed, began_ns, strict=True):
        assert at_ns > continued_ns - CLOCKS_NS
        assert tick.lateness * 1e9 == pytest.approx(at_ns - to_ns(tick.scheduled), abs=2)
    server.wait_until(lambda: server.status()["ticks"]["overruns"] >= 3)


def test_a_publishing_process_that_stands_still_delays_no_tick(start_server: StartServer) -> None:
    server = start_server()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 3)
    publisher = server.publisher_id()
    os.kill(publisher, signal.SIGSTOP)
    stopped_ns = time.time_ns()
    time.sleep(1.0)
    continued_ns = time.time_ns()
    os.kill(publisher, signal.SIGCONT)
    server.wait_until(lambda: to_ns(ticks_of(server)[-1].scheduled) > continued_ns + 2e8)
    ticks = ticks_of(server)
    assert [tick.index for tick in ticks] == list(range(ticks[0].index, ticks[0].index + len(ticks)))
    meanwhile = [tick for tick in ticks if stopped_ns < to_ns(tick.header.stamp) < continued_ns]
    assert len(meanwhile) >= 3  # none, if the loop had waited for it
    assert server.status()["ticks"]["dropped"] == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_with_everything_published(start_server: StartServer, number: signal.Signals) -> None:
    server = start_server()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 5)
    os.killpg(server.process.pid, number)  # as a terminal or systemd does: to both processes
    assert server.process.wait(timeout=PATIENCE_S) == 0

    def all_is_here() -> bool:
        beat = json.loads(server.on("@heartbeat")[-1].payload)
        return beat["last_sequence"]["/rtlog/tick"] == beat["last_tick"] == ticks_of(server)[-1].index

    server.wait_until(all_is_here)
    assert "Traceback" not in server.stderr.read_text()


def test_it_does_not_outlive_its_publishing_process(start_server: StartServer) -> None:
    server = start_server()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 2)
    os.kill(server.publisher_id(), signal.SIGKILL)
    assert server.process.wait(timeout=PATIENCE_S) == 1
    last_line = server.stderr.read_text().splitlines()[-1]
    assert last_line == "rtlog-server: the publishing process ended (exit status -9)"


def test_its_publishing_process_does_not_outlive_it(start_server: StartServer) -> None:
    server = start_server()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 2)
    publisher = server.publisher_id()
    server.process.kill()
    server.wait_until(lambda: not Path(f"/proc/{publisher}").exists())

"""Publishing on real zenoh sessions: what a subscriber gets, and that none can hold the publisher up."""

import json
import multiprocessing
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from uuid import UUID

import pytest
import zenoh
from patience import PATIENCE_S, wait_until

from rtlog_server.attachment import Attachment, unpack_attachment
from rtlog_server.bundle import Bundle, LatenessSummary, Report, Sample, ServerInfo
from rtlog_server.publish import Publisher, publish_bundles

BOOT = UUID("00112233-4455-6677-8899-aabbccddeeff")
REPORT = Report(1_700_000_000_000_000_000, [], LatenessSummary(1, 0, 0.0, 0.0, 0.0, []), 0, {})
GIVE_UP_S = 4.0  # zenoh waits for 5 s, where it waits at all, before it cuts off who takes nothing
TICK, SCAN = "/rtlog/tick", "/laser/primary/scan"
OpenClient = Callable[[int], zenoh.Session]

STALLED_SUBSCRIBER = """
import sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", sys.argv[1])
config.insert_json5("transport/shared_memory/enabled", "false")
session = zenoh.open(config)
subscriber = session.declare_subscriber("rtlog/**", lambda sample: print("heard", flush=True))
time.sleep(300)
"""


@pytest.fixture
def info(free_port: int) -> ServerInfo:
    listen = (f"tcp/127.0.0.1:{free_port}",)
    return ServerInfo(BOOT, "trailer", "rtlog 0.1", "schema = 1\n", listen, time.monotonic_ns())


def port_of(info: ServerInfo) -> int:
    return int(info.listen[0].rsplit(":", 1)[1])


def data_of(samples: list[zenoh.Sample]) -> list[zenoh.Sample]:
    return [sample for sample in list(samples) if "@" not in str(sample.key_expr)]


def test_samples_of_a_tick_come_in_order_with_their_attachment(info: ServerInfo, open_client: OpenClient) -> None:
    samples: list[zenoh.Sample] = []
    with Publisher(info) as publisher, open_client(port_of(info)) as session:
        session.declare_subscriber("rtlog/trailer/**", samples.append)
        session.declare_subscriber("rtlog/trailer/@heartbeat", samples.append)
        wait_until(lambda: bool(publisher.heartbeat() or samples))  # until the subscription has arrived
        samples.clear()
        for k in range(20):
            pair = [Sample(TICK, k, b"tick %d" % k), Sample(SCAN, 2 * k, b"scan %d" % k)]
            publisher.publish(Bundle(7 + k, pair, REPORT if k % 10 == 0 else None))
        publisher.heartbeat()
        wait_until(lambda: any(b'"last_tick": 26' in sample.payload.to_bytes() for sample in list(samples)))
        wait_until(lambda: len(data_of(samples)) == 42)  # a heartbeat may overtake what other subscribers hear
    expected = []
    for k in range(20):
        expected += [(f"rtlog/trailer{TICK}", k, 7 + k), (f"rtlog/trailer{SCAN}", 2 * k, 7 + k)]
        if k % 10 == 0:
            expected.append(("rtlog/trailer/diagnostics", k // 10, 7 + k))
    found = []
    for sample in data_of(samples):
        attachment = unpack_attachment(sample.attachment.to_bytes())
        assert attachment == Attachment(BOOT, attachment.tick, attachment.sequence)
        found.append((str(sample.key_expr), attachment.sequence, attachment.tick))
    assert found == expected
    beats = [json.loads(sample.payload.to_bytes()) for sample in samples if "@" in str(sample.key_expr)]
    last = {TICK: 19, SCAN: 38, "/diagnostics": 1}
    assert {"boot_id": str(BOOT), "last_tick": 26, "last_sequence": last} in beats


def test_the_end_of_the_pipe_publishes_all_and_a_last_heartbeat(info: ServerInfo, open_client: OpenClient) -> None:
    ours, theirs = multiprocessing.Pipe()
    thread = threading.Thread(target=publish_bundles, args=(theirs, info))
    thread.start()
    assert ours.recv() == ""
    samples: list[zenoh.Sample] = []
    with open_client(port_of(info)) as session:
        session.declare_subscriber("rtlog/trailer/**", samples.append)
        session.declare_subscriber("rtlog/trailer/@heartbeat", samples.append)
        wait_until(lambda: bool(samples))  # the heartbeat of a server that has not ticked yet
        assert json.loads(samples[0].payload.to_bytes())["last_tick"] is None
        samples.clear()
        for k in range(100):
            ours.send(Bundle(k, [Sample(TICK, k, bytes(100))], None))  # zenoh's queue holds them all
        ours.close()
        thread.join(timeout=PATIENCE_S)
        assert not thread.is_alive()
        wait_until(lambda: any(b'"last_tick": 99' in sample.payload.to_bytes() for sample in list(samples)))
        wait_until(lambda: len(data_of(samples)) == 100)
    ticks = [unpack_attachment(sample.attachment.to_bytes()).tick for sample in data_of(samples)]
    assert ticks == list(range(100))


def test_a_taken_endpoint_is_told_in_one_line(info: ServerInfo) -> None:
    with Publisher(info):
        ours, theirs = multiprocessing.Pipe()
        publish_bundles(theirs, info)
        line = ours.recv()
    assert line.startswith(f"zenoh on {info.listen[0]}: ")
    assert "in use" in line


def test_a_subscriber_that_stands_still_holds_nothing_up(info: ServerInfo) -> None:
    endpoints = json.dumps(info.listen)
    with Publisher(info) as publisher:
        command = [sys.executable, "-c", STALLED_SUBSCRIBER, endpoints]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as subscriber:
            assert subscriber.stdout is not None
            while not select.select([subscriber.stdout], [], [], 0.01)[0]:
                publisher.publish(Bundle(0, [Sample(SCAN, 0, b"")], None))  # until the subscription has arrived
            os.kill(subscriber.pid, signal.SIGSTOP)
            longest_s = 0.0
            for k in range(200):
                began = time.monotonic()
                publisher.publish(Bundle(k, [Sample(SCAN, k, bytes(50_000))], None))
                longest_s = max(longest_s, time.monotonic() - began)
            subscriber.kill()
    assert longest_s < GIVE_UP_S

"""What the reader pushes to us: when it cannot, when it stops, when somebody else talks there."""

import socket
from collections.abc import Callable
from contextlib import suppress
from time import sleep
from types import SimpleNamespace
from typing import Any

import pytest

from rtlog_server.devices.alien import driver, link, setup
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.messages import OK

Start = Callable[..., Any]


def test_without_a_stream_the_tag_list_is_polled_until_there_is_one(
    emulator: Alr9650Emulator, start: Start, epcs: list[str]
) -> None:
    emulator.refuse_stream = True
    emulator.configure("set AutoMode = ON")
    emulator.read_tag("0BAD")  # is on the list already, and nowhere near when we come
    reader = start(emulator.port)
    reader.wait_until_reading(stream="polling")
    for count in (2, 3):
        emulator.read_tag(epcs[0], count=count)
        emulator.read_tag(epcs[1], antenna=1)
        wanted = 2 * (count - 1)
        reader.wait_for(lambda: len(reader.samples) == wanted)  # noqa: B023
    sleep(0.3)  # three polls more
    reader.wait_for(lambda: reader.collect() == OK)
    assert [(sample.epc, sample.count) for sample in reader.samples] == [
        (epcs[0], 2),
        (epcs[1], 1),
        (epcs[0], 3),
        (epcs[1], 1),
    ]
    assert "opens no tag stream to 127.0.0.1:" in reader.device.message
    emulator.refuse_stream = False
    reader.wait_until_reading(stream="open")
    emulator.read_tag(epcs[2])
    reader.wait_for_epc(epcs[2])
    assert len(reader.samples) == 5  # what both tell of a tag counts once
    reader.wait_for(lambda: reader.device.message == "connected")


def test_a_push_that_died_without_a_word_is_given_up_and_loses_nothing(
    emulator: Alr9650Emulator, start: Start, epcs: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "ALIVE_S", 0.1)
    reader = start(emulator.port)
    reader.wait_until_reading()
    emulator.swallow_push = True
    sent = 0
    while reader.device.diagnostics["stream"] == "open":
        emulator.read_tag(epcs[0])
        sent += 1
        assert sent < 6000
        sleep(0.01)
    reader.wait_for(lambda: sum(sample.count for sample in reader.samples) == sent)
    emulator.swallow_push = False
    emulator.read_tag(epcs[1])
    reader.wait_until_reading(stream="open")


def test_a_stream_that_idles_out_and_comes_back_loses_nothing(
    emulator: Alr9650Emulator, start: Start, epcs: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    idle = tuple((name, "0" if name == "TagStreamKeepAliveTime" else value) for name, value in setup.TAG_STREAM)
    monkeypatch.setattr(setup, "TAG_STREAM", idle)
    reader = start(emulator.port)
    reader.wait_until_reading(stream="polling")
    for epc in epcs:
        emulator.read_tag(epc)
        reader.wait_for_epc(epc)
        reader.wait_until_reading(stream="polling")
    assert sum(sample.count for sample in reader.samples) == len(epcs)


@pytest.mark.parametrize("lacks", ["", "tagstreammode"])
def test_whatever_is_cut_in_two_on_its_way_comes_through(
    emulator: Alr9650Emulator, start_on_wire: Start, epcs: list[str], lacks: str
) -> None:
    emulator.cut = True
    emulator.lacks |= {lacks}
    reader = start_on_wire(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    for epc in epcs:
        emulator.read_tag(epc, count=3)
    reader.wait_for(lambda: len(reader.samples) == len(epcs))
    assert sorted(sample.epc for sample in reader.samples) == epcs
    assert all(sample.count == 3 for sample in reader.samples)
    assert reader.device.diagnostics["garbled"] == "0"


def connect_to_stream(reader: Any) -> socket.socket:
    host, port = reader.device.diagnostics["stream address"].split(":")
    return socket.create_connection((host, int(port)))


def test_a_stream_of_garbage_is_counted_and_harms_nothing(
    emulator: Alr9650Emulator, start: Start, epcs: list[str]
) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    with connect_to_stream(reader) as sly:
        sly.sendall(b"\xff\xfe\0garbage;;;\r\nE2001;1;2;0;-1;3\r\n")
        reader.wait_for(lambda: len(reader.samples) == 1)
        sly.sendall(b"x" * 10_000)
        reader.wait_for(lambda: reader.device.diagnostics["last garbled"].startswith("more than 4096 bytes"))
    assert [sample.epc for sample in reader.samples] == ["E2001"]
    assert reader.device.diagnostics["garbled"] == "2"
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])
    assert reader.device.connects == 1


def test_a_crowd_at_the_stream_port_keeps_a_few_sockets_only(
    emulator: Alr9650Emulator, start: Start, epcs: list[str]
) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    crowd = [connect_to_stream(reader) for _ in range(20)]
    reader.wait_for(lambda: reader.device.diagnostics["streams"] == "21")
    assert len(reader.device._listener._connections) == 4
    for one in crowd:
        one.close()
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])
    assert reader.device.connects == 1


def test_a_flood_is_read_slowly_and_the_reader_is_still_heard(
    emulator: Alr9650Emulator, start: Start, epcs: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(link, "time", SimpleNamespace(sleep=lambda pause_s: pauses.append(pause_s) or sleep(pause_s)))
    reader = start(emulator.port)
    reader.wait_until_reading()
    with connect_to_stream(reader) as sly:
        sly.settimeout(0.05)
        while len(pauses) < 50:
            with suppress(TimeoutError):
                sly.send(b"E2001;1;2;0;-1;3\r\n" * 4000)
            reader.collect()
        emulator.read_tag(epcs[0])
        reader.wait_for_epc(epcs[0])
    assert reader.device.connects == 1

"""The driver against a peer that speaks from a script: a captured session of a real LMS111, and devices that refuse."""

import json
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE_S, Told, wait_until

from hw_profiles.profile import LaserDevice
from rtlog_server.devices import lms111
from rtlog_server.devices.device import DeviceError, TickGrid
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.lms111.cola import Dialect, Receiver, frame
from rtlog_server.devices.lms111.driver import Lms111
from rtlog_server.devices.lms111.identity import identify
from rtlog_server.devices.lms111.protocol import Command, decode, encode_command, reply_name
from rtlog_server.devices.lms111.scan_data import ScanData, encode_scan_data

CAPTURES = Path(__file__).parents[4] / "shared" / "data" / "lms111"
needs_captures = pytest.mark.skipif(not CAPTURES.is_dir(), reason=f"no captured sessions in {CAPTURES}")

SECTOR = (1, 5000, -449997, 2249997)  # as the captured device has it: an earlier driver wrote rounded values
REPLIES: dict[str, tuple[Any, ...]] = {
    "sRN SCdevicestate": (0,),
    "sMN SetAccessMode": (1,),
    "sRN FirmwareVersion": ("V1.80.2  ",),
    "sRN LMPscancfg": (5000, 1, 5000, -450000, 2250000),
    "sRN LMPoutputRange": SECTOR,
    "sRN LMDscandatacfg": (1, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0, 1),
    "sMN LMCstartmeas": (0,),
    "sRN STlms": (7, 0, "00:34:19", "01.01.1970", 0, 0, 0),
    "sMN Run": (1,),
    "sEN LMDscandata": (1,),
}


class Peer:
    """Serves one connection in CoLa B: each command gets the telegram of its reply; then `stream` takes the socket."""

    def __init__(self, replies: dict[str, bytes], stream: Callable[[socket.socket], None] = lambda _: None) -> None:
        self.commands: list[Command] = []
        self._replies = replies
        self._stream = stream
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        connection, _ = self._listener.accept()
        with connection, suppress(ConnectionError):  # a driver that hangs up may leave something unread
            receiver = Receiver(Dialect.B)
            while data := connection.recv(4096):
                for payload in receiver.feed(data):
                    command = decode(Dialect.B, payload)
                    assert isinstance(command, Command)
                    self.commands.append(command)
                    connection.sendall(self._replies.get(command.name, b""))
                    if command.name == "sEN LMDscandata":
                        self._stream(connection)

    def close(self) -> None:
        self._thread.join(PATIENCE_S)
        self._listener.close()


def telegrams(replies: dict[str, tuple[Any, ...]]) -> dict[str, bytes]:
    return {name: encode_command(Dialect.B, reply_name(name), *values) for name, values in replies.items()}


OpenPeer = Callable[..., tuple[Peer, Lms111]]


class ToldLms111(Lms111):
    """Keeps what it said."""

    def __init__(self, port: int) -> None:
        super().__init__("laser/primary", LaserDevice(host="127.0.0.1", port=port))
        self.told = Told(self)


@pytest.fixture
def open_peer() -> Iterator[OpenPeer]:
    opened: list[tuple[Peer, ToldLms111]] = []

    def open_peer(*arguments: Any) -> tuple[Peer, ToldLms111]:
        peer = Peer(*arguments)
        opened.append((peer, ToldLms111(peer.port)))
        opened[-1][1].start(TickGrid(0, 100_000_000))
        return opened[-1]

    yield open_peer
    for peer, driver in opened:
        driver.close()
        peer.close()


@needs_captures
def test_the_captured_session(open_peer: OpenPeer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lms111.driver, "SILENCE_S", PATIENCE_S)  # this peer can hear no question while it plays
    raw = (CAPTURES / "colab_dev2host.bin").read_bytes()
    index = [entry for entry in json.loads((CAPTURES / "colab_index.json").read_text()) if entry["dir"] == "dev>host"]
    expected = {scan["telegram_counter"]: scan for scan in json.loads((CAPTURES / "colab_decoded.json").read_text())}
    replies = telegrams(REPLIES)  # what the capture has none of: LMPscancfg and STlms
    streamed = []  # from the registration on: replies to other commands, scans, output states
    for entry in index:
        telegram = raw[entry["offset"] : entry["offset"] + entry["len"]]
        (payload,) = Receiver(Dialect.B).feed(telegram)
        command = decode(Dialect.B, payload)
        name = command.name if isinstance(command, Command) else ""
        replies |= {request: telegram for request in (*REPLIES, "sWN LMDscandatacfg") if reply_name(request) == name}
        if streamed or name == "sEA LMDscandata":
            streamed.append((entry["t_rel_s"], telegram))
    times_s, stream = zip(*streamed[1:], strict=True)

    def play(connection: socket.socket) -> None:
        """At the captured times, each telegram in two pieces."""
        pieces = random.Random(1)
        began = time.monotonic()
        for time_s, telegram in zip(times_s, stream, strict=True):
            time.sleep(max(0.0, began + (time_s - times_s[0]) - time.monotonic()))
            cut = pieces.randrange(len(telegram))
            connection.sendall(telegram[:cut])
            connection.sendall(telegram[cut:])

    peer, driver = open_peer(replies, play)
    scans: list[Scan] = []
    wait_until(lambda: scans.extend(driver.collect(time.monotonic_ns()).samples) or len(scans) == 77)
    assert [scan.telegram_counter for scan in scans] == list(expected)[
        :77
    ]  # the stream ends before the last one listed
    for scan in scans:
        values = expected[scan.telegram_counter]
        assert scan.scan_counter == values["scan_counter"]
        np.testing.assert_array_equal(np.round(scan.ranges_m * 1000), values["channels16"][0]["data"])
        assert len(scan.intensities) == 0
    assert driver.diagnostics["scans repeated"] == "3"
    assert driver.diagnostics["scans lost"] == "0"
    assert driver.identity == {"model": "LMS111", "firmware": "V1.80.2", "serial_number": "18090362"}
    device_ms = np.array([expected[scan.telegram_counter]["time_since_startup_us"] for scan in scans]) * 1e-3
    host_ms = np.array([scan.measured_ns for scan in scans]) * 1e-6
    # Between the clocks lies what the fastest delivery so far took: it shrinks, and no late telegram makes it grow.
    assert np.diff(host_ms - device_ms).max() < 0.2  # which is how well a turn of the motor is timed
    written = [command for command in peer.commands if command.name.startswith("sWN")]
    assert written == [Command("sWN LMDscandatacfg", (1, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0, 1))]  # all else is as wanted


def scan_telegrams(*which: int) -> bytes:
    raw = (CAPTURES / "colab_dev2host.bin").read_bytes()
    scans = [payload for payload in Receiver(Dialect.B).feed(raw) if payload.startswith(b"sSN LMDscandata")]
    return b"".join(frame(Dialect.B, scans[k]) for k in which)


@needs_captures
def test_events_between_command_and_reply(open_peer: OpenPeer) -> None:
    between = scan_telegrams(0) + encode_command(Dialect.B, "sEA LIDinputstate", 1)
    peer, driver = open_peer({name: between + reply for name, reply in telegrams(REPLIES).items()})
    wait_until(lambda: driver.connects)
    assert len(peer.commands) == len(REPLIES)
    assert not [command.name for command in peer.commands if command.name.startswith("sWN")]


@needs_captures
@pytest.mark.parametrize(
    ("sent", "arrived", "repeated", "lost"),
    [
        ((0, 1, 2), (0, 1, 2), 0, 0),
        ((0, 0, 1), (0, 1), 1, 0),
        ((0, 1, 2, 1, 2, 3), (0, 1, 2, 3), 2, 0),
        ((0, 4), (0, 4), 0, 3),
    ],
)
def test_scans_in_one_piece_with_the_registration(
    sent: tuple[int, ...], arrived: tuple[int, ...], repeated: int, lost: int, open_peer: OpenPeer
) -> None:
    replies = telegrams(REPLIES)
    _, driver = open_peer(replies | {"sEN LMDscandata": replies["sEN LMDscandata"] + scan_telegrams(*sent)})
    assert wait_counters(driver, len(arrived)) == [63336 + k for k in arrived]
    wait_until(lambda: driver.diagnostics["scans repeated"] == str(repeated))
    assert driver.diagnostics["scans lost"] == str(lost)


@needs_captures
def test_the_same_scan_again_and_again_is_no_sign_of_life(open_peer: OpenPeer) -> None:
    scan, repetitions = scan_telegrams(0), iter(range(100))

    def repeat(connection: socket.socket) -> None:
        for _ in repetitions:
            connection.sendall(scan)
            time.sleep(0.02)

    _, driver = open_peer(telegrams(REPLIES), repeat)
    wait_until(lambda: driver.told("no scan for 0.5 s"))
    assert driver.diagnostics["scans"] == "1"


def wait_counters(driver: Lms111, count: int) -> list[int]:
    """The telegram counters of the first scans."""
    counters: list[int] = []
    wait_until(
        lambda: (
            counters.extend(scan.telegram_counter for scan in driver.collect(time.monotonic_ns()).samples)
            or len(counters) >= count
        )
    )
    return counters


@needs_captures
@pytest.mark.parametrize(
    ("counters", "lost", "skipped"),
    [
        (((65534, 65533), (65535, 65534), (0, 65535), (1, 0), (2, 1)), 0, 0),  # both wrap
        (((65534, 10), (1, 13)), 2, 0),  # lost on the way, across the wrap
        (((5, 10), (6, 13), (7, 14)), 0, 2),  # the device made two that it did not send
        (((40_000, 40_000), (1, 1), (2, 2)), 0, 0),  # it counts anew
    ],
)
def test_counters(counters: tuple[tuple[int, int], ...], lost: int, skipped: int, open_peer: OpenPeer) -> None:
    (scan,) = (decode(Dialect.B, payload) for payload in Receiver(Dialect.B).feed(scan_telegrams(0)))
    assert isinstance(scan, ScanData)
    replies = telegrams(REPLIES)
    for sent, made in counters:
        counted = replace(scan, telegram_counter=sent, scan_counter=made)
        replies["sEN LMDscandata"] += encode_scan_data(Dialect.B, counted)
    _, driver = open_peer(replies)
    assert wait_counters(driver, len(counters)) == [sent for sent, _ in counters]
    wait_until(lambda: driver.diagnostics["scans"] == str(len(counters)))
    assert driver.diagnostics["scans lost"] == str(lost)
    assert driver.diagnostics["scans skipped by the device"] == str(skipped)


def test_only_what_differs_is_written(open_peer: OpenPeer) -> None:
    present = {
        "sRN LMPscancfg": (2500, 1, 2500, -450000, 2250000),
        "sRN LMPoutputRange": (1, 2500, 0, 1800000),
        "sMN mLMPsetscancfg": (0, 5000, 1, 5000, -450000, 2250000),
        "sWN LMPoutputRange": (),
    }
    peer, driver = open_peer(telegrams(REPLIES | present))
    wait_until(lambda: driver.connects)
    changes = [c for c in peer.commands if c.name.startswith("sWN") or c.name == "sMN mLMPsetscancfg"]
    assert changes == [
        Command("sMN mLMPsetscancfg", (5000, 1, 5000, -450000, 2250000)),
        Command("sWN LMPoutputRange", (1, 5000, -450000, 2250000)),
    ]


@pytest.mark.parametrize(
    ("present", "message"),
    [
        ({"sMN SetAccessMode": (0,)}, "refuses the login"),
        ({"sEN LMDscandata": (0,)}, "refuses to stream"),
        (
            {"sRN LMPscancfg": (2500, 1, 2500, 0, 0), "sMN mLMPsetscancfg": (3, 2500, 1, 2500, 0, 0)},
            "refuses 50 Hz: frequency and resolution (code 3)",
        ),
        ({"sRN STlms": (0, 0, "", "", 0, 0, 0)}, "is undefined"),
        ({"sRN STlms": (1, 0, "", "", 0, 0, 0)}, "is initialising"),
        ({"sRN STlms": (2, 0, "", "", 0, 0, 0)}, "is in configuration"),
        ({"sRN STlms": (3, 0, "", "", 0, 0, 0)}, "is idle"),
        ({"sRN STlms": (4, 0, "", "", 0, 0, 0)}, "is rotating"),
        ({"sRN STlms": (5, 1, "", "", 0, 0, 0)}, "is in preparation"),
        ({"sRN STlms": (6, 0, "", "", 0, 0, 0)}, "is ready"),
        ({"sRN STlms": (8, 0, "", "", 0, 0, 0)}, "is in state 8"),
    ],
)
def test_a_device_that_refuses_or_is_not_ready_says_so(
    present: dict[str, Any], message: str, open_peer: OpenPeer
) -> None:
    _, driver = open_peer(telegrams(REPLIES | present))
    wait_until(lambda: driver.told(message))


def test_an_error_names_the_command(open_peer: OpenPeer) -> None:
    replies = telegrams(REPLIES) | {"sRN LMDscandatacfg": encode_command(Dialect.B, "sFA", 3)}
    peer, driver = open_peer(replies)
    wait_until(
        lambda: driver.told(f"LMS111 at 127.0.0.1:{peer.port} refuses sRN LMDscandatacfg: unknown variable (sFA 3)")
    )


def test_a_command_that_is_not_answered_is_named(open_peer: OpenPeer) -> None:
    replies = telegrams(REPLIES)
    del replies["sRN LMPscancfg"]
    _, driver = open_peer(replies)
    wait_until(lambda: driver.told("no answer to sRN LMPscancfg"))


def test_a_cut_reply_is_a_device_error(open_peer: OpenPeer) -> None:
    _, driver = open_peer(telegrams(REPLIES) | {"sRN LMPscancfg": frame(Dialect.B, b"sRA LMPscancfg \x00\x00")})
    wait_until(lambda: driver.told("telegram ends early"))


IDLE = {"sRN STlms": (3, 0, "00:34:19", "01.01.1970", 0, 0, 0)}


def test_a_question_that_a_firmware_ignores_or_answers_in_its_own_way_stays_open() -> None:
    known = {"sRN LocationName": ("level 2",), "sRN ODoprh": (1110,)}
    own_way = {"sRN DeviceIdent": frame(Dialect.B, b"sRA DeviceIdent LMS")}
    with closing(Peer(telegrams(REPLIES | IDLE | known) | own_way)) as peer:
        identity = identify("127.0.0.1", peer.port)
    assert (identity.model, identity.contamination) == (None, None)
    assert (identity.location, identity.operating_hours) == ("level 2", 111.0)


class Once(dict[str, bytes]):
    """Each is given once."""

    get = dict.pop


def test_a_scanner_that_falls_silent_while_it_is_asked_is_gone() -> None:
    replies = Once(telegrams(REPLIES | IDLE))
    with closing(Peer(replies)) as peer, pytest.raises(DeviceError, match="no answer to sRN STlms"):
        identify("127.0.0.1", peer.port)

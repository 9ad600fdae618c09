"""Telegrams against documented ones, and both directions against each other."""

import struct
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtlog_server.devices.lms111.cola import ColaError, Dialect, Receiver, frame
from rtlog_server.devices.lms111.protocol import LAYOUTS, Command, decode, encode_command, reply_name
from rtlog_server.devices.lms111.scan_data import (
    Channel,
    Encoder,
    Event,
    Position,
    ScanData,
    Timestamp,
    encode_scan_data,
)

DIALECTS = list(Dialect)
RANGES = {"B": (0, 255), "H": (0, 65535), "I": (0, 2**32 - 1), "h": (-32768, 32767), "i": (-(2**31), 2**31 - 1)}

# Real telegrams as SICK, drivers' issue trackers and a captured session (LMS111, V1.80.2) show them.
KNOWN_A = [
    (b"sMN SetAccessMode 03 F4724744", "sMN SetAccessMode", (3, 0xF4724744)),
    (b"sAN SetAccessMode 1", "sAN SetAccessMode", (1,)),
    (
        b"sMN mLMPsetscancfg +5000 +1 +5000 -450000 +2250000",
        "sMN mLMPsetscancfg",
        (5000, 1, 5000, -450000, 2250000),
    ),
    (
        b"sAN mLMPsetscancfg 0 1388 1 1388 FFF92230 225510",
        "sAN mLMPsetscancfg",
        (0, 5000, 1, 5000, -450000, 2250000),
    ),
    (b"sRA LMPscancfg 1388 1 1388 FFF92230 225510", "sRA LMPscancfg", (5000, 1, 5000, -450000, 2250000)),
    (b"sRA LMPoutputRange 1 1388 FFFC2F70 1F47D0", "sRA LMPoutputRange", (1, 5000, -250000, 2050000)),
    (
        b"sWN LMDscandatacfg 01 00 1 1 0 00 00 0 0 0 1 +1",
        "sWN LMDscandatacfg",
        (1, 0, 1, 1, 0, 0, 0, 0, 0, 0, 1, 1),
    ),
    (b"sRA STlms 7 0 8 00:34:19 A 01.01.1970 0 0 0", "sRA STlms", (7, 0)),
    (b"sRA LocationName B not defined", "sRA LocationName", ("not defined",)),
    (b"sRA FirmwareVersion 9 V1.80.1  ", "sRA FirmwareVersion", ("V1.80.1  ",)),
    (b"sRA FirmwareVersion 0", "sRA FirmwareVersion", ("",)),
    (b"sEA LMDscandata 1", "sEA LMDscandata", (1,)),
    (b"sWA LMPoutputRange", "sWA LMPoutputRange", ()),
    (b"sFA A", "sFA", (10,)),
]
KNOWN_B = [
    (b"sMN SetAccessMode \x03\xf4rGD", "sMN SetAccessMode", (3, 0xF4724744)),
    (b"sRA FirmwareVersion \x00\x09V1.80.2  ", "sRA FirmwareVersion", ("V1.80.2  ",)),
    (b"sRA ODoprh \x00\x00\x04\x56", "sRA ODoprh", (1110,)),
    (
        b'sRA LMPoutputRange \x00\x01\x00\x00\x13\x88\xff\xf9"3\x00"U\x0d',
        "sRA LMPoutputRange",
        (1, 5000, -449997, 2249997),
    ),
    (
        bytes.fromhex("73524120 4c4d44736361 6e646174 61636667 20 01000000000000000000010001"),
        "sRA LMDscandatacfg",
        (1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1),
    ),
    (b"sRA STlms \x07\x00\x00\x0800:34:19", "sRA STlms", (7, 0)),
    (b"sRA STlms \x00\x07\x00\x01\x00\x0800:34:19", "sRA STlms", (7, 1)),
    (b"sRA STlms \x00\x01\x00\x0800:34:19", "sRA STlms", (0, 1)),
    (b"sFA\x00\x03", "sFA", (3,)),
    (b"sRN FirmwareVersion", "sRN FirmwareVersion", ()),
    (b"sWA LMPoutputRange ", "sWA LMPoutputRange", ()),
]


@pytest.mark.parametrize(("payload", "name", "values"), KNOWN_A)
def test_known_telegrams_of_cola_a(payload: bytes, name: str, values: tuple[Any, ...]) -> None:
    assert decode(Dialect.A, payload) == Command(name, values)
    if not payload.endswith(b"0"):
        assert decode(Dialect.A, payload + b" 1 2 3") == Command(name, values)


@pytest.mark.parametrize(("payload", "name", "values"), KNOWN_B)
def test_known_telegrams_of_cola_b(payload: bytes, name: str, values: tuple[Any, ...]) -> None:
    assert decode(Dialect.B, payload) == Command(name, values)
    assert decode(Dialect.B, payload + b" more") == Command(name, values)
    if name != "sRA STlms":  # of which only the state is read
        assert encode_command(Dialect.B, name, *values) == frame(Dialect.B, payload)


@pytest.mark.parametrize(
    "payload",
    [
        b"sAN SetAccessMode",
        b"sAN SetAccessMode x",
        b"sAN SetAccessMode -1",
        b"sAN SetAccessMode 100",
        b"sAN SetAccessMode 1_0",
        b"sRA LMPscancfg 1388 1 1388 FFF92230",
        b"sRA LMPscancfg 1388  1 1388 FFF92230 225510",
        b"sRA LocationName C not defined",
        b"sRA LocationName 2 not defined",
        b"sRA LMPscancfg " + 5000 * b"9",
        b"hello",
        b"",
    ],
)
def test_bad_telegrams_of_cola_a(payload: bytes) -> None:
    with pytest.raises(ColaError):
        decode(Dialect.A, payload)


@pytest.mark.parametrize(
    "payload", [b"sAN SetAccessMode ", b"sRA ODoprh \0\0\0", b"sRA LocationName \0\x0bnot", b"sFA\0"]
)
def test_bad_telegrams_of_cola_b(payload: bytes) -> None:
    with pytest.raises(ColaError):
        decode(Dialect.B, payload)


def test_reply_names() -> None:
    assert [reply_name(f"{verb} x") for verb in ("sRN", "sWN", "sMN", "sEN")] == ["sRA x", "sWA x", "sAN x", "sEA x"]


def strategy_of(code: str) -> st.SearchStrategy[Any]:
    texts = st.text(st.characters(min_codepoint=32, max_codepoint=255), max_size=20)
    return texts if code == "s" else st.integers(*RANGES[code])


commands = st.sampled_from(sorted(set(LAYOUTS) - {"sRA STlms"})).flatmap(
    lambda name: st.tuples(st.just(name), st.tuples(*(strategy_of(code) for code in LAYOUTS[name])))
)


@given(command=commands, dialect=st.sampled_from(DIALECTS))
def test_commands_come_back_as_they_went(command: tuple[str, tuple[Any, ...]], dialect: Dialect) -> None:
    name, values = command
    (payload,) = Receiver(dialect).feed(encode_command(dialect, name, *values))
    assert decode(dialect, payload) == Command(name, values)


floats32 = st.floats(-1e6, 1e6, width=32)
scales = st.floats(0.125, 100.0, width=32)
texts = st.text(st.characters(min_codepoint=32, max_codepoint=255), max_size=16)


def integers(code: str) -> st.SearchStrategy[int]:
    return st.integers(*RANGES[code])


def channels(dtype: type, top: int) -> st.SearchStrategy[tuple[Channel, ...]]:
    data = st.lists(st.integers(0, top), max_size=12).map(lambda values: np.array(values, dtype))
    content = st.sampled_from(["DIST1", "DIST2", "RSSI1", "RSSI2"])
    channel = st.builds(Channel, content, scales, floats32, integers("i"), integers("H"), data)
    return st.lists(channel, max_size=3).map(tuple)


scan_data = st.builds(
    ScanData,
    *(integers(code) for code in "HHI"),
    st.tuples(integers("B"), integers("B")),
    *(integers(code) for code in "HHII"),
    st.tuples(integers("B"), integers("B")),
    st.tuples(integers("B"), integers("B")),
    *(integers(code) for code in "HII"),
    st.lists(st.builds(Encoder, integers("i"), integers("h")), max_size=3).map(tuple),
    channels(np.uint16, 65535),
    channels(np.uint8, 255),
    st.none() | st.builds(Position, *(floats32 for _ in range(6)), integers("B"), integers("B")),
    st.none() | texts,
    st.none() | texts,
    st.none() | st.builds(Timestamp, *(integers(code) for code in "HBBBBBI")),
    st.none() | st.builds(Event, st.just("FDIN"), *(integers(code) for code in "IIi")),
)


def plain(value: Any) -> Any:
    """A record as nested lists and dicts, to be compared with `==`."""
    if isinstance(value, ScanData | Channel):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, np.ndarray):
        return value.dtype.kind, value.dtype.itemsize, value.tolist()
    return [plain(item) for item in value] if isinstance(value, tuple) else value


@given(scan=scan_data, dialect=st.sampled_from(DIALECTS), tail=st.sampled_from([b"", b" 0", b" 0 0 0 0"]))
def test_scans_come_back_as_they_went(scan: ScanData, dialect: Dialect, tail: bytes) -> None:
    (payload,) = Receiver(dialect).feed(encode_scan_data(dialect, scan))
    decoded = decode(dialect, payload + tail)
    assert plain(decoded) == plain(scan)


@given(scan=scan_data, dialect=st.sampled_from(DIALECTS), data=st.data())
@settings(max_examples=60)
def test_a_short_scan_is_refused(scan: ScanData, dialect: Dialect, data: st.DataObject) -> None:
    (payload,) = Receiver(dialect).feed(encode_scan_data(dialect, scan))
    cut = data.draw(st.integers(len(b"sSN LMDscandata"), len(payload) - 1))
    if dialect is Dialect.A and payload[cut : cut + 1] != b" ":
        return  # cut inside of a number, a shorter number is left: CoLa A cannot tell
    with pytest.raises(ColaError):
        decode(dialect, payload[:cut])


@given(head=st.sampled_from([b"", *(f"{name} ".encode() for name in (*LAYOUTS, "sSN LMDscandata"))]), tail=st.binary())
def test_arbitrary_bytes_raise_nothing_else(head: bytes, tail: bytes) -> None:
    for dialect in DIALECTS:
        with suppress(ColaError):
            decode(dialect, head + tail)


@given(scan=scan_data, dialect=st.sampled_from(DIALECTS), data=st.data())
@settings(max_examples=60)
def test_a_flipped_byte_raises_nothing_else(scan: ScanData, dialect: Dialect, data: st.DataObject) -> None:
    (payload,) = Receiver(dialect).feed(encode_scan_data(dialect, scan))
    broken = bytearray(payload)
    broken[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ColaError):
        decode(dialect, bytes(broken))


@pytest.mark.parametrize("dialect", DIALECTS)
def test_impossible_counts_are_refused(dialect: Dialect) -> None:
    scan = ScanData(1, 1, 1, (0, 0), 1, 1, 1, 1, (0, 0), (0, 0), 0, 5000, 360, (), (), ())
    (payload,) = Receiver(dialect).feed(encode_scan_data(dialect, scan))
    encoders = payload.replace(struct.pack(">IH", 360, 0), struct.pack(">IH", 360, 65535))
    encoders = encoders.replace(b" 168 0", b" 168 FFFF")
    assert encoders != payload
    with pytest.raises(ColaError, match="65535"):
        decode(dialect, encoders)


@pytest.mark.parametrize(
    "data",
    [b"1  3", b"1 2 3x", b"1 2 10000", b"1 2 100000", b"1 2 \t\t12", b"1 2 0x3", b"1 2 +3", b"1 2", b"1 2 \xff3"],
)
def test_bad_values_of_cola_a(data: bytes) -> None:
    scan = ScanData(1, 1, 1, (0, 0), 1, 1, 1, 1, (0, 0), (0, 0), 0, 5000, 360, (), (), ())
    channel = Channel("DIST1", 1.0, 0.0, 0, 5000, np.array([1, 2, 3], np.uint16))
    (payload,) = Receiver(Dialect.A).feed(encode_scan_data(Dialect.A, replace(scan, channels16=(channel,))))
    head, tail = payload.split(b" 1 2 3 ")
    assert isinstance(decode(Dialect.A, head + b" 1 02 0003 " + tail), ScanData)
    with pytest.raises(ColaError):
        decode(Dialect.A, head + b" " + data + b" " + tail)

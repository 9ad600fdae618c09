"""CANopen frames as the manuals give them, both ways, and whatever else a bus may bring."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.protocol import (
    CanOpenError,
    Emergency,
    Frame,
    Heartbeat,
    Pdo,
    SdoReply,
    decode,
    decode_position,
    describe_device_type,
    describe_emergency,
    describe_error_frame,
    encode_emergency,
    encode_heartbeat,
    nmt_command,
    position_shift,
    wire_ns,
)

nodes = st.integers(1, 127)
frames = st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8))


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        (Frame(0x705, b"\x00"), Heartbeat(5, protocol.BOOT_UP)),
        (Frame(0x705, b"\x7f"), Heartbeat(5, protocol.PRE_OPERATIONAL)),
        (Frame(0x705, b"\x85"), Heartbeat(5, protocol.OPERATIONAL)),  # the toggle bit of node guarding
        (Frame(0x77F, b"\x04"), Heartbeat(127, protocol.STOPPED)),
        (Frame(0x085, bytes.fromhex("00 10 81 01 02 00 00 00")), Emergency(5, 0x1000, 0x81, b"\x01\x02\0\0\0")),
        (Frame(0x185, bytes.fromhex("A1 86 01 00")), Pdo(5, 1, bytes.fromhex("A1 86 01 00"))),
        (Frame(0x285, b""), Pdo(5, 2, b"")),
        (Frame(0x585, bytes.fromhex("43 00 10 00 96 01 02 00")), SdoReply(5, bytes.fromhex("4300100096010200"))),
        (Frame(0x080, b""), None),  # SYNC
        (Frame(0x000, b"\x01\x05"), None),
        (Frame(0x605, bytes(8)), None),
        (Frame(0x385, bytes(8)), None),
        (Frame(0x700, b"\x00"), None),
    ],
)
def test_what_nodes_say(frame: Frame, said: object) -> None:
    assert decode(frame) == said


@pytest.mark.parametrize(
    ("frame", "complaint"),
    [
        (Frame(0x705, b""), "heartbeat of node 5 has 0 bytes, not 1"),
        (Frame(0x705, b"\x05\x05"), "heartbeat of node 5 has 2 bytes, not 1"),
        (Frame(0x0FF, bytes(7)), "emergency of node 127 has 7 bytes, not 8"),
        (Frame(0x585, bytes(4)), "SDO reply of node 5 has 4 bytes, not 8"),
    ],
)
def test_frames_of_the_wrong_length_are_refused(frame: Frame, complaint: str) -> None:
    with pytest.raises(CanOpenError, match=complaint):
        decode(frame)


@given(frames)
def test_any_frame_is_something_or_nothing(frame: Frame) -> None:
    try:
        said = decode(frame)
    except CanOpenError:
        return
    if isinstance(said, Emergency):
        assert "\n" not in describe_emergency(said)
        assert encode_emergency(said) == frame
    if isinstance(said, Heartbeat):
        assert encode_heartbeat(said.node, said.state).can_id == frame.can_id


@given(st.integers(0, 0x1FFF_FFFF), st.binary(max_size=8))
def test_any_error_frame_is_described(classes: int, data: bytes) -> None:
    assert describe_error_frame(classes, data)


def test_commands_are_those_of_the_standard() -> None:
    assert nmt_command(protocol.START, 5) == Frame(0, b"\x01\x05")
    assert nmt_command(protocol.ENTER_PRE_OPERATIONAL, 0) == Frame(0, b"\x80\x00")
    assert Frame(0x80, b"") == protocol.SYNC_FRAME


@given(nodes, st.integers(0, 0xFFFF), st.integers(0, 0xFF), st.binary(min_size=5, max_size=5))
def test_an_emergency_comes_back_as_it_was_sent(node: int, code: int, register: int, vendor: bytes) -> None:
    emergency = Emergency(node, code, register, vendor)
    assert decode(encode_emergency(emergency)) == emergency


def test_emergencies_are_told_by_their_class() -> None:
    assert describe_emergency(Emergency(5, 0x3110, 0x05, bytes(5))) == "emergency 3110h, voltage, error register 05h"
    assert "protocol" in describe_emergency(Emergency(5, 0x8210, 0x11, bytes(5)))
    assert "device specific" in describe_emergency(Emergency(5, 0xFF01, 0x81, b"\x09\0\0\0\0"))
    assert "unknown class" in describe_emergency(Emergency(5, 0xB000, 0, bytes(5)))


def test_the_position_is_found_in_a_mapping() -> None:
    assert position_shift([0x60040020]) == 0
    assert position_shift([0x60300010, 0x65030010, 0x60040020]) == 32
    assert position_shift([0x60300010]) is None
    assert position_shift([]) is None


@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.binary(max_size=4))
def test_a_position_is_read_wherever_it_lies(position: int, before: int, after: bytes) -> None:
    data = bytes(range(before)) + position.to_bytes(4, "little") + after
    assert decode_position(data, 8 * before, 1 << 32) == position


@given(st.binary(max_size=8), st.integers(0, 64), st.integers(1, 1 << 32))
def test_a_position_lies_within_the_range_or_is_refused(data: bytes, shift: int, total_range: int) -> None:
    with suppress(CanOpenError):
        assert 0 <= decode_position(data, shift, total_range) < total_range


def test_device_types_are_named() -> None:
    assert describe_device_type(0x0002_0196) == "device profile 406 (encoder)"
    assert describe_device_type(0x0002_0192) == "device profile 402 (drive)"
    assert describe_device_type(0x0000_0FFF) == "device profile 4095"


def test_error_frames_tell_how_the_controller_is() -> None:
    assert describe_error_frame(0x40, bytes(8)) == "bus-off"
    assert describe_error_frame(0x04, b"\x00\x20" + bytes(6)) == "error passive"
    assert describe_error_frame(0x04, b"\x00\x40" + bytes(6)) == "ok"  # active again
    assert describe_error_frame(0x20, bytes(8)) == "no acknowledge"
    assert describe_error_frame(0x100, bytes(8)) == "restarted"


def test_time_on_the_wire() -> None:
    assert wire_ns(0, 500_000) == 94_000
    assert wire_ns(8, 125_000) == 888_000

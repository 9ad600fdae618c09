"""SEI requests and replies as the bytes that US Digital's protocol page and the drivers in the field show."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.protocol import Request, SeiError


def test_requests_are_command_and_address_nibble() -> None:
    assert protocol.position_request(0) == b"\x10"
    assert protocol.position_request(14) == b"\x1e"
    assert protocol.serial_number_request(3) == b"\xf3\x03"
    assert protocol.reset_request() == b"\xff\x0e"
    assert protocol.fast_baud_request() == b"\xff\x0f\x00"


def test_a_strobe_goes_to_all_encoders() -> None:
    assert protocol.strobe_request() == b"\x4f"


@pytest.mark.parametrize(
    ("reply", "multi_turn", "counts"),
    [
        ("0000", False, 0),
        ("0fff", False, 4095),
        ("00020123", True, 2 * 4096 + 0x123),
        ("ffff0fff", True, 65536 * 4096 - 1),
    ],
)
def test_positions_come_most_significant_byte_first(reply: str, multi_turn: bool, counts: int) -> None:
    assert protocol.decode_position(bytes.fromhex(reply), 4096, multi_turn) == counts


@pytest.mark.parametrize(("reply", "multi_turn"), [("1000", False), ("ffff", False), ("0e", False), ("0e0e00", False),
                                                   ("0123", True), ("00021000", True), ("", True)])  # fmt: skip
def test_a_position_of_wrong_length_or_beyond_the_turn_is_refused(reply: str, multi_turn: bool) -> None:
    with pytest.raises(SeiError, match=r"bytes, not|beyond"):
        protocol.decode_position(bytes.fromhex(reply), 4096, multi_turn)


@given(st.integers(2, 65536), st.integers(-(10**9), 10**9), st.booleans())
def test_what_the_encoder_sends_the_host_reads(counts_per_turn: int, counts: int, multi_turn: bool) -> None:
    reply = protocol.encode_position(counts, counts_per_turn, multi_turn)
    modulus = counts_per_turn * (65536 if multi_turn else 1)
    assert protocol.decode_position(reply, counts_per_turn, multi_turn) == counts % modulus


def test_the_echo_is_told_by_length_even_where_a_position_begins_like_its_request() -> None:
    assert protocol.learn_echo(b"\x10\x0a\xbc", b"\x10", 2) is True
    assert protocol.learn_echo(b"\x10\xbc", b"\x10", 2) is False  # position 10BC at address 0
    assert protocol.learn_echo(b"\x10\x10\xbc", b"\x10", 2) is True
    for received in (b"", b"\x10", b"\x11\x0a\xbc", b"\x10\x0a\xbc\x00"):
        assert protocol.learn_echo(received, b"\x10", 2) is None


def test_the_echo_is_taken_off() -> None:
    assert protocol.strip_echo(b"\x10\x0a\xbc", b"\x10", echo=True) == b"\x0a\xbc"
    assert protocol.strip_echo(b"\x10", b"\x10", echo=True) == b""
    assert protocol.strip_echo(b"", b"\x10", echo=True) == b""
    assert protocol.strip_echo(b"\x10\xbc", b"\x10", echo=False) == b"\x10\xbc"
    with pytest.raises(SeiError, match="echo of 10 came back as 30"):
        protocol.strip_echo(b"\x30\x0a\xbc", b"\x10", echo=True)


def test_a_serial_number_has_four_bytes_and_a_checksum() -> None:
    assert protocol.decode_serial_number(b"\x00\x01\x02\x03\xaa") == 0x010203
    assert protocol.decode_serial_number(protocol.encode_serial_number(61001)) == 61001
    with pytest.raises(SeiError, match="4 bytes"):
        protocol.decode_serial_number(b"\x00\x01\x02\x03")


def test_the_encoder_takes_requests_whole_byte_by_byte_and_with_a_tail() -> None:
    stream = b"\x12\xf3\x03\xff\x0f\x00\x4f\xf1\x99\x10"
    expected = [
        Request(2, protocol.POSITION, False, b""),
        Request(3, protocol.READ_SERIAL_NUMBER, True, b""),
        Request(15, protocol.SET_BAUD, True, b"\x00"),
        Request(15, 0x4, False, b""),
        Request(1, 0x99, True, b""),
        Request(0, protocol.POSITION, False, b""),
    ]
    whole, slowly = bytearray(stream + b"\xff\x0f"), bytearray()
    assert list(iter(lambda: protocol.take_request(whole), None)) == expected
    assert whole == b"\xff\x0f"  # waits for the rest
    taken = []
    for byte in stream:
        slowly.append(byte)
        taken += iter(lambda: protocol.take_request(slowly), None)
    assert taken == expected


@given(st.binary(max_size=12), st.integers(2, 65536), st.booleans(), st.booleans())
def test_any_bytes_give_a_position_or_an_sei_error(data: bytes, counts: int, multi_turn: bool, echo: bool) -> None:
    request = protocol.position_request(0)
    try:
        position = protocol.decode_position(protocol.strip_echo(data, request, echo), counts, multi_turn)
    except SeiError:
        return
    assert 0 <= position < counts * (65536 if multi_turn else 1)

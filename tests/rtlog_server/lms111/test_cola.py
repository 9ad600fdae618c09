"""Framing: whatever comes before, between or after, every whole telegram is found, and nothing is hoarded."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtlog_server.devices.lms111.cola import MAX_PAYLOAD_BYTES, ColaError, Dialect, Receiver, frame, split_command

DIALECTS = list(Dialect)
# The login of a captured session (LMS111, firmware V1.80.2), and what the same command is in CoLa A.
LOGIN_B = bytes.fromhex("0202020200000017734d4e205365744163636573734d6f64652003f4724744b3")
LOGIN_A = b"\x02sMN SetAccessMode 03 F4724744\x03"
PAYLOADS = [b"sRA ODoprh 456", b"sSN LIDoutputstate \x00\x01\x04\x05", b"sAN Run 1"]

text_payloads = st.binary(max_size=60).map(lambda tail: b"sRA x " + tail.replace(b"\x02", b"").replace(b"\x03", b""))
binary_payloads = st.binary(max_size=60).map(lambda tail: b"sRA x " + tail)
dialects_and_payloads = st.sampled_from(DIALECTS).flatmap(
    lambda dialect: st.tuples(
        st.just(dialect), st.lists(text_payloads if dialect is Dialect.A else binary_payloads, max_size=6)
    )
)


def test_captured_frames() -> None:
    assert Receiver(Dialect.B).feed(LOGIN_B) == [b"sMN SetAccessMode \x03\xf4rGD"]
    assert frame(Dialect.B, b"sMN SetAccessMode \x03\xf4rGD") == LOGIN_B
    assert Receiver(Dialect.A).feed(LOGIN_A) == [b"sMN SetAccessMode 03 F4724744"]
    assert frame(Dialect.A, b"sMN SetAccessMode 03 F4724744") == LOGIN_A


@given(case=dialects_and_payloads, cuts=st.lists(st.integers(0, 500), max_size=8))
def test_cut_at_any_place(case: tuple[Dialect, list[bytes]], cuts: list[int]) -> None:
    dialect, payloads = case
    stream = b"".join(frame(dialect, payload) for payload in payloads)
    receiver = Receiver(dialect)
    ends = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    found = [p for a, b in pairwise(ends) for p in receiver.feed(stream[a:b])]
    assert found == payloads
    assert receiver.skipped_bytes == 0


@given(case=dialects_and_payloads)
def test_byte_by_byte(case: tuple[Dialect, list[bytes]]) -> None:
    dialect, payloads = case
    receiver = Receiver(dialect)
    stream = b"".join(frame(dialect, payload) for payload in payloads)
    assert [p for byte in stream for p in receiver.feed(bytes([byte]))] == payloads


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(
    "garbage",
    [
        b"\x00",
        b"HTTP/1.1 400 Bad Request\r\n",
        b"\x02",
        b"\x02\x02",
        b"\x02\x02\x02",
        4 * b"\x02",
        4 * b"\x02" + b"\xff\xff\xff\xff",  # a length that no telegram has
        4 * b"\x02" + b"\x00\x00\x00\x00",
        4 * b"\x02" + b"\x00\x00\x00\x05xxxxx\x00",  # no command
        4 * b"\x02" + b"\x00\x00\x00\x09sAN Run 1\x00",  # a wrong checksum
        4 * b"\x02" + b"\x00\x00\x00\x40sAN Run",  # cut off: the next telegram follows where its end should be
        b"\x02sAN Ru",
    ],
)
def test_garbage_costs_no_telegram(dialect: Dialect, garbage: bytes) -> None:
    receiver = Receiver(dialect)
    stream = garbage + b"".join(frame(dialect, payload) for payload in 8 * PAYLOADS)
    found = [p for byte in stream for p in receiver.feed(bytes([byte]))]
    assert found == 8 * PAYLOADS
    assert receiver.skipped_bytes == len(garbage)


def test_a_head_inside_of_a_payload_is_no_head() -> None:
    # As captured: LIDinputstate carries 02 02 02 02.
    captured = bytes.fromhex("020202020000001e735241204c4944696e7075747374617465200001000000000202020200002102020202")
    receiver = Receiver(Dialect.B)
    assert receiver.feed(captured) == [b"sRA LIDinputstate \x00\x01\x00\x00\x00\x00\x02\x02\x02\x02\x00\x00"]
    assert receiver.skipped_bytes == 0


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(
    ("first", "flood"),
    [
        (b"", b"\x02"),
        (b"", b"s"),
        (b"", b"\x02s"),
        (b"\x02", b"s"),  # a text that does not end
        (b"", bytes(range(256))),
        (b"", 4 * b"\x02" + b"\x00\x00\xff\xf0s"),
        (4 * b"\x02" + b"\x7f\xff\xff\xff", b"s"),  # a length of 2 GB
    ],
)
def test_no_stream_fills_the_memory(dialect: Dialect, first: bytes, flood: bytes) -> None:
    receiver = Receiver(dialect)
    receiver.feed(first)
    piece = flood * (8192 // len(flood))
    for _ in range(40):
        receiver.feed(piece)
        assert len(receiver._buffer) <= MAX_PAYLOAD_BYTES + 9


hostile = st.lists(
    st.binary(max_size=20)
    | st.sampled_from(
        [b"\x02", b"\x03", 4 * b"\x02", b"\x02s", 4 * b"\x02" + b"\0\0\0\x09sAN Run 1", b"\x02sAN Run 1\x03"]
    )
    | st.sampled_from(DIALECTS).map(lambda dialect: frame(dialect, b"sAN Run 1")),
    max_size=30,
).map(b"".join)


@given(data=hostile, dialect=st.sampled_from(DIALECTS), piece=st.integers(1, 40))
def test_of_any_bytes_the_same_is_found_however_they_are_cut_and_all_is_accounted_for(
    data: bytes, dialect: Dialect, piece: int
) -> None:
    whole, pieces = Receiver(dialect), Receiver(dialect)
    found = whole.feed(data)
    assert [p for start in range(0, len(data), piece) for p in pieces.feed(data[start : start + piece])] == found
    for receiver in (whole, pieces):
        told = sum(len(frame(dialect, payload)) for payload in found) + receiver.skipped_bytes
        assert told + len(receiver._buffer) == len(data)


def test_commands() -> None:
    assert split_command(b"sRA LMPscancfg \x00\x01") == ("sRA LMPscancfg", b"\x00\x01")
    assert split_command(b"sWA LMPoutputRange ") == ("sWA LMPoutputRange", b"")
    assert split_command(b"sRN STlms") == ("sRN STlms", b"")
    assert split_command(b"sFA\x00\x03") == ("sFA", b"\x00\x03")
    assert split_command(b"sFA 3") == ("sFA", b"3")
    for nonsense in (b"", b"s", b"sRA", b"sRA ", b"hello world", b"sRA  LMPscancfg 1"):
        with pytest.raises(ColaError):
            split_command(nonsense)

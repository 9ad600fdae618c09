"""Bringing an encoder into the state that is needed, the emulated one's objects at the other end of the transfers."""

from collections.abc import Iterable
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.configuration import NodeSettings, WrongNodeError, configure, identify
from rtlog_server.devices.cia406.emulated_encoder import EmulatedEncoder, Entry
from rtlog_server.devices.cia406.protocol import CanOpenError, Frame
from rtlog_server.devices.cia406.sdo import NodeObjects, NodeSilentError

RANGE = 4096 * 4096
ENCODER = Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35)
AT_SYNC = CanBus(channel="can0")
BY_TIMER = CanBus(channel="can0", trigger="timer", timer_ms=25)


class Server:
    """An emulated encoder's SDO server, until `spoilt` has something else to answer."""

    def __init__(self, spoilt: Iterable[bytes | None] = (), kind: type[EmulatedEncoder] = EmulatedEncoder) -> None:
        self.encoder = kind(5, 4096, lambda _at_ns: 77)
        self.objects = NodeObjects(5, self.send, self.await_reply)
        self._spoilt = iter(spoilt)
        self._reply: bytes | None = None
        self.requests = 0

    def send(self, frame: Frame) -> None:
        answers = self.encoder.take(frame, 0)
        self._reply = answers[0].data if answers else None
        self.requests += 1

    def await_reply(self, _node: int, _deadline_ns: int) -> bytes | None:
        return next(self._spoilt, None) or self._reply


class Forgetful(EmulatedEncoder):
    """Says yes to all that is written, and keeps none of it."""

    def set_data(self, *_arguments: object, **_named: object) -> None:
        pass


def test_an_encoder_fresh_from_the_maker_needs_its_heartbeat_only() -> None:
    server = Server()
    assert identify(server.objects, 5, AT_SYNC).endswith("serial number 83005")
    assert configure(server.objects, 5, ENCODER, AT_SYNC) == NodeSettings(2, 0, RANGE, "ok")
    assert server.encoder.written == [(protocol.HEARTBEAT_MS, 200)]


def test_a_timer_is_set_and_where_there_is_none_the_older_one() -> None:
    server = Server()
    assert configure(server.objects, 5, ENCODER, BY_TIMER).pdo == 1
    assert server.encoder.objects[(0x1800, 5)].value == 25
    older = Server()
    del older.encoder.objects[(0x1800, 5)]
    older.encoder.objects[protocol.CYCLIC_TIMER_MS] = Entry(0, 2, True)
    configure(older.objects, 5, ENCODER, BY_TIMER)
    assert older.encoder.objects[protocol.CYCLIC_TIMER_MS].value == 25


def test_a_pdo_under_another_identifier_is_taken_off_the_bus_and_put_right() -> None:
    server = Server()
    server.encoder.objects[(0x1801, 1)].value = 0x4000_0000 | 0x299  # on, and not to be asked for by remote frames
    configure(server.objects, 5, ENCODER, AT_SYNC)
    assert server.encoder.objects[(0x1801, 1)].value == 0x4000_0000 | 0x285


def test_an_object_that_does_not_keep_what_is_written_is_refused() -> None:
    server = Server(kind=Forgetful)
    with pytest.raises(WrongNodeError, match=r"object 1017h:0 stays at 0 and must be 200"):
        configure(server.objects, 5, ENCODER, AT_SYNC)


def test_an_unscaled_encoder_with_the_right_steps_is_left_unscaled() -> None:
    server = Server()
    server.encoder.objects[protocol.OPERATING].value = 0
    server.encoder.objects[protocol.UNITS_PER_TURN].value = 360
    assert configure(server.objects, 5, ENCODER, AT_SYNC).total_range == RANGE
    assert server.encoder.written == [(protocol.HEARTBEAT_MS, 200)]


def test_a_range_of_broken_turns_is_made_whole() -> None:
    server = Server()
    server.encoder.objects[protocol.TOTAL_RANGE].value = 10_000
    assert configure(server.objects, 5, ENCODER, AT_SYNC).total_range == RANGE
    assert server.encoder.objects[protocol.TOTAL_RANGE].value == RANGE


def test_a_silent_node_is_told_with_what_it_was_asked() -> None:
    objects = NodeObjects(5, lambda _frame: None, lambda _node, _deadline_ns: None)
    with pytest.raises(NodeSilentError, match=r"^no answer \(object 1000h:0\)$"):
        identify(objects, 5, AT_SYNC)


@given(st.lists(st.none() | st.binary(min_size=8, max_size=8), max_size=30))
def test_any_answers_are_understood_or_refused(spoilt: list[bytes | None]) -> None:
    server = Server(spoilt)
    with suppress(CanOpenError):
        assert "\n" not in identify(server.objects, 5, AT_SYNC)
        assert configure(server.objects, 5, ENCODER, AT_SYNC).total_range % 4096 == 0
    assert server.requests < 300

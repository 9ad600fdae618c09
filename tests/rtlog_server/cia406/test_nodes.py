"""Whatever a bus brings, and whatever a node answers: no exception, no growth, no position beyond the encoder's."""

from collections.abc import Iterator
from contextlib import suppress

from hypothesis import given
from hypothesis import strategies as st

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406.configuration import NodeSettings, configure, identify
from rtlog_server.devices.cia406.emulated_encoder import EmulatedEncoder
from rtlog_server.devices.cia406.nodes import LOST_NS, SEEK_NS, Nodes
from rtlog_server.devices.cia406.protocol import CanOpenError, Frame, encode_heartbeat
from rtlog_server.devices.cia406.rounds import SyncRounds
from rtlog_server.devices.cia406.sdo import NodeObjects
from rtlog_server.devices.device import TickGrid

RANGE = 4096 * 4096
ENCODERS = [
    Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=6, wheel_radius_m=0.35),
]
BUS = CanBus(channel="can0")
MS = 1_000_000

near = st.sampled_from([service + node for service in (0x80, 0x180, 0x280, 0x580, 0x700) for node in (5, 6, 7)])
frames = st.builds(Frame, near | st.integers(0, 0x7FF), st.binary(max_size=8))


def running_nodes() -> Nodes:
    nodes = Nodes(ENCODERS)
    nodes.rounds = SyncRounds(TickGrid(0, 100 * MS), 94_000, 0)
    for node in nodes:
        node.run(NodeSettings(2, 0, RANGE, "ok"), 0)
        nodes.rounds.join(node.name)
    return nodes


@given(st.lists(frames, max_size=60))
def test_any_frames_are_taken(received: list[Frame]) -> None:
    nodes = running_nodes()
    assert nodes.rounds is not None
    nodes.rounds.sent(0)
    for k, frame in enumerate(received):
        fixes = nodes.take(frame, k * MS)
        if fixes is not None:
            assert set(fixes) == {"left_wheel", "right_wheel"}
            assert all(0 <= fix.raw < RANGE for fix in fixes.values())
            nodes.finish_round(fixes)
            nodes.rounds.sent(k * MS)
        node = nodes.due(k * MS)
        assert node is None or "\n" not in node.health + nodes.problems() + nodes.last_garbled


def test_a_node_that_falls_silent_is_away_and_sought_from_time_to_time() -> None:
    nodes = running_nodes()
    left, right = nodes
    for now_ns in range(0, LOST_NS + 1, 10 * MS):
        nodes.take(encode_heartbeat(6, 5), now_ns)
    assert nodes.due(LOST_NS) is None
    assert nodes.due(LOST_NS + 1) is None
    assert (left.running, right.running) == (False, True)
    assert nodes.problems() == "left_wheel (node 5): heartbeat lost"
    nodes.take(encode_heartbeat(6, 5), LOST_NS + SEEK_NS)
    assert nodes.due(LOST_NS + SEEK_NS + 2) is left
    nodes.take(encode_heartbeat(5, 0), LOST_NS + SEEK_NS + 3)  # it boots, and need not be sought
    left.sought_ns = LOST_NS + SEEK_NS + 3
    assert nodes.due(LOST_NS + SEEK_NS + 4) is left


def test_only_what_the_encoders_send_is_counted_as_garbled() -> None:
    nodes = running_nodes()
    nodes.take(Frame(0x7FF, b""), 1)  # a heartbeat of node 127, too short
    assert nodes.tally["garbled"] == 0
    nodes.take(Frame(0x705, b""), 1)
    assert nodes.tally["garbled"] == 1
    assert nodes.last_garbled == "heartbeat of node 5 has 0 bytes, not 1"


class Answering:
    """An SDO server that is an emulated encoder's until `spoilt` has something else to answer."""

    def __init__(self, spoilt: Iterator[bytes | None]) -> None:
        self._encoder = EmulatedEncoder(5, 4096, lambda _at_ns: 77)
        self._spoilt = spoilt
        self._reply: bytes | None = None
        self.requests = 0

    def send(self, frame: Frame) -> None:
        answers = self._encoder.take(frame, 0)
        self._reply = answers[0].data if answers else None
        self.requests += 1

    def await_reply(self, _node: int, _deadline_ns: int) -> bytes | None:
        return next(self._spoilt, None) or self._reply


answers = st.lists(st.none() | st.binary(min_size=8, max_size=8), max_size=30)


@given(answers)
def test_any_answers_to_the_configuration_are_understood_or_refused(spoilt: list[bytes | None]) -> None:
    server = Answering(iter(spoilt))
    objects = NodeObjects(5, server.send, server.await_reply)
    with suppress(CanOpenError):
        assert "\n" not in identify(objects, 5, BUS)
        assert configure(objects, 5, ENCODERS[0], BUS).total_range % 4096 == 0
    assert server.requests < 300


def test_an_encoder_that_answers_as_it_should_is_configured() -> None:
    server = Answering(iter([]))
    objects = NodeObjects(5, server.send, server.await_reply)
    assert identify(objects, 5, BUS).endswith("serial number 83005")
    assert configure(objects, 5, ENCODERS[0], BUS) == NodeSettings(2, 0, RANGE, "ok")

"""Who runs and who is to be brought up; and whatever a bus brings: no exception, no position beyond the encoder's."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hw_profiles.profile import Encoder
from rtlog_server.devices.cia406 import protocol
from rtlog_server.devices.cia406.configuration import NodeSettings
from rtlog_server.devices.cia406.nodes import LOST_NS, SEEK_NS, SETTLING_NS, Nodes
from rtlog_server.devices.cia406.protocol import Frame, encode_heartbeat
from rtlog_server.devices.cia406.rounds import SyncRounds
from rtlog_server.devices.device import TickGrid

RANGE = 4096 * 4096
ENCODERS = [
    Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=6, wheel_radius_m=0.35),
]
SETTINGS = NodeSettings(2, 0, RANGE, "ok")
MS = 1_000_000

near = st.sampled_from([service + node for service in (0x80, 0x180, 0x280, 0x580, 0x700) for node in (5, 6, 7)])
frames = st.builds(Frame, near | st.integers(0, 0x7FF), st.binary(max_size=8))


def running_nodes() -> Nodes:
    nodes = Nodes(ENCODERS)
    nodes.rounds = SyncRounds(TickGrid(0, 100 * MS), 94_000, 0)
    for node in nodes:
        node.run(SETTINGS, 0)
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


def test_a_node_that_boots_is_brought_up_at_once() -> None:
    nodes = running_nodes()
    _, right = nodes
    assert nodes.due(1) is None
    nodes.take(encode_heartbeat(6, protocol.BOOT_UP), 1)
    assert nodes.due(1) is right
    right.begin()
    right.run(SETTINGS, 2)
    assert nodes.due(2) is None
    assert nodes.tally["restarts"] == 1


@pytest.mark.parametrize("state", [protocol.STOPPED, protocol.PRE_OPERATIONAL])
def test_a_node_that_does_not_stay_operational_is_brought_up_again(state: int) -> None:
    nodes = running_nodes()
    left, _ = nodes
    nodes.take(encode_heartbeat(6, protocol.OPERATIONAL), SETTLING_NS)
    nodes.take(encode_heartbeat(5, state), SETTLING_NS)  # sent before the start command came
    assert nodes.due(SETTLING_NS) is None
    nodes.take(encode_heartbeat(5, state), SETTLING_NS + 1)
    assert nodes.due(SETTLING_NS + 1) is left

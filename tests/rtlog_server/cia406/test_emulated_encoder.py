"""The emulated encoder judged by canopen's master, which is nobody's here: objects, PDOs, network management."""

import time
import uuid
from collections.abc import Iterator
from functools import partial

import can
import canopen
import pytest
from patience import PATIENCE_S, wait_until

from hw_profiles.profile import CanBus
from rtlog_server.devices.cia406.emulator import CanBusEmulator

COUNTS = 4096
POSITION = 123_456


@pytest.fixture
def bus() -> CanBus:
    return CanBus(interface="virtual", channel=uuid.uuid4().hex)


@pytest.fixture
def emulator(bus: CanBus) -> Iterator[CanBusEmulator]:
    with CanBusEmulator(bus, {5: COUNTS}, lambda _node, _at_ns: POSITION) as emulator:
        yield emulator


@pytest.fixture
def node(bus: CanBus, emulator: CanBusEmulator) -> Iterator[canopen.RemoteNode]:
    """The emulator's node, as canopen's master sees it."""
    with canopen.Network() as network:
        network.NOTIFIER_CYCLE = 0.02  # which is how long it takes to disconnect
        network.connect(interface="virtual", channel=bus.channel)
        remote = canopen.RemoteNode(5, canopen.ObjectDictionary())
        remote.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        network.add_node(remote)
        yield remote


@pytest.fixture
def states(node: canopen.RemoteNode) -> list[int]:
    """All that its heartbeats tell; 0 when it boots."""
    states: list[int] = []
    node.nmt.add_heartbeat_callback(states.append)
    return states


def read(node: canopen.RemoteNode, index: int, subindex: int = 0) -> int:
    return int.from_bytes(node.sdo.upload(index, subindex), "little")


def write(node: canopen.RemoteNode, index: int, subindex: int, number: int, size: int) -> None:
    node.sdo.download(index, subindex, number.to_bytes(size, "little"))


def test_it_is_a_multi_turn_encoder(node: canopen.RemoteNode) -> None:
    assert read(node, 0x1000) == 0x0002_0196
    assert read(node, 0x1018, 4) == 83_005
    assert node.sdo.upload(0x1008, 0) == b"Emulated multi-turn encoder"  # in segments
    assert read(node, 0x6004) == POSITION


@pytest.mark.parametrize(
    ("index", "subindex", "data", "code"),
    [
        (0x2000, 0, None, 0x0602_0000),  # no such object
        (0x1018, 9, None, 0x0609_0011),  # no such sub-index
        (0x6004, 0, bytes(4), 0x0601_0002),  # read only
        (0x6001, 0, bytes(2), 0x0607_0010),  # wrong length
        (0x6001, 0, bytes(4), 0x0609_0030),  # no turn has zero counts
        (0x1801, 1, b"\x99\x02\0\0", 0x0609_0030),  # another identifier while the PDO is on
        (0x1A01, 0, b"\0", 0x0800_0022),  # another mapping while the PDO is on
    ],
)
def test_what_it_lacks_or_refuses_is_aborted_with_the_standards_code(
    index: int, subindex: int, data: bytes | None, code: int, node: canopen.RemoteNode
) -> None:
    transfer = node.sdo.upload if data is None else partial(node.sdo.download, data=data)
    with pytest.raises(canopen.SdoAbortedError) as refused:
        transfer(index, subindex)
    assert refused.value.code == code


def test_heartbeats_tell_the_state_it_was_commanded_into(node: canopen.RemoteNode, states: list[int]) -> None:
    write(node, 0x1017, 0, 20, 2)
    wait_until(lambda: states[-1:] == [127])
    for state, number in (("OPERATIONAL", 5), ("STOPPED", 4), ("PRE-OPERATIONAL", 127)):
        node.nmt.state = state
        wait_until(lambda: states[-1] == number)  # noqa: B023


def test_a_reset_boots_it_with_the_makers_objects(node: canopen.RemoteNode, states: list[int]) -> None:
    write(node, 0x6001, 0, 1000, 4)
    assert read(node, 0x6004) == POSITION * 1000 // COUNTS
    booted = states.count(0)
    node.nmt.state = "RESET COMMUNICATION"
    wait_until(lambda: states.count(0) == booted + 1)
    assert read(node, 0x6001) == 1000
    node.nmt.state = "RESET"
    wait_until(lambda: states.count(0) == booted + 2)
    assert read(node, 0x6001) == COUNTS


def test_positions_come_at_sync_and_by_timer_when_it_is_operational(bus: CanBus, node: canopen.RemoteNode) -> None:
    with can.Bus(interface="virtual", channel=bus.channel) as listener:

        def next_pdo(timeout_s: float) -> can.Message | None:
            deadline = time.monotonic() + timeout_s
            while time.monotonic() < deadline:
                message = listener.recv(0.05)
                if message is not None and message.arbitration_id in (0x185, 0x285):
                    return message
            return None

        node.network.sync.transmit()
        assert next_pdo(0.1) is None  # pre-operational
        node.nmt.state = "OPERATIONAL"
        node.network.sync.transmit()
        message = next_pdo(PATIENCE_S)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x285, POSITION.to_bytes(4, "little"))
        write(node, 0x1800, 5, 10, 2)
        for _ in range(11):
            message = next_pdo(PATIENCE_S)
            assert message is not None
            assert message.arbitration_id == 0x185


def test_an_emergency_reaches_the_master(emulator: CanBusEmulator, node: canopen.RemoteNode) -> None:
    emulator.emergency(5, 0x5000, register=0x01, vendor=b"\x07")
    wait_until(lambda: node.emcy.log)
    error = node.emcy.log[-1]
    assert (error.code, error.register, error.data) == (0x5000, 0x01, b"\x07\0\0\0\0")

"""What a hostile CAN bus may bring to the encoders' driver, with coverage as its guide (atheris).

    python fuzz_cia406.py WAY RUNS CORPUS      way: frames, answers, slcan; corpus: a folder to fill

The law under test: frames raise nothing and give no position beyond the encoder's range; answers to the configuration
raise nothing but CanOpenError, and whatever they are, it comes to an end; an slcan adapter's bytes raise nothing, and
none of them is kept for long.
"""

import sys
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import atheris
from fuzzing import fuzz

with atheris.instrument_imports(include=["rtlog_server.devices.cia406", "canopen.sdo", "can.interfaces.slcan"]):
    from hw_profiles.profile import CanBus, Encoder
    from rtlog_server.devices.cia406.configuration import NodeSettings, configure, identify
    from rtlog_server.devices.cia406.emulated_encoder import EmulatedEncoder
    from rtlog_server.devices.cia406.nodes import Nodes
    from rtlog_server.devices.cia406.port import CanPort
    from rtlog_server.devices.cia406.protocol import CanOpenError, Frame
    from rtlog_server.devices.cia406.rounds import SyncRounds, TimerRounds
    from rtlog_server.devices.cia406.sdo import NodeObjects
    from rtlog_server.devices.cia406.slcan_adapter import SlcanAdapter
    from rtlog_server.devices.device import TickGrid
    from rtlog_server.devices.encoders import ReadingMaker

RANGE = 4096 * 4096
MS = 1_000_000
GRID = TickGrid(0, 100 * MS)
ENCODERS = [
    Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35),
    Encoder(name="steering", role="steering", address=6),
]
BUSES = [CanBus(channel="can0"), CanBus(channel="can0", trigger="timer"), CanBus(channel="can0", vendor_id=0x2F1)]
MOST_REQUESTS = 300  # of a configuration
LONGEST_INPUT = {"frames": 64, "answers": 180, "slcan": 48}
LONGEST_LINE = 8192


def try_frames(data: bytes) -> None:
    """Frames of 1 + 2 + length bytes: time that passes, identifier and length, data."""
    nodes = Nodes(ENCODERS)
    maker = ReadingMaker(ENCODERS, {encoder.name: RANGE for encoder in ENCODERS})
    timer = bool(data) and data[0] & 1
    nodes.rounds = rounds = TimerRounds(GRID, 0, 10 * MS) if timer else SyncRounds(GRID, 0, 0)
    for node in nodes:
        node.run(NodeSettings(1 if timer else 2, 8 * (data[0] >> 1 & 3) if data else 0, RANGE, "ok"), 0)
        rounds.join(node.name)
    now_ns, at = 1, 1
    while at + 3 <= len(data):
        now_ns += data[at] * MS
        head = int.from_bytes(data[at + 1 : at + 3], "little")
        end = at + 3 + (head >> 11) % 9
        fixes = nodes.take(Frame(head & 0x7FF, data[at + 3 : end]), now_ns)
        if rounds.next_ns(now_ns) <= now_ns and fixes is None:
            fixes = rounds.step(now_ns)
            if fixes is None:
                rounds.sent(now_ns)
        if fixes:
            nodes.finish_round(fixes)
            assert all(0 <= fix.raw < RANGE for fix in fixes.values())
            reading = maker.reading(fixes)
            assert reading.measured_ns <= reading.complete_ns <= now_ns
        node = nodes.due(now_ns)
        assert node is None or node.booted or not node.running
        assert "\n" not in nodes.problems() + nodes.last_garbled + "".join(node.health for node in nodes)
        at = end


def try_answers(data: bytes) -> None:
    """Answers of 9 bytes: whether the emulated encoder's own is given in its place, the answer."""
    encoder = EmulatedEncoder(5, 4096, lambda _at_ns: 77)
    spoilt = iter([data[at : at + 9] for at in range(1, len(data) - 8, 9)])
    own: list[bytes] = []
    requests = 0

    def send(frame: Frame) -> None:
        nonlocal requests
        requests += 1
        own[:] = [answer.data for answer in encoder.take(frame, 0)]

    def await_reply(_node: int, _deadline_ns: int) -> bytes | None:
        answer = next(spoilt, None)
        if answer is not None and answer[0] & 1:
            return answer[1:]
        return own[0] if own else None

    objects = NodeObjects(5, send, await_reply)
    bus = BUSES[data[0] % len(BUSES)] if data else BUSES[0]
    with suppress(CanOpenError):
        assert "\n" not in identify(objects, 5, bus)
        settings = configure(objects, 5, ENCODERS[0], bus)
        assert settings.total_range > 0
        assert settings.total_range % 4096 == 0
    assert requests <= MOST_REQUESTS


class SlcanLine:
    """The host's port and an adapter's terminal."""

    def __init__(self, folder: Path) -> None:
        self.adapter = SlcanAdapter(folder / "slcan")
        self.port = CanPort(CanBus(interface="slcan", channel=str(folder / "slcan")))

    def try_bytes(self, data: bytes) -> None:
        self.adapter.write(data)
        for _ in range(len(data) + 2):
            received = self.port.receive(0.0)
            assert received is None or (0 <= received[0].can_id < 1 << 11 and len(received[0].data) <= 8)
        assert len(self.port._bus._buffer) <= LONGEST_LINE


SAMPLES = {
    "frames": [
        b"\0\x05\x85\x22\x01\0\0\0\x01\x86\x22\x02\0\0\0\x60\x05\x0f\x05\x05\x0f\0",
        b"\x01\x08\x85\x21\1\0\0\0",
    ],
    "answers": [b"\0" + b"\1\x43\x00\x10\x00\x96\x01\x02\x00" * 3, b"\1" + b"\1\x80\x00\x10\x00\0\0\2\6" * 4],
    "slcan": [b"t28540001AABB\rt7051\r", b"T0000028540001AABB\rr7050\r\x07Z\r\xff\r"],
}


def main(way: str, folder: Path) -> None:
    line = SlcanLine(folder) if way == "slcan" else None
    try_one = {"frames": try_frames, "answers": try_answers}.get(way) or line.try_bytes
    fuzz(try_one, SAMPLES[way], LONGEST_INPUT[way])


if __name__ == "__main__":
    with TemporaryDirectory() as name:
        main(sys.argv[1], Path(name))

"""Plays a fault script on the wires of a stage, each fault at its time; notes when it really was.

In: a `FaultScript`, wires, the start of the drive. Out: `PlayedFault`s. A fault that is under way when the drive is
over ends with it.
"""

import threading
import time

from rtlog_client.faults import Fault, FaultScript
from rtlog_client.replay_report import PlayedFault
from rtlog_client.stage import Line
from rtlog_client.tcp_wire import TcpWire


class FaultPlayer:
    """A thread from construction to `close`.

    Args:
        lines: by device; one for each device of the script.
        start_ns: of the drive (monotonic).
        utc_offset_ns: UTC minus monotonic clock.
    """

    def __init__(self, script: FaultScript, lines: dict[str, Line], start_ns: int, utc_offset_ns: int) -> None:
        self.played: list[PlayedFault] = []
        self._lines = lines
        self._utc_offset_ns = utc_offset_ns
        moments = [(fault.at_s, 1, index, fault) for index, fault in enumerate(script.fault)]
        moments += [(fault.at_s + fault.for_s, 0, index, fault) for index, fault in enumerate(script.fault)]
        self._moments = [(start_ns + round(at_s * 1e9), fault) for at_s, _, _, fault in sorted(moments, key=_order)]
        self._under_way: dict[int, int] = {}  # id of a fault: since when
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="faults", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End what is under way."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        for at_ns, fault in self._moments:
            if self._stopping.wait(max(0.0, (at_ns - time.monotonic_ns()) * 1e-9)):
                break
            (self._end if id(fault) in self._under_way else self._begin)(fault)
        for _, fault in self._moments:
            if id(fault) in self._under_way:
                self._end(fault)

    def _begin(self, fault: Fault) -> None:
        self._under_way[id(fault)] = time.monotonic_ns()
        wires = [self._lines[device].wire for device in fault.devices]
        for wire in wires:
            wire.begin(fault)
        match wires:
            case [TcpWire() as one, TcpWire() as other]:
                one.cross(other)
                other.cross(one)

    def _end(self, fault: Fault) -> None:
        lines = [self._lines[device] for device in fault.devices]
        if fault.kind == "restart":
            lines[0].power_cycle()
        for line in lines:
            line.wire.end()
        from_ns, to_ns = self._under_way.pop(id(fault)), time.monotonic_ns()
        offset_ns = self._utc_offset_ns
        self.played.append(PlayedFault(fault.device, fault.kind, from_ns + offset_ns, to_ns + offset_ns, fault.other))


def _order(moment: tuple[float, int, int, Fault]) -> tuple[float, int, int]:
    return moment[:3]

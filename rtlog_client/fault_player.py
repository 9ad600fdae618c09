"""Plays a fault script on the wires of a stage, each fault at its time; notes when it really was.

In: a `FaultScript`, wires, the start of the drive. Out: `PlayedFault`s. A fault that is under way when the drive is
over ends with it. A wire that cannot do what it is told ends the play; `close` says so.
"""

import threading
import time

from hw_profiles.errors import BadInputError, RTLogError
from rtlog_client.faults import Fault, FaultScript
from rtlog_client.replay_report import PlayedFault
from rtlog_client.stage import Line
from rtlog_client.tcp_wire import TcpWire
from rtlog_server.devices.device import DeviceError


class FaultPlayer:
    """A thread from construction to `close`.

    Args:
        lines: by device; one for each device of the script.
        start_ns: of the drive (monotonic).
        utc_offset_ns: UTC minus monotonic clock.

    Raises:
        BadInputError: a swap of devices that are not both on TCP.
    """

    def __init__(self, script: FaultScript, lines: dict[str, Line], start_ns: int, utc_offset_ns: int) -> None:
        self.played: list[PlayedFault] = []
        self._lines = lines
        self._utc_offset_ns = utc_offset_ns
        moments = [(fault.at_s, 1, index, fault) for index, fault in enumerate(script.fault)]
        moments += [(fault.at_s + fault.for_s, 0, index, fault) for index, fault in enumerate(script.fault)]
        self._moments = [(start_ns + round(at_s * 1e9), fault) for at_s, _, _, fault in sorted(moments, key=_order)]
        self._under_way: dict[int, int] = {}  # id of a fault: since when
        self._failure = ""
        self._stopping = threading.Event()
        for fault in script.fault:
            if fault.kind == "swap" and not all(isinstance(lines[device].wire, TcpWire) for device in fault.devices):
                raise BadInputError(f"faults: swap of {' with '.join(fault.devices)}: only devices on TCP are swapped")
        self._thread = threading.Thread(target=self._run, name="faults", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End what is under way. Raises: RTLogError: a fault could not be played."""
        self._stopping.set()
        self._thread.join()
        if self._failure:
            raise RTLogError(self._failure)

    def _run(self) -> None:
        for at_ns, fault in self._moments:
            stopping = self._stopping.wait(max(0.0, (at_ns - time.monotonic_ns()) * 1e-9))
            under_way = id(fault) in self._under_way
            if stopping and not under_way:
                continue
            try:
                (self._end if under_way else self._begin)(fault)
            except (OSError, DeviceError) as error:
                self._failure = f"{fault.kind} of {fault.device}: {error}"
                return

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

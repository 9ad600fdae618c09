"""A wire of a serial port: a pseudo-terminal for the host, and behind it the one of the emulator.

The host's speed is passed on, as the emulator answers only at its own. A cut pulls the USB adapter: the terminal hangs
up and its name is gone. In a restart the adapter stays, and nothing passes.
"""

import os
import termios
import tty
from pathlib import Path

from rtlog_client.faults import Fault
from rtlog_client.wire import READ_BYTES, Flow, Wire
from rtlog_server.devices.pty_link import PtyLink

SPEEDS = slice(4, 6)  # of tcgetattr's list: input and output speed


class SerialWire(Wire):
    """Between `link`, the name under which hosts open the port, and the emulator's terminal `target`."""

    def __init__(self, name: str, link: Path, target: Path, seed: int = 0) -> None:
        super().__init__(name, seed)
        self._link = link
        self._target = target

    # In the thread

    def _open(self) -> None:
        self._device = os.open(self._target, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._device)
        self._host = PtyLink(self._link)
        self._connect()
        self._watch(self._device, self._receive_from_device)

    def _begin(self, fault: Fault) -> None:
        self.fault = fault
        if fault.kind == "cut":
            self._ignore(self._host.master)
            self._host.unplug()

    def _end(self) -> None:
        if self._pulled:
            self._host.plug()
            self._connect()
        self.fault = None

    def _connect(self) -> None:
        self._to_device = Flow(lambda data: os.write(self._device, data), False)
        self._to_host = Flow(self._host.write, True)
        self._watch(self._host.master, self._receive_from_host)

    @property
    def _pulled(self) -> bool:
        return self.fault is not None and self.fault.kind == "cut"

    @property
    def _dead(self) -> bool:
        return self.fault is not None and self.fault.kind in ("cut", "restart")

    def _receive_from_host(self) -> None:
        data = os.read(self._host.master, READ_BYTES)
        self._pass_speed()
        if not self._dead:
            self._to_device.put(data, self)

    def _receive_from_device(self) -> None:
        data = os.read(self._device, READ_BYTES)
        if not self._dead:
            self._to_host.put(data, self)

    def _pass_speed(self) -> None:
        wanted, present = [self._host.host_speed()] * 2, termios.tcgetattr(self._device)
        if present[SPEEDS] != wanted:
            present[SPEEDS] = wanted
            termios.tcsetattr(self._device, termios.TCSANOW, present)

    def _flush(self) -> float | None:
        if self._pulled:
            return None
        waits_s = [self._to_device.flush(), self._to_host.flush()]
        return min((wait_s for wait_s in waits_s if wait_s is not None), default=None)

    def _shut(self) -> None:
        if not self._pulled:
            self._ignore(self._host.master)
            self._host.unplug()
        os.close(self._device)

"""A wire of a serial port: a pseudo-terminal for the host, and behind it the one of the emulator.

The host's speed is passed on, as the emulator answers only at its own. A cut pulls the USB adapter: the terminal hangs
up and its name is gone. In a restart the adapter stays, and nothing passes.
"""

import contextlib
import os
import termios
import tty
from pathlib import Path

from rtlog_client.faults import Fault
from rtlog_client.wire import READ_BYTES, Flow, Wire

SPEEDS = slice(4, 6)  # of tcgetattr's list: input and output speed


class SerialWire(Wire):
    """Between `link`, the name under which hosts open the port, and the emulator's terminal `target`."""

    def __init__(self, name: str, link: Path, target: Path, seed: int = 0) -> None:
        super().__init__(name, seed)
        self._link = link
        self._target = target

    # In the thread

    def _open(self) -> None:
        if self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"{self._link} is in the way and no symbolic link")
        self._device = os.open(self._target, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._device)
        self._plug_in()
        self._watch(self._device, self._receive_from_device)

    def _begin(self, fault: Fault) -> None:
        self.fault = fault
        if fault.kind == "cut":
            self._pull()

    def _end(self) -> None:
        if self._pulled:
            self._plug_in()
        self.fault = None

    def _plug_in(self) -> None:
        self._host, self._port = os.openpty()  # the port stays open: without any, the host's end reads EIO
        tty.setraw(self._port)
        os.set_blocking(self._host, False)
        self._terminal = os.ttyname(self._port)
        beside = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        beside.unlink(missing_ok=True)
        beside.symlink_to(self._terminal)
        beside.replace(self._link)
        self._to_device = Flow(lambda data: os.write(self._device, data), False)
        self._to_host = Flow(self._write_to_host, True)
        self._watch(self._host, self._receive_from_host)

    def _pull(self) -> None:
        self._ignore(self._host)
        if self._link.is_symlink() and str(self._link.readlink()) == self._terminal:
            self._link.unlink()
        os.close(self._port)
        os.close(self._host)

    @property
    def _pulled(self) -> bool:
        return self.fault is not None and self.fault.kind == "cut"

    @property
    def _dead(self) -> bool:
        return self.fault is not None and self.fault.kind in ("cut", "restart")

    def _receive_from_host(self) -> None:
        data = os.read(self._host, READ_BYTES)
        self._pass_speed()
        if not self._dead:
            self._to_device.put(data, self)

    def _receive_from_device(self) -> None:
        data = os.read(self._device, READ_BYTES)
        if not self._dead:
            self._to_host.put(data, self)

    def _pass_speed(self) -> None:
        wanted, present = termios.tcgetattr(self._host), termios.tcgetattr(self._device)
        if present[SPEEDS] != wanted[SPEEDS]:
            present[SPEEDS] = wanted[SPEEDS]
            termios.tcsetattr(self._device, termios.TCSANOW, present)

    def _write_to_host(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # nobody reads: a wire does not wait
            os.write(self._host, data)

    def _flush(self) -> float | None:
        if self._pulled:
            return None
        waits_s = [self._to_device.flush(), self._to_host.flush()]
        return min((wait_s for wait_s in waits_s if wait_s is not None), default=None)

    def _shut(self) -> None:
        if not self._pulled:
            self._pull()
        os.close(self._device)

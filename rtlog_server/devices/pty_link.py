"""A pseudo-terminal behind a stable name: where an emulated device stands in for one behind a USB serial adapter.

    /dev/serial/by-id/…  ~  link ──> /dev/pts/7     pulled: the terminal hangs up, its name is gone
                                └──> /dev/pts/9     back: another terminal under the same name

In: the name. Out: the master's end of the terminal. Used by emulators and by the wires before them.
"""

import contextlib
import os
import termios
import tty
from pathlib import Path


class PtyLink:
    """Plugged in from construction to `unplug`. The link is never put over anything but a symbolic link.

    Raises: OSError: the link cannot be made.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        self._ends: tuple[int, int] | None = None
        self.plug()

    @property
    def master(self) -> int:
        """The file descriptor of the device's end. Raises: OSError: it is not plugged in."""
        if self._ends is None:
            raise OSError(f"{self._link} is unplugged")
        return self._ends[0]

    def plug(self) -> None:
        """Open a new terminal, at 9600 baud, and give it the name."""
        if self._ends is not None:
            return
        if self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"{self._link} is in the way and no symbolic link")
        master, slave = os.openpty()  # the slave's end stays open: without any, the master reads EIO
        tty.setraw(slave)
        attributes = termios.tcgetattr(slave)
        attributes[4] = attributes[5] = termios.B9600
        termios.tcsetattr(slave, termios.TCSANOW, attributes)
        os.set_blocking(master, False)
        self._terminal = os.ttyname(slave)
        beside = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        beside.unlink(missing_ok=True)
        beside.symlink_to(self._terminal)
        beside.replace(self._link)
        self._ends = master, slave

    def unplug(self) -> None:
        """Close the terminal and take its name away; nobody may use `master` meanwhile."""
        if self._ends is None:
            return
        if self._link.is_symlink() and str(self._link.readlink()) == self._terminal:
            self._link.unlink()
        for end in reversed(self._ends):
            os.close(end)
        self._ends = None

    def host_speed(self) -> int:
        """The termios speed that the host has set: a pseudo-terminal has no baud rate, but remembers it."""
        return int(termios.tcgetattr(self.master)[5])

    def write(self, data: bytes) -> None:
        """Send to the host, as a wire does: what nobody reads is lost."""
        with contextlib.suppress(BlockingIOError):
            os.write(self.master, data)

    def flush(self) -> None:
        """Forget what the host sent: a device that was off heard nothing of it."""
        termios.tcflush(self.master, termios.TCIOFLUSH)

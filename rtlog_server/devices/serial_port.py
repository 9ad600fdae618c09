"""Opening a serial port: every reason why that can fail comes out as one DeviceError in one line.

In: a device file, best a stable name under /dev/serial/by-id. Out: an open port in raw 8N1, ours alone.
"""

import contextlib
import errno
import os
import termios

import serial

from rtlog_server.devices.device import DeviceError

LOST = (OSError, termios.error)  # what a port raises when its adapter was pulled; pyserial's own error is an OSError
WRITE_TIMEOUT_S = 1.0


def open_serial_port(port: str, baud: int, read_timeout_s: float) -> serial.Serial:
    """Open `port` for this process alone. Raises: DeviceError: it is absent, taken, forbidden or no serial port."""
    try:
        # exclusive: two readers of one port steal each other's bytes
        opened = serial.Serial(port, baud, timeout=read_timeout_s, write_timeout=WRITE_TIMEOUT_S, exclusive=True)
    except OSError as error:
        taken = error.errno in (errno.EAGAIN, errno.EBUSY)
        reason = "another process has it" if taken else os.strerror(error.errno or errno.EIO)
        raise DeviceError(f"{port}: cannot open the port: {reason}") from error
    except termios.error as error:
        raise DeviceError(f"{port}: is no serial port: {error.args[-1]}") from error
    # USB adapters collect bytes for 16 ms unless told otherwise; other ports have no such switch.
    with contextlib.suppress(ValueError, *LOST):
        opened.set_low_latency_mode(True)
    return opened

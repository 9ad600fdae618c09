"""The driver of a SICK LMS111 over TCP, CoLa A or B.

    connect   TCP → which dialect? → log in → configuration, written only where it differs → start → measuring? → stream
    read      telegrams → LMDscandata → Scan → tick thread; half a second without a scan ends the connection

In: the scanner's bytes. Out: every scan once, in metres, the scanner's frame and host time. The law: one command is
under way at a time, and each has a time limit; what a connection knew (framing, clock, registration) dies with it.
Nothing is written to the device's EEPROM: a device that lost its power gets its configuration again.
"""

import socket
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hw_profiles.profile import LaserDevice
from rtlog_server.clock import DeviceClock
from rtlog_server.devices.device import Device, DeviceError
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.lms111.cola import ColaError, Dialect, Receiver
from rtlog_server.devices.lms111.protocol import (
    AUTHORISED_CLIENT,
    ERRORS,
    MEASURING,
    STATES,
    Command,
    decode,
    encode_command,
    reply_name,
)
from rtlog_server.devices.lms111.scan_data import ScanData
from rtlog_server.devices.lms111.sweep import FIELD_START_1E4DEG, FIELD_STOP_1E4DEG, STATUS, period_us, to_scan

CONNECT_S = 0.5  # on one cable; a longer wait would miss a device that comes back
PROBE_S = 0.25
ANSWER_S = 0.5  # the captured device answers within 5 ms, and within 15 ms when it starts to measure
MOTOR_ANSWER_S = 5.0  # commands that change how the motor turns
MEASURING_S = 60.0  # motor and, in the cold, heater
POLL_S = 0.2
SILENCE_S = 0.5  # 25 scans at 50 Hz; only this finds a cable that was pulled
STALE_S = 0.25
LONGEST_WAIT_S = 0.5  # to notice that the driver is closed
RECEIVE_BYTES = 65536

RESOLUTION_1E4DEG = {25: 2500, 50: 5000}  # by scan frequency
TOLERANCE_1E4DEG = 10  # devices give back angles that a driver before us wrote rounded, as -449997
CONTENT = (1, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0, 1)  # first echo, its remission in 16 bit, nothing else, every scan


class Lms111(Device[Scan]):
    """A scanner of this profile: `host`, `port`, `scan_frequency_hz`."""

    def __init__(self, name: str, settings: LaserDevice) -> None:
        super().__init__(name, stale_after_s=STALE_S)
        self._address = settings.host, settings.port
        self._frequency_hz = settings.scan_frequency_hz
        self._where = f"LMS111 at {settings.host}:{settings.port}"
        self._dialect = Dialect.B
        self._socket: socket.socket | None = None
        self._receiver = Receiver(self._dialect)
        self._pending: deque[tuple[bytes, int]] = deque()  # payload, time of reception
        self._clock = DeviceClock()
        self._newest: ScanData | None = None
        self._scan_due_ns = 0
        self._scans = self._lost = self._repeated = self._bad = 0

    def connect(self) -> None:
        """Open, configure and start the scanner; the first scan comes with read(). Raises: DeviceError, OSError."""
        with self._located():
            self._find_dialect()
            self._configure()
            self._start()
        self._newest = None
        self._clock = DeviceClock()  # the device may have been off, and its count with it
        self._scan_due_ns = time.monotonic_ns() + int(SILENCE_S * 1e9)

    def read(self) -> None:
        """Hand over the scan that comes next. Raises: DeviceError, also after half a second without one."""
        with self._located():
            received = self._next(self._scan_due_ns)
        if received is not None:
            self._read_telegram(*received)
        if time.monotonic_ns() > self._scan_due_ns:
            raise DeviceError(f"{self._where}: no scan for {SILENCE_S} s")

    def disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _read_telegram(self, payload: bytes, receive_ns: int) -> None:
        try:
            telegram = decode(self._dialect, payload)
            if isinstance(telegram, ScanData):
                self._take(telegram, receive_ns)
        except ColaError as error:
            self._bad += 1
            self.diagnostics["last bad telegram"] = str(error)

    def _take(self, scan: ScanData, receive_ns: int) -> None:
        """One scan of the stream: new, or sent before?"""
        before = self._newest
        if before is not None:
            ahead = (scan.telegram_counter - before.telegram_counter) % 65536
            if ahead == 0:
                self._repeated += 1
                return
            self._lost += ahead - 1 if ahead < 32768 else 0  # behind: the device started to count anew
        turn_us = period_us(scan, before)
        self._newest = scan
        self.hand_over(to_scan(scan, self._clock.update(scan.time_of_transmission_us, receive_ns), turn_us))
        self._scans += 1
        self._scan_due_ns = time.monotonic_ns() + int(SILENCE_S * 1e9)
        self._report(scan, turn_us)

    def _report(self, scan: ScanData, turn_us: float) -> None:
        status = scan.device_status[1]
        trouble = STATUS.get(status, f"device status {status}")
        self.message = trouble or "connected"
        self.identity["serial_number"] = str(scan.serial_no)
        self.diagnostics |= {
            "status": trouble or "ok",
            "scan frequency [Hz]": f"{1e6 / turn_us:.2f}",
            "scans": str(self._scans),
            "scans lost": str(self._lost),
            "scans repeated": str(self._repeated),
            "bad telegrams": str(self._bad),
            "garbage [bytes]": str(self._receiver.skipped_bytes),
        }

    # Connecting

    def _find_dialect(self) -> None:
        """Open a connection on which the device answers; a dialect that it does not speak meets silence."""
        for dialect in (self._dialect, self._dialect.other):
            self.disconnect()
            self._socket = socket.create_connection(self._address, CONNECT_S)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._dialect = dialect
            self._receiver = Receiver(dialect)
            self._pending.clear()
            try:
                self._ask("sRN SCdevicestate", limit_s=PROBE_S)
            except TimeoutError:
                continue
            self.diagnostics["dialect"] = dialect.value
            return
        raise DeviceError(f"{self._where} takes connections but answers neither in CoLa A nor in CoLa B")

    def _configure(self) -> None:
        (granted,) = self._ask("sMN SetAccessMode", *AUTHORISED_CLIENT)
        if granted != 1:
            raise DeviceError(f"{self._where} refuses the login; another client may be configuring it")
        firmware = self._ask("sRN FirmwareVersion")[0].strip()
        self.identity = {"model": "LMS111", "firmware": firmware}
        frequency_centihz, resolution = 100 * self._frequency_hz, RESOLUTION_1E4DEG[self._frequency_hz]
        sector = (1, resolution, FIELD_START_1E4DEG, FIELD_STOP_1E4DEG)
        present = self._ask("sRN LMPscancfg")
        if not _near(present[:3], (frequency_centihz, *sector[:2])):  # the sector in it is fixed
            code = self._ask("sMN mLMPsetscancfg", frequency_centihz, *sector, limit_s=MOTOR_ANSWER_S)[0]
            if code != 0:
                raise DeviceError(f"{self._where} refuses {self._frequency_hz} Hz (code {code})")
        if not _near(self._ask("sRN LMPoutputRange"), sector):
            self._ask("sWN LMPoutputRange", *sector)
        if self._ask("sRN LMDscandatacfg") != CONTENT:
            self._ask("sWN LMDscandatacfg", *CONTENT)

    def _start(self) -> None:
        self._ask("sMN LMCstartmeas", limit_s=MOTOR_ANSWER_S)  # whether it worked is told by the state
        deadline_ns = time.monotonic_ns() + int(MEASURING_S * 1e9)
        while (state := self._ask("sRN STlms")[0]) != MEASURING:
            self.message = f"{self._where} is {STATES.get(state, state)}"
            if self.pause(POLL_S) or time.monotonic_ns() > deadline_ns:
                raise DeviceError(f"{self.message} and does not come to measure")
        self._ask("sMN Run", limit_s=MOTOR_ANSWER_S)
        (streaming,) = self._ask("sEN LMDscandata", 1)
        if streaming != 1:
            raise DeviceError(f"{self._where} refuses to stream scans")

    def _ask(self, command: str, *values: int, limit_s: float = ANSWER_S) -> tuple[Any, ...]:
        """The values of the reply to a command; events that come in between are let pass.

        Raises:
            DeviceError: the device refuses the command.
            TimeoutError: it does not answer.
        """
        assert self._socket is not None
        self._socket.settimeout(limit_s)
        self._socket.sendall(encode_command(self._dialect, command, *values))
        deadline_ns = time.monotonic_ns() + int(limit_s * 1e9)
        while time.monotonic_ns() < deadline_ns and not self.pause(0):
            received = self._next(deadline_ns)
            telegram = decode(self._dialect, received[0]) if received else None
            if not isinstance(telegram, Command):
                continue
            if telegram.name == reply_name(command):
                return telegram.values
            if telegram.name == "sFA":
                code = telegram.values[0]
                raise DeviceError(f"{self._where} refuses {command}: {ERRORS.get(code, 'error')} (sFA {code})")
        raise TimeoutError(f"no answer to {command}")

    def _next(self, deadline_ns: int) -> tuple[bytes, int] | None:
        """The next payload and when it was received (monotonic ns); None: none yet, or none by the deadline."""
        assert self._socket is not None
        if not self._pending:
            wait_s = (deadline_ns - time.monotonic_ns()) * 1e-9
            self._socket.settimeout(min(max(wait_s, 1e-3), LONGEST_WAIT_S))
            try:
                data = self._socket.recv(RECEIVE_BYTES)
            except TimeoutError:
                return None
            receive_ns = time.monotonic_ns()
            if not data:
                raise ConnectionResetError("the device closed the connection")
            self._pending.extend((payload, receive_ns) for payload in self._receiver.feed(data))
        return self._pending.popleft() if self._pending else None

    @contextmanager
    def _located(self) -> Iterator[None]:
        """Say which device it was that failed."""
        try:
            yield
        except (ColaError, OSError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise DeviceError(f"{self._where}: {reason}") from error


def _near(present: tuple[Any, ...], wanted: tuple[int, ...]) -> bool:
    """The same, but for what a device rounds."""
    return all(abs(a - b) <= TOLERANCE_1E4DEG for a, b in zip(present, wanted, strict=True))

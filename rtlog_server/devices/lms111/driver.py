"""The driver of a SICK LMS111 over TCP, CoLa A or B.

    connect   TCP → which dialect? → log in → configuration, written only where it differs → start → measuring? → stream
    read      telegrams → LMDscandata → Scan → tick thread; half a second without a scan is asked about

In: the scanner's bytes. Out: every scan once, in metres, the scanner's frame and host time. The law: one command is
under way at a time, and each has a time limit; what a connection knew (framing, clock, registration) dies with it.
Nothing is written to the device's EEPROM: a device that lost its power gets its configuration again.

Silence. A scanner makes 12 scans in half a second at the least, so that without one something is wrong; only this
finds a cable that was pulled. But what is wrong? A scanner that answers, and measures, is registered for its scans
again and the connection is kept, for five seconds; one that is not measuring is started anew; one that does not answer
is gone.
"""

import time
from typing import Any

from hw_profiles.profile import LaserDevice
from rtlog_server.clock import DeviceClock
from rtlog_server.devices.device import Device, DeviceError
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.lms111.cola import ColaError, Dialect
from rtlog_server.devices.lms111.connection import PROBE_S, Connection, NoAnswerError, open_connection
from rtlog_server.devices.lms111.protocol import AUTHORISED_CLIENT, MEASURING, SCAN_CONFIGURATION_FAULTS, state_name
from rtlog_server.devices.lms111.scan_data import ScanData
from rtlog_server.devices.lms111.sweep import FIELD_START_1E4DEG, FIELD_STOP_1E4DEG, STATUS, period_us, to_scan

MOTOR_ANSWER_S = 5.0  # commands that change how the motor turns
MEASURING_S = 60.0  # motor and, in the cold, heater
POLL_S = 0.2
SILENCE_S = 0.5
QUIET_S = 5.0
STALE_S = 0.25

RESOLUTION_1E4DEG = {25: 2500, 50: 5000}  # by scan frequency
TOLERANCE_1E4DEG = 10  # devices give back angles that a driver before us wrote rounded, as -449997
ECHOES = {"first": 1, "last": 3}  # what is asked for: the first, or both, as a ray may have but one
LATE_TELEGRAMS = 16  # a counter that is behind by less is a scan sent again
MOST_LOST = 1024  # a counter that is ahead by more than a connection survives: the device counts anew


class Lms111(Device[Scan]):
    """A scanner of this profile."""

    def __init__(self, name: str, settings: LaserDevice) -> None:
        super().__init__(name, stale_after_s=STALE_S)
        self._settings = settings
        self._where = f"LMS111 at {settings.host}:{settings.port}"
        self._dialect = Dialect.B  # in which it answered last
        self._connection: Connection | None = None
        self._clock = DeviceClock()
        self._newest: ScanData | None = None
        self._scan_due_ns = self._quiet_since_ns = 0
        self._scans = self._lost = self._skipped = self._repeated = self._impossible = 0

    def connect(self) -> None:
        """Open, configure and start the scanner; the first scan comes with read(). Raises: DeviceError."""
        host, port = self._settings.host, self._settings.port
        self._connection = open_connection(host, port, self._dialect, stopped=lambda: self.pause(0))
        self._dialect = self._connection.dialect
        self.diagnostics["dialect"] = self._dialect.value
        self._configure(self._connection)
        self._start(self._connection)
        self._newest = None
        self._clock = DeviceClock()  # the device may have been off, and its count with it
        self._quiet_since_ns = time.monotonic_ns()
        self._scan_due_ns = self._quiet_since_ns + int(SILENCE_S * 1e9)

    def read(self) -> None:
        """Hand over the scan that comes next. Raises: DeviceError."""
        assert self._connection is not None
        event = self._connection.receive(self._scan_due_ns)
        if event is not None and isinstance(event[0], ScanData):
            self._take(event[0], event[1], self._connection)
        if time.monotonic_ns() > self._scan_due_ns:
            self._enquire(self._connection)

    def disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _take(self, scan: ScanData, receive_ns: int, connection: Connection) -> None:
        """One scan of the stream: new, or sent before?"""
        before = self._newest
        if before is not None and (before.telegram_counter - scan.telegram_counter) % 65536 < LATE_TELEGRAMS:
            self._repeated += 1
            return
        try:
            turn_us = period_us(scan, before)
            transmitted_ns = self._clock.update(scan.time_of_transmission_us, receive_ns)
            self.hand_over(to_scan(scan, transmitted_ns, turn_us, self._settings.echo))
        except ColaError as error:
            self._impossible += 1
            self.diagnostics["last bad telegram"] = str(error)
            return
        if before is not None:
            sent = (scan.telegram_counter - before.telegram_counter) % 65536
            made = (scan.scan_counter - before.scan_counter) % 65536
            if max(sent, made) <= MOST_LOST:
                self._lost += sent - 1
                self._skipped += max(0, made - sent)
        self._newest = scan
        self._scans += 1
        self._quiet_since_ns = time.monotonic_ns()
        self._scan_due_ns = self._quiet_since_ns + int(SILENCE_S * 1e9)
        self._report(scan, turn_us, connection)

    def _report(self, scan: ScanData, turn_us: float, connection: Connection) -> None:
        settling, status = scan.device_status
        trouble = STATUS.get(status, f"device status {status}")
        self.message = trouble or "connected"
        self.identity["serial_number"] = str(scan.serial_no)
        self.diagnostics |= {
            "status": trouble or ("settling" if settling else "ok"),
            "scan frequency [Hz]": f"{1e6 / turn_us:.2f}",
            "scans": str(self._scans),
            "scans lost": str(self._lost),
            "scans skipped by the device": str(self._skipped),
            "scans repeated": str(self._repeated),
            "bad telegrams": str(self._impossible + connection.bad_telegrams),
            "garbage [bytes]": str(connection.skipped_bytes),
        }
        if connection.last_bad:
            self.diagnostics["last bad telegram"] = connection.last_bad

    def _enquire(self, connection: Connection) -> None:
        """No scan for half a second: why? Raises: DeviceError: the scanner is gone, or has to be started."""
        silent = f"{self._where}: no scan for {SILENCE_S} s"
        try:
            state, _ = connection.ask("sRN STlms", limit_s=PROBE_S)
        except NoAnswerError as error:
            raise DeviceError(f"{silent}, and no answer") from error
        if state != MEASURING:
            raise DeviceError(f"{silent}: it is {state_name(state)}")
        now_ns = time.monotonic_ns()
        if now_ns - self._quiet_since_ns > QUIET_S * 1e9:
            raise DeviceError(f"{self._where} measures but has sent no scan for {QUIET_S} s")
        self.message = f"{silent}, though it measures"
        connection.ask("sEN LMDscandata", 1)
        self._scan_due_ns = now_ns + int(SILENCE_S * 1e9)

    # Connecting

    def _configure(self, connection: Connection) -> None:
        ask, wanted = connection.ask, self._settings
        (granted,) = ask("sMN SetAccessMode", *AUTHORISED_CLIENT)
        if granted != 1:
            raise DeviceError(f"{self._where} refuses the login; another client may be configuring it")
        self.identity = {"model": "LMS111", "firmware": ask("sRN FirmwareVersion")[0].strip()}
        frequency_centihz, resolution = 100 * wanted.scan_frequency_hz, RESOLUTION_1E4DEG[wanted.scan_frequency_hz]
        sector = (1, resolution, FIELD_START_1E4DEG, FIELD_STOP_1E4DEG)
        present = ask("sRN LMPscancfg")
        if not _near(present[:3], (frequency_centihz, *sector[:2])):  # the sector in it is fixed
            code = ask("sMN mLMPsetscancfg", frequency_centihz, *sector, limit_s=MOTOR_ANSWER_S)[0]
            if code != 0:
                fault = SCAN_CONFIGURATION_FAULTS.get(code, "unknown")
                raise DeviceError(f"{self._where} refuses {wanted.scan_frequency_hz} Hz: {fault} (code {code})")
        if not _near(ask("sRN LMPoutputRange"), sector):
            ask("sWN LMPoutputRange", *sector)
        # echoes, remission and its width; of encoder, position, name, comment and time nothing; every scan
        content = (ECHOES[wanted.echo], 0, 1, int(wanted.remission_bits == 16), 0, 0, 0, 0, 0, 0, 0, 1)
        if ask("sRN LMDscandatacfg") != content:
            ask("sWN LMDscandatacfg", *content)

    def _start(self, connection: Connection) -> None:
        ask = connection.ask
        ask("sMN LMCstartmeas", limit_s=MOTOR_ANSWER_S)  # whether it worked is told by the state
        deadline_ns = time.monotonic_ns() + int(MEASURING_S * 1e9)
        while (state := ask("sRN STlms"))[0] != MEASURING:
            self.message = f"{self._where} is {state_name(state[0])}"
            if self.pause(POLL_S) or time.monotonic_ns() > deadline_ns:
                raise DeviceError(f"{self.message} and does not come to measure")
        self.diagnostics["temperature"] = "outside of its range" if state[1] else "ok"
        ask("sMN Run", limit_s=MOTOR_ANSWER_S)
        (streaming,) = ask("sEN LMDscandata", 1)
        if streaming != 1:
            raise DeviceError(f"{self._where} refuses to stream scans")


def _near(present: tuple[Any, ...], wanted: tuple[int, ...]) -> bool:
    """The same, but for what a device rounds."""
    return all(abs(a - b) <= TOLERANCE_1E4DEG for a, b in zip(present, wanted, strict=True))

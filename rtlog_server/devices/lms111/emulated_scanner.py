"""What an LMS111 knows and does: commands → replies, sweeps → LMDscandata. No I/O, no clock of its own.

In: commands, and sweeps in the scanner's frame and host time, as a LaserScan has them. Out: replies and `ScanData`, as
the device would send them; all times are given by the caller (monotonic ns). The law: without power it forgets its
configuration, its counters and its clock; without a login it changes nothing; only measuring it has scans.
"""

import math
import time
from typing import Any

from rtlog_server.clock import WRAP_US
from rtlog_server.devices.lms111.emulated_sweep import Sweep, echo_channels
from rtlog_server.devices.lms111.protocol import (
    ACCESS_DENIED,
    AUTHORISED_CLIENT,
    DEVICE_ERROR,
    IDLE,
    IN_PREPARATION,
    INITIALISING,
    MEASURING,
    UNKNOWN_METHOD,
    UNKNOWN_VARIABLE,
    WRITE_PROTECTED,
    Command,
    reply_name,
)
from rtlog_server.devices.lms111.scan_data import ScanData
from rtlog_server.devices.lms111.sweep import (
    FIELD_START_1E4DEG,
    FIELD_STOP_1E4DEG,
    first_ray_delay_us,
    sweep_us,
)

PAIRS = ((2500, 2500), (5000, 5000))  # scan frequency 1/100 Hz and resolution 1/10000° that go together
SHOTS_PER_SECOND = 36_000  # at 50 Hz and 0.5° as at 25 Hz and 0.25°
FACTORY: dict[str, tuple[Any, ...]] = {
    "LMPscancfg": (2500, 1, 2500, FIELD_START_1E4DEG, FIELD_STOP_1E4DEG),
    "LMPoutputRange": (1, 2500, FIELD_START_1E4DEG, FIELD_STOP_1E4DEG),
    "LMDscandatacfg": (1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1),
}
FIXED: dict[str, tuple[Any, ...]] = {
    "DeviceIdent": ("LMS111 emulator", "V1.80.2"),
    "FirmwareVersion": ("V1.80.2  ",),
    "LocationName": ("not defined",),
    "ODoprh": (1110,),
    "ODpwrc": (63,),
}
CONTAMINATION_OF_STATUS = {2: 1, 4: 2, 5: 2}  # LCMstate by the device status of the scans
WRITABLE = ("LMPoutputRange", "LMDscandatacfg", "EIHstCola")
DONE = {"LMCstandby": 0, "mEEwriteall": 1, "LSPsetdatetime": 1}  # methods that only say that all went well


class EmulatedScanner:
    """A scanner that has power from `now_ns` on.

    Args:
        now_ns: the time (monotonic).
        serial_no: as the scans tell it.
        speaks_cola_b: what its port speaks at first.
        clock_offset_us: what its clock counts at the first power-up; from the second on it is 0, as in a real one.
        telegrams: what its counters of telegrams and scans count at the first power-up.
        clock_drift_ppm: how much faster its clock goes than ours.
        start_s: how long it takes to measure, from power-up and from LMCstartmeas.
    """

    def __init__(
        self,
        now_ns: int,
        serial_no: int,
        speaks_cola_b: bool,
        clock_offset_us: int,
        clock_drift_ppm: float,
        start_s: float,
        telegrams: int = 0,
    ) -> None:
        self._serial_no = serial_no
        self._next_offset_us, self._next_telegrams = clock_offset_us, telegrams
        self._rate_per_ns = (1 + clock_drift_ppm * 1e-6) / 1000
        self._start_ns = int(start_s * 1e9)
        self._kept = {"EIHstCola": (int(speaks_cola_b),)}
        self.device_status = (0, 0)
        self.outside_temperature = False
        self.power_up(now_ns)

    def power_up(self, now_ns: int) -> None:
        self._power_up_ns = now_ns
        self._offset_us, self._next_offset_us = self._next_offset_us, 0
        self._variables = FACTORY | FIXED | self._kept
        self._measuring_from_ns: int | None = now_ns + self._start_ns
        self._preparing = INITIALISING
        self._telegram_counter = self._scan_counter = self._next_telegrams
        self._next_telegrams = 0
        self._index_ns = now_ns
        self.newest: ScanData | None = None
        self.hang_up()

    def hang_up(self) -> None:
        """The connection ended, and with it the login and the registration for scans."""
        self._logged_in = False
        self.streaming = False

    @property
    def speaks_cola_b(self) -> bool:
        return bool(self._variables["EIHstCola"][0])

    def state(self, now_ns: int) -> int:
        if self._measuring_from_ns is None:
            return IDLE
        return MEASURING if now_ns >= self._measuring_from_ns else self._preparing

    def period_us(self) -> float:
        return 1e8 / float(self._variables["LMPscancfg"][0])

    def answer(self, command: Command, now_ns: int) -> Command:
        """The reply to a command other than `sRN LMDscandata`."""
        verb, name = command.name.split(" ", 1)
        if verb == "sRN":
            values = self._read(name, now_ns)
            return Command("sFA", (UNKNOWN_VARIABLE,)) if values is None else Command(reply_name(command.name), values)
        if verb == "sWN":
            if not self._logged_in:
                return Command("sFA", (WRITE_PROTECTED,))
            if name not in WRITABLE:
                return Command("sFA", (UNKNOWN_VARIABLE,))
            self._variables[name] = command.values
            return Command(reply_name(command.name))
        if verb == "sEN":
            if name == "LMDscandata":
                self.streaming = command.values[0] == 1
            return Command(reply_name(command.name), command.values)
        return self._invoke(name, command, now_ns)

    def _read(self, name: str, now_ns: int) -> tuple[Any, ...] | None:
        if name == "STlms":
            calendar = time.gmtime((now_ns - self._power_up_ns) // 1_000_000_000)
            texts = time.strftime("%H:%M:%S", calendar), time.strftime("%d.%m.%Y", calendar)
            return (self.state(now_ns), int(self.outside_temperature), *texts, 0, 0, 0)
        if name == "LCMstate":
            return (CONTAMINATION_OF_STATUS.get(self.device_status[1], 0),)
        if name == "SCdevicestate":
            if self.device_status[1] == 1:
                return (DEVICE_ERROR,)
            return (int(not self._logged_in and self.state(now_ns) == MEASURING),)
        return self._variables.get(name)

    def _invoke(self, name: str, command: Command, now_ns: int) -> Command:
        reply = reply_name(command.name)
        if name == "SetAccessMode":
            self._logged_in = command.values == AUTHORISED_CLIENT
            return Command(reply, (int(self._logged_in),))
        if name == "Run":
            self._logged_in = False
            return Command(reply, (1,))
        if name in DONE:
            return Command(reply, (DONE[name],))
        if name not in ("mLMPsetscancfg", "LMCstartmeas", "LMCstopmeas"):
            return Command("sFA", (UNKNOWN_METHOD,))
        if not self._logged_in:
            return Command("sFA", (ACCESS_DENIED,))
        if name == "mLMPsetscancfg":
            refused = 0 if (command.values[0], command.values[2]) in PAIRS else 3
            if not refused:
                self._variables["LMPscancfg"] = command.values
                self._measuring_from_ns = None
            return Command(reply, (refused, *self._variables["LMPscancfg"]))
        if name == "LMCstopmeas":
            self._measuring_from_ns = None
        elif self._measuring_from_ns is None:
            self._measuring_from_ns, self._preparing = now_ns + self._start_ns, IN_PREPARATION
        return Command(reply, (0,))

    def last_ray_ns(self, sweep: Sweep) -> int:
        duration_us = sweep_us(len(sweep.echoes[0].ranges), sweep.step_1e4deg, self.period_us())
        return sweep.first_ray_ns + round(1000 * duration_us)

    def scan_data(self, sweep: Sweep, now_ns: int) -> ScanData:
        """The telegram of a sweep that is transmitted now; counts it."""
        index_ns = sweep.first_ray_ns - round(1000 * first_ray_delay_us(sweep.start_1e4deg, self.period_us()))
        turns = max(1, round((index_ns - self._index_ns) / (1000 * self.period_us())))
        self._index_ns = index_ns
        self._telegram_counter = (self._telegram_counter + 1) % 65536
        self._scan_counter = (self._scan_counter + turns) % 65536
        echoes, _, with_remission, in_16_bit = self._variables["LMDscandatacfg"][:4]
        channels16, channels8 = echo_channels(sweep, echoes, bool(with_remission), bool(in_16_bit))
        self.newest = ScanData(
            version=1,
            device_no=1,
            serial_no=self._serial_no,
            device_status=self.device_status,
            telegram_counter=self._telegram_counter,
            scan_counter=self._scan_counter,
            time_since_startup_us=self._clock_us(index_ns),
            time_of_transmission_us=self._clock_us(now_ns),
            digital_inputs=(0, 0),
            digital_outputs=(7, 0),
            layer_angle=0,
            scan_frequency_centihz=self._variables["LMPscancfg"][0],
            measurement_frequency_100hz=SHOTS_PER_SECOND // 100,
            encoders=(),
            channels16=channels16,
            channels8=channels8,
        )
        return self.newest

    def _clock_us(self, host_ns: int) -> int:
        return (self._offset_us + math.floor((host_ns - self._power_up_ns) * self._rate_per_ns)) % WRAP_US

"""The stage of a replay: an emulator for every device that the profile gives an address, and wires that can fail.

In: a profile, what the encoders showed, the devices whose wires a fault script needs. Out: emulators, to which scans
and tag reads are given. A device without faults stands at its address itself; one with faults behind a `Wire` there.
"""

import logging
import math
import socket
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from msgspec.structs import replace

from hw_profiles.errors import BadInputError, RTLogError
from hw_profiles.profile import CanBus, Encoder, LaserDevice, Profile, RfidDevice, SeiBus
from rtlog_client.can_wire import CanWire
from rtlog_client.serial_wire import SerialWire
from rtlog_client.tcp_wire import TcpWire
from rtlog_client.wire import Wire
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.devices.encoders import counts_at
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.realtime import become_realtime

log = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
Angle = Callable[[str, int], float]  # encoder, monotonic ns → rad


@dataclass(frozen=True, slots=True)
class Line:
    """A device's wire, and what gives the device its power back after a restart."""

    wire: Wire
    power_cycle: Callable[[], None]


def addressed_lasers(profile: Profile) -> dict[str, LaserDevice]:
    """By device name."""
    lasers = (("laser/primary", profile.lasers.primary), ("laser/auxiliary", profile.lasers.auxiliary))
    return {name: laser.device for name, laser in lasers if laser is not None and laser.device is not None}


def addressed_devices(profile: Profile) -> list[str]:
    """The names of the devices that can be emulated."""
    names = list(addressed_lasers(profile))
    names += ["encoders"] if profile.encoder_bus is not None else []
    return names + (["rfid"] if profile.rfid is not None and profile.rfid.device is not None else [])


class Stage:
    """The emulators of a profile, running until the context ends.

    Args:
        angle: what an encoder shows at a time; called in the emulators' threads.
        faulty: the devices that get a wire.
        seed: of the wires' noise.
        dialect: what the scanners speak, "A" or "B".

    Raises:
        BadInputError: no device of the profile has an address.
        RTLogError: an address is taken.
    """

    def __init__(
        self, profile: Profile, angle: Angle, faulty: Collection[str] = (), seed: int = 0, dialect: str = "B"
    ) -> None:
        self.lasers: dict[str, Lms111Emulator] = {}
        self.reader: Alr9650Emulator | None = None
        self.lines: dict[str, Line] = {}
        self._faulty = faulty
        self._seed = seed
        self._dialect = dialect
        if not addressed_devices(profile):
            raise BadInputError(f"profile {profile.name} gives no device an address: there is nothing to emulate")
        with ExitStack() as stack:
            self._stack = stack
            for name, laser in addressed_lasers(profile).items():
                with _located(f"{laser.host}:{laser.port}"):
                    self._open_laser(name, laser)
            if profile.encoder_bus is not None:
                with _located(profile.encoder_bus.place):
                    self._open_encoders(profile.encoder_bus, profile.encoders, angle)
            if profile.rfid is not None and profile.rfid.device is not None:
                with _located(profile.rfid.device.place):
                    self._open_reader(profile.rfid.device)
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _open_laser(self, name: str, laser: LaserDevice) -> None:
        faulty = name in self._faulty
        address = (LOOPBACK, 0) if faulty else (laser.host, laser.port)
        emulator = Lms111Emulator(*address, dialect=self._dialect)
        self.lasers[name] = self._stack.enter_context(emulator)
        if faulty:
            wire = TcpWire(name, (laser.host, laser.port), self._seed)
            wire.device = emulator.address
            self._lead(name, wire, lambda: emulator.power_cycle(off_s=0.0))

    def _open_reader(self, device: RfidDevice) -> None:
        login = device.username, device.password
        wire: Wire | None = None
        if "rfid" not in self._faulty:
            link = Path(device.serial_port) if device.serial_port else None
            reader = Alr9650Emulator(device.host or LOOPBACK, device.port if link is None else 0, *login, link=link)
        elif device.serial_port:
            port = self._hidden("rfid")
            reader = Alr9650Emulator(link=port)
            wire = SerialWire("rfid", Path(device.serial_port), port, self._seed)
        else:
            wire = tcp = TcpWire("rfid", (device.host, device.port), self._seed)
            reader = Alr9650Emulator(LOOPBACK, 0, *login, connect=tcp.dial)
            tcp.device = LOOPBACK, reader.port
        self.reader = self._stack.enter_context(reader)

        def power_cycle() -> None:
            reader.power_off()
            reader.power_on()

        if wire is not None:
            self._lead("rfid", wire, power_cycle)

    def _open_encoders(self, bus: SeiBus | CanBus, fitted: list[Encoder], angle: Angle) -> None:
        encoders = {encoder.address: encoder for encoder in fitted if encoder.address is not None}
        counts = {address: encoder.counts_per_turn for address, encoder in encoders.items()}

        def position(address: int, at_ns: int) -> int:
            encoder = encoders[address]
            return total_counts(encoder, angle(encoder.name, at_ns))

        there = self._behind_wire(bus) if "encoders" in self._faulty else bus
        emulator: SeiBusEmulator | CanBusEmulator
        if isinstance(there, SeiBus):
            echo, multi_turn = there.echo == "yes", there.turns == "multi"
            emulator = SeiBusEmulator(Path(there.port), counts, position, echo, multi_turn, there.strobe)
        else:
            emulator = CanBusEmulator(there, counts, position)
        self._stack.enter_context(emulator)

        def power_cycle() -> None:
            for address in counts:
                emulator.power_cycle(address)

        if there is not bus:
            self._lead("encoders", self._bus_wire(bus, there), power_cycle)

    def _behind_wire(self, bus: SeiBus | CanBus) -> SeiBus | CanBus:
        """Where the emulated encoders are, if there is to be a wire between them and the host's bus."""
        if isinstance(bus, SeiBus):
            return replace(bus, port=str(self._hidden("encoders")))
        if bus.interface == "slcan":
            return replace(bus, channel=str(self._hidden("encoders")))
        if bus.interface == "udp_multicast":
            return replace(bus, udp_port=_free_udp_port())
        raise BadInputError(f"faults of encoders on {bus.interface}: only slcan and udp_multicast have a wire to spoil")

    def _bus_wire(self, bus: SeiBus | CanBus, there: SeiBus | CanBus) -> Wire:
        match bus, there:
            case SeiBus(), SeiBus():
                return SerialWire("encoders", Path(bus.port), Path(there.port), self._seed)
            case CanBus(interface="slcan"), CanBus():
                return SerialWire("encoders", Path(bus.channel), Path(there.channel), self._seed)
            case CanBus(), CanBus():
                return CanWire("encoders", bus, there.udp_port, self._seed)
        raise AssertionError((bus, there))

    def _lead(self, device: str, wire: Wire, power_cycle: Callable[[], None]) -> None:
        self.lines[device] = Line(self._stack.enter_context(wire), power_cycle)

    def _hidden(self, name: str) -> Path:
        """Where an emulator's terminal stands behind its wire."""
        return Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="rtlog-"))) / name


def ask_realtime() -> None:
    """Before a stage is opened, whose threads inherit it: a device does not wait for this machine's other work."""
    log.info("real time: %s", "; ".join(f"{key} {answer}" for key, answer in become_realtime().items()))


@contextmanager
def _located(where: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        hint = "the profile must name addresses of this machine that are free"
        raise RTLogError(f"{where}: {error.strerror or error}; {hint}") from error


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def total_counts(encoder: Encoder, angle_rad: float) -> int:
    """What the encoder counts at this angle: a wheel over many turns, steering within its turn."""
    if encoder.role == "steering":
        return counts_at(encoder, angle_rad)
    return round((-angle_rad if encoder.reversed else angle_rad) / math.tau * encoder.counts_per_turn)

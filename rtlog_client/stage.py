"""The stage of a replay: an emulator for every device that the profile gives an address, and wires that can fail.

In: a profile, what the encoders showed, the devices whose wires a fault script needs. Out: emulators, to which scans
and tag reads are given. A device without faults stands at its address itself; one with faults behind a `Wire` there.
"""

import math
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from hw_profiles.errors import BadInputError, RTLogError
from hw_profiles.profile import Encoder, LaserDevice, Profile, RfidDevice, SeiBus
from rtlog_client.serial_wire import SerialWire
from rtlog_client.tcp_wire import TcpWire
from rtlog_client.wire import Wire
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.encoders import counts_at
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.devices.sei.emulator import SeiBusEmulator

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

    Raises:
        BadInputError: no device of the profile has an address.
        RTLogError: an address is taken.
    """

    def __init__(self, profile: Profile, angle: Angle, faulty: Collection[str] = (), seed: int = 0) -> None:
        self.lasers: dict[str, Lms111Emulator] = {}
        self.reader: Alr9650Emulator | None = None
        self.lines: dict[str, Line] = {}
        self._faulty = faulty
        self._seed = seed
        if not addressed_devices(profile):
            raise BadInputError(f"profile {profile.name} gives no device an address: there is nothing to emulate")
        with ExitStack() as stack:
            self._stack = stack
            for name, laser in addressed_lasers(profile).items():
                with _located(f"{laser.host}:{laser.port}"):
                    self._open_laser(name, laser)
            if profile.encoder_bus is not None:
                with _located(profile.encoder_bus.port):
                    self._open_encoders(profile.encoder_bus, profile.encoders, angle)
            if profile.rfid is not None and profile.rfid.device is not None:
                with _located(f"{profile.rfid.device.host}:{profile.rfid.device.port}"):
                    self._open_reader(profile.rfid.device)
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _tcp_wire(self, name: str, host: str, port: int) -> TcpWire | None:
        if name not in self._faulty:
            return None
        return self._stack.enter_context(TcpWire(name, (host, port), self._seed))

    def _open_laser(self, name: str, laser: LaserDevice) -> None:
        wire = self._tcp_wire(name, laser.host, laser.port)
        emulator = Lms111Emulator(laser.host, laser.port) if wire is None else Lms111Emulator()
        self.lasers[name] = self._stack.enter_context(emulator)
        if wire is not None:
            wire.device = emulator.address
            self.lines[name] = Line(wire, lambda: emulator.power_cycle(off_s=0.0))

    def _open_reader(self, device: RfidDevice) -> None:
        wire = self._tcp_wire("rfid", device.host, device.port)
        login = device.username, device.password
        if wire is None:
            self.reader = self._stack.enter_context(Alr9650Emulator(device.host, device.port, *login))
            return
        reader = self.reader = self._stack.enter_context(Alr9650Emulator("127.0.0.1", 0, *login, connect=wire.dial))
        wire.device = "127.0.0.1", reader.port

        def power_cycle() -> None:
            reader.power_off()
            reader.power_on()

        self.lines["rfid"] = Line(wire, power_cycle)

    def _open_encoders(self, bus: SeiBus, fitted: list[Encoder], angle: Angle) -> None:
        encoders = {encoder.address: encoder for encoder in fitted if encoder.address is not None}

        def position(address: int, at_ns: int) -> int:
            encoder = encoders[address]
            return total_counts(encoder, angle(encoder.name, at_ns))

        counts = {address: encoder.counts_per_turn for address, encoder in encoders.items()}
        port = Path(bus.port)
        faulty = "encoders" in self._faulty
        if faulty:
            port = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="rtlog-"))) / "encoders"
        emulator = SeiBusEmulator(port, counts, position, bus.echo == "yes", bus.turns == "multi")
        self._stack.enter_context(emulator)
        if not faulty:
            return

        def power_cycle() -> None:
            for address in counts:
                emulator.power_cycle(address)

        wire = self._stack.enter_context(SerialWire("encoders", Path(bus.port), port, self._seed))
        self.lines["encoders"] = Line(wire, power_cycle)


@contextmanager
def _located(where: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        hint = "the profile must name addresses of this machine that are free"
        raise RTLogError(f"{where}: {error.strerror or error}; {hint}") from error


def total_counts(encoder: Encoder, angle_rad: float) -> int:
    """What the encoder counts at this angle: a wheel over many turns, steering within its turn."""
    if encoder.role == "steering":
        return counts_at(encoder, angle_rad)
    return round((-angle_rad if encoder.reversed else angle_rad) / math.tau * encoder.counts_per_turn)

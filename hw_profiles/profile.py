"""The hardware profile: what the vehicle is, as frozen, strict records.

In: TOML, the vehicle engineer's. Out: a `Profile`. A recording needs `[vehicle]`, `[lasers]`, `[[encoders]]` and
`[rfid]` only; the device sections (`[lasers.primary.device]`, `[encoder_bus]`, `[rfid.device]`) are what the server
needs on top, and are checked with the rest. Lengths in metres, angles in degrees, as the unit at the end of a key says.

                        y                    mount: where the scanner sits in the vehicle frame (REP-103), whose
                        ^                    origin is the middle of the axle that `[vehicle]` describes
              left wheel|
       scanner  ●───────┼──────> x  ahead
              right wheel
"""

import ipaddress
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from msgspec import field

from hw_profiles.errors import BadInputError
from hw_profiles.strict_toml import Record, parse_toml

SHIPPED = Path(__file__).parent


class OdometryNoise(Record, frozen=True):
    """How the wheels' error grows: standard deviations per square root of distance or angle travelled."""

    distance_m_per_sqrt_m: float = 0.02
    lateral_m_per_sqrt_m: float = 0.005  # slip to the side, which no wheel counts
    position_m_per_sqrt_deg: float = 0.001  # scrubbing of the wheels in a turn, ahead and to the side
    heading_deg_per_sqrt_m: float = 0.3
    heading_deg_per_sqrt_deg: float = 0.2


class Vehicle(Record, frozen=True):
    kinematics: Literal["differential", "tricycle"]
    track_width_m: float | None = None
    wheelbase_m: float | None = None
    drive_axle: Literal["rear", "front"] = "rear"  # tricycle: the axle whose wheel the drive encoder counts
    odometry_noise: OdometryNoise = OdometryNoise()


class Mount(Record, frozen=True):
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_deg: float = 0.0


class LaserDevice(Record, frozen=True):
    host: str
    port: int = 2112
    scan_frequency_hz: Literal[25, 50] = 50  # the LMS111 pairs 25 Hz with 0.25° and 50 Hz with 0.5°
    echo: Literal["first", "last"] = "first"  # of a ray that met two things: "last" sees through dust, rain and mesh
    remission_bits: Literal[8, 16] = 16


class Laser(Record, frozen=True):
    model: Literal["LMS111"] = "LMS111"
    mount: Mount = Mount()
    blind_sectors_deg: tuple[tuple[float, float], ...] = ()  # in its frame, counter-clockwise; [170, -170] is 20° wide
    min_range_m: float = 0.0  # what is nearer is the vehicle, or dirt on the window
    range_noise_m: float = 0.012  # statistical error of an LMS111, data sheet
    device: LaserDevice | None = None


class Lasers(Record, frozen=True):
    primary: Laser = Laser()
    auxiliary: Laser | None = None


class Encoder(Record, frozen=True):
    name: str
    role: Literal["left_wheel", "right_wheel", "drive_wheel", "steering"]
    counts_per_turn: int = 4096
    wheel_radius_m: float | None = None
    zero_deg: float = 0.0  # steering: the encoder's reading when the wheel points straight ahead
    reversed: bool = False  # counts fall when the vehicle drives ahead, or steers to the left
    address: int | None = None  # on the bus: SEI address 0…14, CAN node id 1…127


class SeiBus(Record, frozen=True, tag_field="kind", tag="sei"):
    """US Digital A2 encoders on one SEI bus behind a serial port."""

    port: str
    baud: Literal[9600, 115200] = 9600
    echo: Literal["auto", "yes", "no"] = "auto"  # does the adapter return every byte that is sent?
    turns: Literal["single", "multi"] = "single"
    strobe: bool = False  # encoders were put into strobe mode by US Digital's software: all latch at our strobe

    @property
    def place(self) -> str:
        """Where the bus is reached."""
        return self.port


class CanBus(Record, frozen=True, tag_field="kind", tag="can"):
    """CiA 406 (CANopen) encoders on one CAN bus; their addresses are node ids."""

    channel: str  # socketcan: network interface; slcan: serial port; udp_multicast: group; virtual: any name
    interface: Literal["socketcan", "slcan", "udp_multicast", "virtual"] = "socketcan"
    bitrate: Literal[10_000, 20_000, 50_000, 125_000, 250_000, 500_000, 1_000_000] = 500_000  # socketcan: set outside
    udp_port: int = 43113
    trigger: Literal["sync", "timer"] = "sync"  # positions latched at our SYNC, or sent by the encoders' own clocks
    timer_ms: int = 10  # of trigger = "timer"
    vendor_id: int | None = None  # of all encoders (object 1018h:1); None: any

    @property
    def place(self) -> str:
        """Where the bus is reached."""
        return f"{self.interface}:{self.channel}"


class RfidDevice(Record, frozen=True):
    """The reader's console: on the network (`host`), or on a serial line (`serial_port`), which asks for no login."""

    host: str = ""
    port: int = 23
    serial_port: str = ""
    baud: Literal[9600, 19200, 38400, 57600, 115200] = 115200
    username: str = "alien"
    password: str = "password"
    stream_host: str | None = None  # our own address as the reader sees it; None: the one the console was opened from
    stream_port: int = 0  # the reader connects back to this port; 0 takes any

    @property
    def place(self) -> str:
        """Where the console is reached."""
        return self.serial_port or f"{self.host}:{self.port}"


class Rfid(Record, frozen=True):
    model: Literal["ALR-9650"] = "ALR-9650"
    device: RfidDevice | None = None


class Zenoh(Record, frozen=True):
    listen: tuple[str, ...] = ("tcp/0.0.0.0:7447",)


class Profile(Record, frozen=True):
    schema: Literal[1]
    name: str
    tick_period_s: float = 0.1
    vehicle: Vehicle | None = None
    lasers: Lasers = Lasers()
    encoders: list[Encoder] = field(default_factory=list)
    encoder_bus: SeiBus | CanBus | None = None
    rfid: Rfid | None = None
    zenoh: Zenoh = Zenoh()

    def encoder(self, role: str) -> Encoder:
        """The encoder in this role; the profile was checked to hold it if its kinematics need it."""
        return next(encoder for encoder in self.encoders if encoder.role == role)


ROLES = {"differential": ("left_wheel", "right_wheel"), "tricycle": ("drive_wheel", "steering")}


def shipped_profiles() -> list[str]:
    """The names of the profiles that come with the package."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def read_profile_text(name_or_path: str | Path) -> str:
    """The TOML of a shipped profile by its name, or of a file.

    Raises:
        BadInputError: there is no such profile or file, or it is no text.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_profiles():
        path = SHIPPED / f"{name_or_path}.toml"
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        hint = f"shipped profiles are {', '.join(shipped_profiles())}"
        raise BadInputError(f"profile {name_or_path}: {error.strerror or error}; {hint}") from error
    except UnicodeDecodeError as error:
        raise BadInputError(f"profile {name_or_path}: not UTF-8 text (byte {error.start})") from error


def load_profile(name_or_path: str | Path) -> Profile:
    """Read and check a profile. Raises: BadInputError with the file, the key and what is wrong with it."""
    return parse_profile(read_profile_text(name_or_path), source=str(name_or_path))


def parse_profile(text: str, source: str) -> Profile:
    """Check a profile's TOML; `source` names it in errors. Raises: BadInputError."""
    profile = parse_toml(text, Profile, f"profile {source}")
    for problem in _problems(profile):
        raise BadInputError(f"profile {source}: {problem}")
    return profile


def _problems(profile: Profile) -> Iterator[str]:
    """What the types cannot say."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", profile.name):  # it is a part of every zenoh key
        yield f"name is {profile.name!r}; it must be letters, digits, _ . and -, the first a letter or digit"
    if not 0.01 <= profile.tick_period_s <= 10.0:
        yield f"tick_period_s is {profile.tick_period_s}; it must lie in 0.01 … 10"
    vehicle = profile.vehicle
    if profile.encoders and vehicle is None:
        yield "[[encoders]] need a [vehicle] with its kinematics"
    if vehicle is not None:
        needed = "track_width_m" if vehicle.kinematics == "differential" else "wheelbase_m"
        size = getattr(vehicle, needed)
        if size is None or not (size > 0 and math.isfinite(size)):
            yield f"vehicle.{needed} is {size}; {vehicle.kinematics} kinematics need it above 0"
        roles = [encoder.role for encoder in profile.encoders]
        wanted = ROLES[vehicle.kinematics]
        if roles and sorted(roles) != sorted(wanted):
            yield f"{vehicle.kinematics} kinematics need one encoder in each role {' and '.join(wanted)}; found {roles}"
    for which, laser in (("primary", profile.lasers.primary), ("auxiliary", profile.lasers.auxiliary)):
        if laser is not None:
            yield from _laser_problems(f"lasers.{which}", laser)
    names = [encoder.name for encoder in profile.encoders]
    if len(set(names)) != len(names):
        yield f"encoders share a name: {names}"
    for index, encoder in enumerate(profile.encoders):
        where = f"encoders[{index}]"
        if not 2 <= encoder.counts_per_turn <= 1 << 32:
            yield f"{where}.counts_per_turn is {encoder.counts_per_turn}; it must lie in 2 … {1 << 32}"
        if encoder.role != "steering" and not (encoder.wheel_radius_m or 0) > 0:
            yield f"{where}.wheel_radius_m is {encoder.wheel_radius_m}; a wheel needs it above 0"
    reader = profile.rfid.device if profile.rfid is not None else None
    if reader is not None and bool(reader.host) == bool(reader.serial_port):
        yield f"rfid.device.host is {reader.host!r} and serial_port {reader.serial_port!r}; it must be one of the two"
    if profile.encoder_bus is not None:
        yield from _bus_problems(profile.encoder_bus, profile.encoders)


def _laser_problems(where: str, laser: Laser) -> Iterator[str]:
    """What leaves a laser nothing to see, or cannot be a laser."""
    for index, (start, end) in enumerate(laser.blind_sectors_deg):
        if max(abs(start), abs(end)) > 360 or not 0 < (end - start) % 360 <= 270:
            yield (
                f"{where}.blind_sectors_deg[{index}] is [{start}, {end}]; it must run counter-clockwise from its first "
                "angle to its second, over 270° at most"
            )
    if not 0 <= laser.min_range_m <= 5:
        yield f"{where}.min_range_m is {laser.min_range_m}; it must lie in 0 … 5"
    if not 0.001 <= laser.range_noise_m <= 0.2:
        yield f"{where}.range_noise_m is {laser.range_noise_m}; it must lie in 0.001 … 0.2"


def _bus_problems(bus: SeiBus | CanBus, encoders: list[Encoder]) -> Iterator[str]:
    """What makes the encoders none that this bus can have, or the bus none that can be opened."""
    is_sei = isinstance(bus, SeiBus)
    kind, first, last, most = ("an SEI bus", 0, 14, 1 << 16) if is_sei else ("a CAN bus", 1, 127, (1 << 32) - 1)
    for index, encoder in enumerate(encoders):
        if encoder.address is None or not first <= encoder.address <= last:
            yield f"encoders[{index}].address is {encoder.address}; an encoder on {kind} has one in {first} … {last}"
        if encoder.counts_per_turn > most:
            yield f"encoders[{index}].counts_per_turn is {encoder.counts_per_turn}; on {kind} it is {most} or less"
    addresses = [encoder.address for encoder in encoders]
    if len(set(addresses)) != len(addresses):
        yield f"encoders share an address on the bus: {addresses}"
    if isinstance(bus, CanBus):
        if not 1 <= bus.timer_ms <= 1000:
            yield f"encoder_bus.timer_ms is {bus.timer_ms}; it must lie in 1 … 1000"
        if not 1 <= bus.udp_port <= 65535:
            yield f"encoder_bus.udp_port is {bus.udp_port}; it must lie in 1 … 65535"
        if bus.interface == "udp_multicast" and not _is_multicast(bus.channel):
            yield f"encoder_bus.channel is {bus.channel!r}; udp_multicast needs a group such as 239.74.163.2"
        if not bus.channel:
            yield "encoder_bus.channel is empty"


def _is_multicast(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_multicast
    except ValueError:
        return False

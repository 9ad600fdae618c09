"""LMDscandata: one sweep as an LMS111 sends it, in the device's own integers and units. No I/O, no clock.

In: a reader behind the command. Out: `ScanData`; and back. The same code reads CoLa A and B, as both send the same
fields in the same order. The law: a telegram is as long as its counts say or longer, never shorter.

Source: SICK Telegram Listing 8014631, "LMDscandata"; LMS500 operating instructions 8013796, pp. 81-84; captured scans.
"""

from dataclasses import dataclass
from typing import NamedTuple

from rtlog_server.devices.lms111.cola import ColaError, Dialect, frame
from rtlog_server.devices.lms111.fields import Array, Reader, Writer, open_writer

HEADER = "HHIBBHHIIBBBBHII"
MAX_ENCODERS = 3
MAX_CHANNELS = 8  # of 16 and of 8 bit each; two echoes with remission are four
MAX_SCALE = 1e6
CONTENT_CHARACTERS = 5
EVENT_CHARACTERS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    content: str  # DIST1, DIST2: distances of the echoes; RSSI1, RSSI2: their remission
    scale_factor: float
    scale_offset: float
    start_angle_1e4deg: int  # device angle: 90° is straight ahead, counter-clockwise
    angular_step_1e4deg: int
    data: Array  # (N,) uint8 or uint16; distance in mm = data * scale_factor + scale_offset


class Encoder(NamedTuple):
    position_ticks: int
    speed: int


class Position(NamedTuple):
    x: float
    y: float
    z: float
    rotation_x: float
    rotation_y: float
    rotation_z: float
    rotation_type: int
    device_id: int


class Timestamp(NamedTuple):
    """The device's calendar, which begins in 1970 at each power-up unless someone sets it."""

    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    microsecond: int


class Event(NamedTuple):
    kind: str
    encoder_position_ticks: int
    time_since_startup_us: int
    angle_1e4deg: int


@dataclass(frozen=True, slots=True, eq=False)
class ScanData:
    version: int
    device_no: int
    serial_no: int
    device_status: tuple[int, int]  # (1, 0): not settled after the start; (0, 1), (0, 2), (0, 4): see `sweep`
    telegram_counter: int  # modulo 65536, as the next
    scan_counter: int
    time_since_startup_us: int  # modulo 2^32, as the next; at the head's zero index
    time_of_transmission_us: int  # when the complete scan was ready for sending
    digital_inputs: tuple[int, int]
    digital_outputs: tuple[int, int]
    layer_angle: int
    scan_frequency_centihz: int
    measurement_frequency_100hz: int
    encoders: tuple[Encoder, ...]
    channels16: tuple[Channel, ...]
    channels8: tuple[Channel, ...]
    position: Position | None = None
    device_name: str | None = None
    comment: str | None = None
    time: Timestamp | None = None
    event: Event | None = None

    def channel(self, content: str) -> Channel | None:
        """The channel with this content, if the telegram holds it."""
        return next((c for c in (*self.channels16, *self.channels8) if c.content == content), None)


def read_scan_data(reader: Reader) -> ScanData:
    """LMDscandata from behind the command.

    Raises:
        ColaError: the telegram is too short, or a count or scale in it is impossible.
    """
    header = reader.take(HEADER)
    version, device_no, serial_no, status0, status1, telegram_counter, scan_counter, startup_us, transmission_us = (
        header[:9]
    )
    inputs0, inputs1, outputs0, outputs1, layer_angle, scan_frequency, measurement_frequency = header[9:]
    return ScanData(
        version,
        device_no,
        serial_no,
        (status0, status1),
        telegram_counter,
        scan_counter,
        startup_us,
        transmission_us,
        (inputs0, inputs1),
        (outputs0, outputs1),
        layer_angle,
        scan_frequency,
        measurement_frequency,
        tuple(Encoder(*reader.take("ih")) for _ in range(_count(reader, MAX_ENCODERS))),
        tuple(_read_channel(reader, "H") for _ in range(_count(reader, MAX_CHANNELS))),
        tuple(_read_channel(reader, "B") for _ in range(_count(reader, MAX_CHANNELS))),
        Position(*reader.take("ffffffBB")) if _flag(reader) else None,
        reader.text() if _flag(reader) else None,
        reader.text() if _flag(reader) else None,
        Timestamp(*reader.take("HBBBBBI")) if _flag(reader) else None,
        Event(reader.characters(EVENT_CHARACTERS), *reader.take("IIi")) if _flag(reader) else None,
    )


def _count(reader: Reader, highest: int) -> int:
    (count,) = reader.take("H")
    if count > highest:
        raise ColaError(f"LMDscandata announces {count} blocks where {highest} are possible")
    return int(count)


def _flag(reader: Reader) -> bool:
    return bool(reader.take("H")[0])


def _read_channel(reader: Reader, code: str) -> Channel:
    content = reader.characters(CONTENT_CHARACTERS)
    scale_factor, scale_offset, start_angle, step, count = reader.take("ffiHH")
    if not (0 < scale_factor <= MAX_SCALE and abs(scale_offset) <= MAX_SCALE):
        raise ColaError(f"channel {content!r} is scaled by {scale_factor} and {scale_offset}")
    return Channel(content, scale_factor, scale_offset, start_angle, step, reader.array(code, count))


def encode_scan_data(dialect: Dialect, scan: ScanData, command: str = "sSN LMDscandata") -> bytes:
    """The telegram of a scan, ready for the wire."""
    writer = open_writer(dialect, command)
    writer.put(
        HEADER,
        scan.version,
        scan.device_no,
        scan.serial_no,
        *scan.device_status,
        scan.telegram_counter,
        scan.scan_counter,
        scan.time_since_startup_us,
        scan.time_of_transmission_us,
        *scan.digital_inputs,
        *scan.digital_outputs,
        scan.layer_angle,
        scan.scan_frequency_centihz,
        scan.measurement_frequency_100hz,
    )
    writer.put("H", len(scan.encoders))
    for encoder in scan.encoders:
        writer.put("ih", *encoder)
    for channels in (scan.channels16, scan.channels8):
        writer.put("H", len(channels))
        for channel in channels:
            _write_channel(writer, channel)
    writer.put("H", scan.position is not None)
    if scan.position is not None:
        writer.put("ffffffBB", *scan.position)
    for text in (scan.device_name, scan.comment):
        writer.put("H", text is not None)
        if text is not None:
            writer.text(text)
    writer.put("H", scan.time is not None)
    if scan.time is not None:
        writer.put("HBBBBBI", *scan.time)
    writer.put("H", scan.event is not None)
    if scan.event is not None:
        writer.characters(scan.event.kind)
        writer.put("IIi", *scan.event[1:])
    return frame(dialect, writer.payload())


def _write_channel(writer: Writer, channel: Channel) -> None:
    writer.characters(channel.content)
    writer.put(
        "ffiHH",
        channel.scale_factor,
        channel.scale_offset,
        channel.start_angle_1e4deg,
        channel.angular_step_1e4deg,
        len(channel.data),
    )
    writer.array(channel.data)

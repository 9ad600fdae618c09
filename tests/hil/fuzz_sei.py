"""An SEI bus's bytes from a hostile wire: what answers a host, and what asks an encoder. Guided by coverage (atheris).

    python fuzz_sei.py WAY RUNS CORPUS      way: answer, request; corpus: a folder to fill

The law under test: whatever comes, nothing is raised but SeiError, a position lies within its range, and the total that
is made of it fits it; an encoder takes every byte in the end.
"""

import sys
from contextlib import suppress

import atheris
from fuzzing import fuzz

with atheris.instrument_imports(include=["rtlog_server.devices.sei", "rtlog_server.devices.encoders"]):
    from hw_profiles.profile import Encoder
    from rtlog_server.devices.encoders import Fix, ReadingMaker
    from rtlog_server.devices.sei import protocol
    from rtlog_server.devices.sei.protocol import SeiError

COUNTS = 3600  # leaves values that no position has
WHEEL = Encoder(name="wheel", role="left_wheel", counts_per_turn=COUNTS, wheel_radius_m=0.35)
TICK_NS = 100_000_000
LONGEST_REQUEST = 7


def try_answers(data: bytes) -> None:
    """A drive whose every answer, of up to 7 bytes, is hostile; the first byte says how the bus is set."""
    if not data:
        return
    multi_turn, echo, request = bool(data[0] & 1), bool(data[0] & 2), protocol.position_request(data[0] >> 4)
    modulus = COUNTS * (protocol.TURNS if multi_turn else 1)
    maker, index = ReadingMaker([WHEEL], {"wheel": modulus}), 1
    for tick in range(1, 40):
        if index >= len(data):
            break
        length = data[index] % 8
        received = data[index + 1 : index + 1 + length]
        index += 1 + length
        protocol.learn_echo(received, request, protocol.position_reply_bytes(multi_turn))
        with suppress(SeiError):
            protocol.decode_serial_number(received)
        try:
            raw = protocol.decode_position(protocol.strip_echo(received, request, echo), COUNTS, multi_turn)
        except SeiError:
            continue
        assert 0 <= raw < modulus
        fix = Fix(raw, tick * TICK_NS, tick * TICK_NS)
        maker.is_possible("wheel", fix)
        reading = maker.reading({"wheel": fix})
        assert reading.counts[0] % COUNTS == raw % COUNTS
        assert abs(reading.positions_rad[0]) < 1e10


def try_requests(data: bytes) -> None:
    """What an encoder hears, in one and byte by byte, is the same requests."""
    whole, slowly = bytearray(data), bytearray()
    requests = list(iter(lambda: protocol.take_request(whole), None))
    taken = []
    for byte in data:
        slowly.append(byte)
        taken += iter(lambda: protocol.take_request(slowly), None)
        assert len(slowly) < LONGEST_REQUEST
    assert taken == requests
    assert slowly == whole


def samples() -> list[bytes]:
    """A drive in each mode, and a request of each kind."""
    drives = []
    for mode in range(4):
        request, drive = protocol.position_request(0), bytes([mode])
        for tick in range(20):
            answer = request * (mode >> 1) + protocol.encode_position(300 * tick, COUNTS, bool(mode & 1))
            drive += bytes([len(answer)]) + answer
        drives.append(drive)
    asked = [protocol.position_request(3), protocol.strobe_request(), protocol.serial_number_request(3)]
    return [
        *drives,
        b"".join([*asked, protocol.reset_request(), protocol.fast_baud_request(), b"\xf1\x07\x00\x00\x00\x01\x02"]),
    ]


if __name__ == "__main__":
    fuzz(try_answers if sys.argv[1] == "answer" else try_requests, samples(), longest=200)

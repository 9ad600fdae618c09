"""Whatever state the reader was left in, and whatever it lacks: it is read, and what was amiss is told."""

import time
from collections.abc import Callable
from typing import Any

from rtlog_server.devices.alien import protocol
from rtlog_server.devices.alien.emulator import Alr9650Emulator

Start = Callable[..., Any]
SECOND_NS = 1_000_000_000
CUT_NS = 2_000_000  # the reader tells whole milliseconds

LEFT = (
    "set NotifyTrigger = TrueFalse",
    "set NotifyAddress = 127.0.0.1:9",
    "set NotifyMode = ON",
    "set TagListFormat = XML",
    "set TagStreamFormat = Terse",
    "set TagStreamCustomFormat = %i",
    "set TagStreamAddress = 127.0.0.1:9",
    "set TagStreamMode = ON",
    "set AutoAction = None",
    "set AutoStopTimer = 5000",
    "set PersistTime = -1",
    "set AcqG2Mask = 1, 32, 8, FF",
    "set AcqG2Target = B",
    "set NetworkTimeout = 90",
)


def test_whatever_state_the_reader_was_left_in_is_taken_over(
    emulator: Alr9650Emulator, start_on_wire: Start, epcs: list[str]
) -> None:
    emulator.configure("set AutoMode = ON")
    emulator.read_tag("0BAD")  # long ago, still on its list
    for command in LEFT:
        assert not protocol.is_error(emulator.configure(command)), command
    reader = start_on_wire(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    emulator.read_tag(epcs[1])
    reader.wait_for_epc(epcs[1])
    assert [sample.epc for sample in reader.samples] == [epcs[1]]
    for setting in (
        "NotifyMode = OFF",
        "AutoStopTimer = 0",
        "AutoAction = Acquire",
        "AcqG2Mask = 0",
        "AcqG2Target = A",
        "NetworkTimeout = 5",
    ):
        assert emulator.configure(f"get {setting.split()[0]}") == setting
    assert reader.device.diagnostics["refused settings"] == "Mask"  # which is of older readers


def test_a_tag_stream_left_on_the_serial_line_confuses_nobody(
    emulator: Alr9650Emulator, start_on_wire: Start, epcs: list[str]
) -> None:
    reader = start_on_wire(emulator.port)
    for _ in range(30):
        emulator.babble(b"#Alien RFID Reader Auto Notification Message\r\n#End of Notification Message\r\n\0")
        time.sleep(0.01)
    reader.wait_for(lambda: reader.device.connected)
    emulator.read_tag(epcs[1])
    reader.wait_for_epc(epcs[1])
    assert reader.device.connects == 1


def test_half_a_command_left_on_the_serial_line_harms_nothing(
    emulator: Alr9650Emulator, start_on_wire: Start, link: Any, epcs: list[str]
) -> None:
    link.write_bytes(b"set ReaderName = Tunnel")
    reader = start_on_wire(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    assert reader.device.identity["ReaderName"] in ("Tunnel", "Alien RFID Reader")  # not with ours at its end
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])


def test_settings_that_the_reader_lacks_are_told_and_survived(
    emulator: Alr9650Emulator, start: Start, epcs: list[str]
) -> None:
    emulator.lacks |= {"acqg2mask", "tagtype", "taglistmillis"}
    reader = start(emulator.port)
    reader.wait_until_reading()
    assert reader.device.diagnostics["refused settings"] == "TagType, Mask, AcqG2Mask, TagListMillis"
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])


def test_a_reader_without_a_tag_stream_notifies(emulator: Alr9650Emulator, start: Start, epcs: list[str]) -> None:
    emulator.lacks |= {"tagstreammode"}
    reader = start(emulator.port)
    reader.wait_until_reading()
    assert reader.device.diagnostics["push"] == "notify"
    before_ns = time.monotonic_ns()
    for count in (1, 2, 3):
        emulator.read_tag(epcs[0], antenna=1, rssi=-51.5, count=count)
        wanted = sum(range(count + 1))
        reader.wait_for(lambda: sum(sample.count for sample in reader.samples) == wanted)  # noqa: B023
    first = reader.samples[0]
    assert (first.epc, first.antenna, first.rssi) == (epcs[0], 1, -51.5)
    assert before_ns - 2_000_000 < first.measured_ns
    assert reader.device.diagnostics["streams"] == "1"  # one connection for all messages
    assert reader.device.diagnostics["garbled"] == "0"


def test_a_reader_that_can_push_nothing_is_polled(emulator: Alr9650Emulator, start: Start, epcs: list[str]) -> None:
    emulator.lacks |= {"tagstreammode", "notifymode"}
    reader = start(emulator.port)
    reader.wait_until_reading(stream="polling")
    assert reader.device.diagnostics["push"] == "none"
    emulator.read_tag(epcs[0], count=4)
    reader.wait_for_epc(epcs[0])
    assert reader.samples[0].count == 4


def test_a_clock_of_1970_is_set_and_then_tells_when_a_tag_was_read(
    emulator: Alr9650Emulator, start: Start, epcs: list[str]
) -> None:
    emulator.refuse_stream = True  # a poll tells late
    reader = start(emulator.port)
    reader.wait_until_reading(stream="polling")
    assert reader.device.diagnostics["clock"] == "right"
    before_ns, after_ns = [], []
    for number in range(16):
        time.sleep(0.013 * (number % 8))  # at any time between two polls
        before_ns.append(time.monotonic_ns())
        emulator.read_tag(epcs[0])
        after_ns.append(time.monotonic_ns())
        wanted = len(reader.samples) + 1
        reader.wait_for(lambda: len(reader.samples) == wanted)  # noqa: B023
    late_ns = [sample.complete_ns - sample.measured_ns for sample in reader.samples]
    assert all(late >= 0 for late in late_ns)
    assert max(late_ns) > 30_000_000  # what the stamps of reception would have been wrong by
    fastest_ns = SECOND_NS
    for before, after, sample in zip(before_ns, after_ns, reader.samples, strict=True):
        fastest_ns = min(fastest_ns, sample.complete_ns - before)
        assert before - CUT_NS < sample.measured_ns < after + fastest_ns + CUT_NS


def test_a_clock_of_1970_that_cannot_be_set_is_told_and_not_believed(
    emulator: Alr9650Emulator, start: Start, epcs: list[str]
) -> None:
    emulator.lacks |= {"time"}
    reader = start(emulator.port)
    reader.wait_until_reading()
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])
    assert reader.samples[0].measured_ns == reader.samples[0].complete_ns
    assert reader.samples[0].reader_ms < 3_600_000
    reader.wait_for(lambda: reader.device.diagnostics["clock"] == "wrong; stamps are the host's")


def test_a_clock_that_is_right_is_left_alone(emulator: Alr9650Emulator, start: Start) -> None:
    emulator.configure(f"set Time = {time.strftime('%Y/%m/%d %H:%M:%S', time.gmtime())}")
    emulator.configure("set TimeZone = 0")
    commands: list[str] = []
    execute = emulator._reader.execute
    emulator._reader.execute = lambda command, now: commands.append(command) or execute(command, now)  # type: ignore[method-assign,func-returns-value]
    reader = start(emulator.port)
    reader.wait_until_reading()
    assert any(command.startswith("get Time") for command in commands)
    assert not any(command.startswith("set Time") for command in commands)

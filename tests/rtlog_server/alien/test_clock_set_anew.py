"""A reader that lost its power has its clock set anew, to whole seconds: reads before and after keep their times."""

import time
from collections.abc import Callable
from typing import Any

from rtlog_server.devices.alien.emulator import Alr9650Emulator

SECOND_NS = 1_000_000_000


def test_reads_keep_their_time_when_the_clock_was_set_anew(
    emulator: Alr9650Emulator, start: Callable[..., Any], epcs: list[str]
) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    ahead = time.gmtime(time.time() + 2)
    emulator.configure(f"set Time = {time.strftime('%Y/%m/%d %H:%M:%S', ahead)}")  # right as far as anybody asks
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])
    emulator.power_off()
    emulator.power_on()
    reader.wait_for(lambda: reader.device.connects >= 2)
    reader.wait_until_reading()
    before_ns = time.monotonic_ns()
    emulator.read_tag(epcs[1])
    reader.wait_for_epc(epcs[1])
    (sample,) = [sample for sample in reader.samples if sample.epc == epcs[1]]
    assert sample.measured_ns >= before_ns - SECOND_NS // 2

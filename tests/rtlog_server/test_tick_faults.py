"""No device delays a tick: while one floods and the others hang, they come one after the other.

By how much they are later than without faults is measured in the long tests.
"""

import threading
from collections.abc import Callable
from itertools import pairwise
from typing import Any

from rtlog_server.messages import OK, decode
from rtlog_server.topics import BY_NAME

Drive = Any  # the fixture of conftest.py
WATCHED_TICKS = 25
GARBAGE = b"\x02\x02\x02\x02\x00\x00\x00\x10sSN LMDscandata 1 1 " * 3000  # telegrams with a wrong checksum
EPC = "E2003411B802011526370494"


def ticks_of(server: Any) -> list[Any]:
    return [decode(sample.payload, BY_NAME["/rtlog/tick"].msgtype) for sample in server.on("rtlog/tick")]


def watch(server: Any) -> list[Any]:
    """Ticks from now on."""
    server.received.clear()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= WATCHED_TICKS)
    return ticks_of(server)


def test_floods_and_hangs_delay_no_tick(start_server: Callable[..., Any], drive: Drive) -> None:
    server = start_server(**drive.places)

    def well() -> bool:
        ticks = ticks_of(server)
        return bool(ticks) and {sensor.state for sensor in ticks[-1].sensors} == {OK}

    server.wait_until(well)
    stopping = threading.Event()
    floods = []

    def flood() -> None:
        while not stopping.wait(0.005):
            drive.laser.send_raw(GARBAGE)
            for _ in range(50):
                drive.read_tag(EPC)
            floods.append(len(GARBAGE))

    flooding = threading.Thread(target=flood)
    for address in drive.TURNS_PER_S:
        drive.encoders.mute(address)
    flooding.start()
    try:
        faulty = watch(server)  # none waits for the end of it
    finally:
        stopping.set()
        flooding.join()
        for address in drive.TURNS_PER_S:
            drive.encoders.mute(address, muted=False)
    assert sum(floods) > 1e6
    assert all(later.index == earlier.index + 1 for earlier, later in pairwise(faulty))
    server.wait_until(well)

"""No device delays a tick: lateness while one floods and the others hang, beside the same server's without faults."""

import threading
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from rtlog_server.messages import OK, decode
from rtlog_server.topics import BY_NAME

Drive = Any  # the fixture of conftest.py
WATCHED_TICKS = 25
MOST_DELAY_S = 0.02  # a fifth of a tick; what a flood costs without protection is many ticks
GARBAGE = b"\x02\x02\x02\x02\x00\x00\x00\x10sSN LMDscandata 1 1 " * 3000  # telegrams with a wrong checksum
EPC = "E2003411B802011526370494"


def ticks_of(server: Any) -> list[Any]:
    return [decode(sample.payload, BY_NAME["/rtlog/tick"].msgtype) for sample in server.on("rtlog/tick")]


def watch(server: Any) -> list[Any]:
    """Ticks from now on."""
    server.received.clear()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= WATCHED_TICKS, timeout_s=20)
    return ticks_of(server)


def test_floods_and_hangs_delay_no_tick(start_server: Callable[..., Any], drive: Drive) -> None:
    server = start_server(**drive.places)

    def well() -> bool:
        ticks = ticks_of(server)
        return bool(ticks) and {sensor.state for sensor in ticks[-1].sensors} == {OK}

    server.wait_until(well, timeout_s=20)
    quiet = watch(server)
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
        faulty = watch(server)
    finally:
        stopping.set()
        flooding.join()
        for address in drive.TURNS_PER_S:
            drive.encoders.mute(address, muted=False)
    assert sum(floods) > 1e6
    for ticks in (quiet, faulty):
        assert all(later.index == earlier.index + 1 for earlier, later in pairwise(ticks))
    quiet_s, faulty_s = (np.array([tick.lateness for tick in ticks]) for ticks in (quiet, faulty))
    assert np.quantile(faulty_s, 0.9) < np.quantile(quiet_s, 0.9) + MOST_DELAY_S
    server.wait_until(well, timeout_s=20)

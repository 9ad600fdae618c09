"""How much later ticks are while one device floods and the others hang than they were before, on the same server."""

import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hw_profiles.profile import load_profile
from rtlog_client.log_file import read_messages
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.devices.sei.emulator import SeiBusEmulator
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import TICK

WATCHED_S = 10.0
MOST_DELAY_S = 0.02  # a fifth of a tick; what a flood costs without protection is many ticks
GARBAGE = b"\x02\x02\x02\x02\x00\x00\x00\x10sSN LMDscandata 1 1 " * 3000  # telegrams with a wrong checksum
EPC = "E2003411B802011526370494"


def test_floods_and_hangs_delay_no_tick(make_rig: Callable[..., Any]) -> None:
    rig = make_rig()
    profile = load_profile(rig.profile)
    stopping, floods = threading.Event(), []
    with (
        Lms111Emulator(port=profile.lasers.primary.device.port) as scanner,
        Alr9650Emulator(port=profile.rfid.device.port) as reader,
        SeiBusEmulator(Path(profile.encoder_bus.port), {5: 4096, 6: 4096}, lambda *_: 0) as encoders,
    ):

        def flood() -> None:
            while not stopping.wait(0.005):
                scanner.send_raw(GARBAGE)
                for _ in range(50):
                    reader.read_tag(EPC)
                floods.append(len(GARBAGE))

        flooding = threading.Thread(target=flood)
        with rig.running() as (server, recorder):
            time.sleep(WATCHED_S)
            for address in (5, 6):
                encoders.mute(address)
            flooded_ns = time.time_ns()
            flooding.start()
            time.sleep(WATCHED_S)
            recorder.popen.send_signal(signal.SIGINT)
            recorder.finish(timeout_s=30)
            stopping.set()
            flooding.join()
            server.popen.terminate()
            server.finish(timeout_s=30)
    ticks = [decode(message.data, message.msgtype) for message in read_messages(rig.folder / "out.mcap", [TICK.name])]
    late_s = np.array([tick.lateness for tick in ticks])
    is_faulty = np.array([to_ns(tick.scheduled) for tick in ticks]) > flooded_ns
    quiet_s, faulty_s = np.quantile(late_s[~is_faulty], 0.9), np.quantile(late_s[is_faulty], 0.9)
    print(f"{sum(floods) / 1e6:.0f} MB; nine of ten ticks late by {1e3 * quiet_s:.2f} ms, then {1e3 * faulty_s:.2f} ms")
    assert sum(floods) > 1e6
    assert is_faulty.sum() > 50
    assert faulty_s < quiet_s + MOST_DELAY_S

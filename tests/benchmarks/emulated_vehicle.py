"""The full suite of a vehicle as emulators in a process of their own: two scanners at 50 Hz, two encoders, a reader.

    with emulated_vehicle(folder) as profile:                 the path of a profile that leads to them
        with running_server(profile) as (process, session):   rtlog-server on it, and a zenoh client of that

Run as a script it is that process: it writes the profile's device addresses to stdout as JSON and ends with its stdin.
"""

import json
import math
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hw_profiles.profile import load_profile

if TYPE_CHECKING:
    import zenoh

RAYS, STEP_RAD = 541, math.radians(0.5)
SCAN_S = 0.02
COUNTS_PER_TURN = 4096
TURNS_PER_S = (0.8, 0.7)
TAG_READ_S = 0.05
PROFILE = """\
schema = 1
name = "full_suite"
tick_period_s = 0.1
vehicle = {{ kinematics = "differential", track_width_m = 1.6 }}
lasers.primary.device = {{ host = "127.0.0.1", port = {primary} }}
lasers.auxiliary.device = {{ host = "127.0.0.1", port = {auxiliary} }}
encoder_bus = {{ kind = "sei", port = "{encoders}" }}
rfid.device = {{ host = "127.0.0.1", port = {rfid} }}
zenoh.listen = ["tcp/127.0.0.1:{zenoh}"]
[[encoders]]
name = "left_wheel"
role = "left_wheel"
wheel_radius_m = 0.35
address = 0
[[encoders]]
name = "right_wheel"
role = "right_wheel"
wheel_radius_m = 0.35
address = 1
"""


@contextmanager
def emulated_vehicle(folder: Path) -> Iterator[Path]:
    """Emulators in another process as long as the context lasts; a profile of them in `folder`."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        zenoh_port = probe.getsockname()[1]
    command = [sys.executable, __file__, str(folder / "sei")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        places = json.loads(process.stdout.readline())
        profile = folder / "full_suite.toml"
        profile.write_text(PROFILE.format(**places, zenoh=zenoh_port))
        yield profile
        process.communicate()


@contextmanager
def running_server(profile: Path) -> Iterator[tuple[subprocess.Popen[bytes], "zenoh.Session"]]:
    """`rtlog-server run` in a process of its own; ended with SIGTERM, as systemd does."""
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps(load_profile(profile).zenoh.listen))
    config.insert_json5("connect/retry", "{ period_init_ms: 50, period_max_ms: 50 }")
    config.insert_json5("connect/timeout_ms", "30000")
    command = [sys.executable, "-m", "rtlog_server.cli", "run", "--profile", str(profile)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            with zenoh.open(config) as session:
                yield process, session
        finally:
            process.terminate()


def ask_status(session: "zenoh.Session") -> dict[str, Any]:
    """What the server answers to `@status`."""
    (reply,) = session.get("rtlog/full_suite/@status", timeout=10.0)
    return json.loads(reply.ok.payload.to_bytes())


def emulate(encoder_link: Path) -> None:
    from rtlog_server.devices.alien.emulator import Alr9650Emulator
    from rtlog_server.devices.lms111.emulator import Lms111Emulator
    from rtlog_server.devices.sei.emulator import SeiBusEmulator

    def counts(address: int, now_ns: int) -> int:
        return round(TURNS_PER_S[address] * COUNTS_PER_TURN * now_ns * 1e-9)

    stopping = threading.Event()
    drawn = np.random.default_rng(1)
    sweeps_m = drawn.uniform(0.5, 15.0, (50, RAYS))
    remission = drawn.uniform(0.0, 60_000.0, RAYS)
    encoders = dict.fromkeys(range(len(TURNS_PER_S)), COUNTS_PER_TURN)
    with (
        Lms111Emulator(serial_no=1) as primary,
        Lms111Emulator(serial_no=2) as auxiliary,
        SeiBusEmulator(encoder_link, encoders, counts),
        Alr9650Emulator() as rfid,
    ):

        def measure() -> None:
            due = next_read = time.monotonic()
            for sweep_m in (sweeps_m[k % len(sweeps_m)] for k in iter(int, 1)):
                due += SCAN_S
                if stopping.wait(max(0.0, due - time.monotonic())):
                    return
                now_ns = time.monotonic_ns()
                for scanner in (primary, auxiliary):
                    scanner.send_scan(sweep_m, now_ns, math.radians(-135), STEP_RAD, remission)
                if due >= next_read:
                    rfid.read_tag("E2003411B802011526370494")
                    next_read += TAG_READ_S

        places = {
            "primary": primary.address[1],
            "auxiliary": auxiliary.address[1],
            "encoders": str(encoder_link),
            "rfid": rfid.port,
        }
        print(json.dumps(places), flush=True)
        measuring = threading.Thread(target=measure)
        measuring.start()
        sys.stdin.read()
        stopping.set()
        measuring.join()


if __name__ == "__main__":
    emulate(Path(sys.argv[1]))

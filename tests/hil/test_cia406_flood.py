"""A hostile CAN bus and the server's ticks: a flood of foreign, garbled and forged frames costs none of them."""

import itertools
import json
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import can
import pytest
import zenoh

from hw_profiles.profile import CanBus, load_profile
from rtlog_server.devices.cia406.emulator import CanBusEmulator

FLOOD_S = 20.0
FRAMES_PER_S = 4000  # as many as 500 kbit/s can carry
BACK_S = 2.0


def flood(bus: CanBus, stopping: threading.Event) -> int:
    """Mostly foreign frames; some are the encoders' own, forged: any data, any length, boot-ups. Returns how many."""
    draw = random.Random(1)
    ours = [service + node for service in (0x80, 0x180, 0x280, 0x580, 0x700) for node in (5, 6)]
    with (
        can.Bus(interface="udp_multicast", channel=bus.channel, port=bus.udp_port, hop_limit=0) as line,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise,
    ):
        noise.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        began = time.monotonic()
        for sent in itertools.count():
            if stopping.is_set():
                return sent
            stopping.wait(max(0.0, began + sent / FRAMES_PER_S - time.monotonic()))
            if sent % 100 == 0:
                noise.sendto(draw.randbytes(draw.randrange(200)), (bus.channel, bus.udp_port))
            can_id = draw.choice(ours) if sent % 20 == 0 else draw.randrange(1, 0x800)
            data = draw.randbytes(draw.randrange(9))
            line.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
    raise AssertionError


def status(session: zenoh.Session) -> dict:
    reply = next(iter(session.get("rtlog/bench/@status", timeout=5.0))).ok
    assert reply is not None
    return json.loads(reply.payload.to_string())


def encoders_are_well(session: zenoh.Session) -> bool:
    encoders = status(session).get("devices", {}).get("encoders", {})
    away = "(node" in encoders.get("message", "")  # a forged emergency stays told: nobody took it back
    return encoders.get("state") == "OK" and not away


def wait_until_well(session: zenoh.Session, limit_s: float) -> float:
    began = time.monotonic()
    while not encoders_are_well(session):
        assert time.monotonic() - began < limit_s, status(session)
        time.sleep(0.05)
    return time.monotonic() - began


@pytest.mark.timeout(120)
def test_a_flood_on_the_bus_costs_no_tick(make_rig: Callable[..., Any]) -> None:
    rig = make_rig(can=True)
    bus = load_profile(rig.profile).encoder_bus
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{rig.endpoint}"]')
    config.insert_json5("connect/timeout_ms", "10000")
    config.insert_json5("scouting/multicast/enabled", "false")
    command = [sys.executable, "-m", "rtlog_server.cli", "run", "--profile", str(rig.profile)]
    stopping = threading.Event()
    sent: list[int] = []
    flooding = threading.Thread(target=lambda: sent.append(flood(bus, stopping)))
    with (
        CanBusEmulator(bus, {5: 4096, 6: 4096}, lambda _node, at_ns: at_ns * 4096 // 10**9),
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as server,
        zenoh.open(config) as session,
    ):
        try:
            wait_until_well(session, 15.0)
            flooding.start()
            time.sleep(FLOOD_S)
            stopping.set()
            flooding.join()
            back_s = wait_until_well(session, BACK_S + 2.0)  # a report is up to a second old, and so is the answer
            told = status(session)
        finally:
            stopping.set()
            server.terminate()
        _, errors = server.communicate(timeout=20)
    ticks, encoders = told["ticks"], told["devices"]["encoders"]
    print(f"{sent[0]} frames in {FLOOD_S:.0f} s; well {back_s:.1f} s after; ticks {ticks['lateness_s']}; {encoders}")
    assert (ticks["overruns"], ticks["dropped"]) == (0, 0)
    assert server.returncode == 0
    assert "fault in the driver" not in errors
    assert "Traceback" not in errors

"""The frame of every driver: a fault in a driver costs a reconnect, not the sensor."""

import logging
import threading
import time

import pytest
from patience import PATIENCE_S, wait_until

from rtlog_server.devices.device import Device, TickGrid
from rtlog_server.messages import MISSING, OK


class FaultyOnce(Device):  # type: ignore[type-arg]
    """Its first read hits a bug of its own; after that it works."""

    def __init__(self) -> None:
        super().__init__("faulty", stale_after_s=5.0)
        self.failed, self.may_return = threading.Event(), threading.Event()

    def connect(self) -> None:
        if self.failed.is_set():
            self.may_return.wait(PATIENCE_S)

    def read(self) -> None:
        if not self.failed.is_set():
            self.failed.set()
            raise ValueError("index of something that is not there")
        self.heard()
        self.pause(0.01)

    def disconnect(self) -> None:
        pass


def test_a_fault_in_a_driver_is_told_and_survived(caplog: pytest.LogCaptureFixture) -> None:
    device = FaultyOnce()
    with caplog.at_level(logging.ERROR):
        device.start(TickGrid(time.monotonic_ns(), 100_000_000))
        try:
            assert device.failed.wait(PATIENCE_S)
            wait_until(lambda: "not there" in device.message)
            assert "fault in the driver" in device.message
            assert device.collect(time.monotonic_ns()).state == MISSING
            device.may_return.set()
            wait_until(lambda: device.collect(time.monotonic_ns()).state == OK)
            assert device.connects == 2
        finally:
            device.close()
    assert "faulty: fault in the driver" in caplog.text

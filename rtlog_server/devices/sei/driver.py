"""The encoders of a vehicle on one SEI bus: asked in one round just before each tick.

In: the bus and its encoders from the profile. Out: an `EncoderReading` a tick.

    start        asked, one after the other      done   tick
      |--- left ---|--- right ---|                 |      |
           ^            ^                          |<4 ms>|
        latched      latched       measured_ns is their mean

When a position was latched: an encoder answers at once with its latest look at the disc, and it looks each 4 ms; so on
the average 2 ms before the request had reached it. The request leaves when it is written; replies may be held up by a
USB adapter, so their arrival says less.
"""

import time
from collections import Counter
from collections.abc import Sequence

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import Device, DeviceError, TickGrid
from rtlog_server.devices.encoders import EncoderReading, Fix, ReadingMaker
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.identity import identify_encoder
from rtlog_server.devices.sei.port import SeiPort

MARGIN_NS = 4_000_000  # from the last reply to the tick
TURNAROUND_NS = 500_000  # first guess of what a reply takes beyond the wire
SMOOTHING = 8  # rounds over which the length of a round is averaged
SILENT_ROUNDS = 5  # without any answer, then the port is opened anew
BAUD_RECOVERY_ASKS = 10  # an encoder that lost its power is at 9600 baud again


class SeiEncoders(Device[EncoderReading]):
    """All US Digital A2 encoders of the bus.

    An encoder that does not answer is asked once more; then it is left out of the readings, named in `message`, and
    asked after each reading until it is back.
    """

    def __init__(self, name: str, bus: SeiBus, encoders: Sequence[Encoder]) -> None:
        super().__init__(name, stale_after_s=0.35)
        self._bus = bus
        self._encoders = list(encoders)
        # A profile with a bus was checked to hold every address.
        self._addresses = {encoder.name: encoder.address or 0 for encoder in self._encoders}
        self._counts_per_turn = {encoder.name: encoder.counts_per_turn for encoder in self._encoders}
        self._multi_turn = bus.turns == "multi"
        self._reply_bytes = protocol.position_reply_bytes(self._multi_turn)
        self._port: SeiPort | None = None
        turns = protocol.TURNS if self._multi_turn else 1
        self._maker = ReadingMaker(encoders, {e.name: e.counts_per_turn * turns for e in encoders})
        self._silent: dict[str, int] = {}  # encoder → how often it was asked in vain
        self._silent_rounds = 0
        self._round_ns = len(self._encoders) * (protocol.wire_ns(1 + self._reply_bytes, bus.baud) + TURNAROUND_NS)
        self._tick_ns = 0
        self._tally: Counter[str] = Counter()
        self._last_garbled = "none"

    def start(self, grid: TickGrid) -> None:
        self._stale_after_ns = max(self._stale_after_ns, 3 * grid.period_ns)
        super().start(grid)

    def connect(self) -> None:
        self._port = SeiPort(self._bus)
        self._port.settle(self._encoders)
        self._silent, self._silent_rounds = {}, 0
        self.identity = {encoder.name: str(identify_encoder(self._port, encoder)) for encoder in self._encoders}

    def read(self) -> None:
        assert self.grid is not None  # set by start()
        lead_ns = self._round_ns + MARGIN_NS
        now_ns = time.monotonic_ns()
        tick_ns = self.grid.next_after(max(now_ns + lead_ns, self._tick_ns))
        wait_s = (tick_ns - lead_ns - now_ns) * 1e-9
        if self.pause(min(wait_s, 0.4)) or wait_s > 0.4:
            return
        self._tick_ns = tick_ns
        assert self._port is not None  # connect() opened it
        self._poll_round(self._port)

    def disconnect(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _poll_round(self, port: SeiPort) -> None:
        started_ns = time.monotonic_ns()
        asked = [name for name in self._addresses if name not in self._silent]
        fixes = self._ask_all(port, asked)
        missed = [name for name in asked if name not in fixes]
        if asked and not missed:
            self._round_ns += (time.monotonic_ns() - started_ns - self._round_ns) // SMOOTHING
        self._tally["retries"] += len(missed)
        fixes |= self._ask_all(port, missed)
        if fixes:
            reading = self._maker.reading(fixes)
            self._tally["doubtful turns"] += len(reading.doubtful)
            self.hand_over(reading)
        self._silent |= {name: 0 for name in missed if name not in fixes}
        self._seek_silent(port)
        self._tell_health(port)
        self._silent_rounds = 0 if len(self._silent) < len(self._addresses) else self._silent_rounds + 1
        if self._silent_rounds >= SILENT_ROUNDS:
            raise DeviceError(f"{self._bus.port}: no encoder answers")

    def _ask_all(self, port: SeiPort, names: Sequence[str]) -> dict[str, Fix]:
        """The positions of those that answered."""
        fixes = {name: self._ask(port, name) for name in names}
        return {name: fix for name, fix in fixes.items() if fix is not None}

    def _ask(self, port: SeiPort, name: str) -> Fix | None:
        request = protocol.position_request(self._addresses[name])
        try:
            exchange = port.exchange(request, self._reply_bytes)
            if not exchange.reply:
                self._tally["timeouts"] += 1
                return None
            raw = protocol.decode_position(exchange.reply, self._counts_per_turn[name], self._multi_turn)
        except protocol.SeiError as error:
            self._tally["garbled"] += 1
            self._last_garbled = f"{name}: {error}"
            return None
        arrived_ns = exchange.sent_ns + protocol.wire_ns(len(request), self._bus.baud)
        return Fix(raw, arrived_ns - protocol.SNAPSHOT_NS // 2, exchange.complete_ns)

    def _seek_silent(self, port: SeiPort) -> None:
        """Ask one of the silent ones a round, the reading being handed over, so that it costs the others nothing."""
        if not self._silent:
            return
        name, asked = next(iter(self._silent.items()))
        del self._silent[name]
        if self._ask(port, name) is not None:
            return
        self._silent[name] = asked + 1  # at the end of the queue
        if self._bus.baud != protocol.POWER_UP_BAUD and (asked + 1) % BAUD_RECOVERY_ASKS == 0:
            port.raise_baud()

    def _tell_health(self, port: SeiPort) -> None:
        self.message = f"no answer from {', '.join(sorted(self._silent))}" if self._silent else "connected"
        self.diagnostics = {
            **{name: "silent" if name in self._silent else "ok" for name in self._addresses},
            **{event: str(self._tally[event]) for event in ("retries", "timeouts", "garbled", "doubtful turns")},
            "last garbled": self._last_garbled,
            "round_ms": f"{self._round_ns * 1e-6:.1f}",
            "echo": "yes" if port.echo else "no",
        }

"""The encoders of a vehicle on one SEI bus: asked in one round just before each tick.

In: the bus and its encoders from the profile. Out: an `EncoderReading` a tick.

    start        asked, one after the other      done   tick
      |--- left ---|--- right ---|                 |      |
           ^            ^                          `round_timing`
        latched      latched       measured_ns is their mean, to which `ReadingMaker` brings the positions

When a position was latched: an encoder answers at once with its latest look at the disc, and it looks each 4 ms; so on
the average 2 ms before the request had reached it. The request leaves when it is written; replies may be held up by a
USB adapter, so their arrival says less. In strobe mode all of them are latched when the strobe has reached them.

The bus takes one question at a time, and no encoder hears the next while another answers: at 9600 baud a round of two
takes 6.3 ms single-turn and 10.4 ms multi-turn, at 115200 a twelfth of that, and the host's delays on top.
"""

import time
from collections import Counter
from collections.abc import Sequence

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.device import DeviceError
from rtlog_server.devices.encoders import EncoderDevice, Fix, ReadingMaker
from rtlog_server.devices.sei import protocol
from rtlog_server.devices.sei.identity import identify_encoder
from rtlog_server.devices.sei.port import SeiPort
from rtlog_server.devices.sei.round_timing import RoundTiming

TURNAROUND_NS = 500_000  # first guess of what a reply takes beyond the wire
EMPTY_ROUNDS = 5  # without any position, then the port is opened anew
BAUD_RECOVERY_ASKS = 5  # an encoder that lost its power is at 9600 baud again
AGREEMENT_TURNS = 0.02  # two answers in one round that differ by less are no noise; at 5 m/s a wheel turns less
EVENTS = ("retries", "timeouts", "garbled", "impossible", "doubtful turns")


class SeiEncoders(EncoderDevice):
    """All US Digital A2 encoders of the bus.

    An encoder that does not answer, or from where its wheel cannot be, is asked once more. One that is silent is then
    left out of the readings, named in `message`, and asked after each reading until it is back.
    """

    def __init__(self, name: str, bus: SeiBus, encoders: Sequence[Encoder]) -> None:
        super().__init__(name)
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
        self._empty_rounds = 0
        wire_ns = protocol.wire_ns(1 + self._reply_bytes, bus.baud)
        self._timing = RoundTiming(len(self._encoders) * (wire_ns + TURNAROUND_NS))
        self._tick_ns = 0
        self._measured_before_ns: int | None = None
        self._tally: Counter[str] = Counter()
        self._last_garbled = self._last_doubtful = "none"

    def connect(self) -> None:
        self._port = SeiPort(self._bus)
        self._port.settle(self._encoders)
        self._silent, self._empty_rounds = {}, 0
        self.identity = {encoder.name: str(identify_encoder(self._port, encoder)) for encoder in self._encoders}

    def read(self) -> None:
        assert self.grid is not None  # set by start()
        lead_ns = self._timing.lead_ns
        now_ns = time.monotonic_ns()
        tick_ns = self.grid.next_after(max(now_ns + lead_ns, self._tick_ns))
        wait_s = (tick_ns - lead_ns - now_ns) * 1e-9
        if self.pause(min(wait_s, 0.4)) or wait_s > 0.4:
            return
        self._tick_ns = tick_ns
        assert self._port is not None  # connect() opened it
        self._poll_round(self._port, tick_ns - lead_ns)

    def disconnect(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _poll_round(self, port: SeiPort, planned_ns: int) -> None:
        strobed_ns = port.strobe() if self._bus.strobe else None
        asked = [name for name in self._addresses if name not in self._silent]
        fixes = {name: self._ask(port, name, strobed_ns) for name in asked}
        again = [name for name, fix in fixes.items() if fix is None or not self._maker.is_possible(name, fix)]
        if len(asked) == len(self._addresses) and not again:
            self._timing.add(planned_ns, time.monotonic_ns())
        self._tally["retries"] += len(again)
        for name in again:
            port.let_pass(self._reply_bytes)
            first, fixes[name] = fixes[name], self._ask(port, name, strobed_ns)
            if first is None and fixes[name] is None:
                self._silent[name] = 0
            elif not self._is_credible(name, first, fixes[name]):
                self._tally["impossible"] += 1
                fixes[name] = None
        found = {name: fix for name, fix in fixes.items() if fix is not None}
        if found:
            self._hand_over(found)
        heard = self._seek_silent(port) or bool(found)
        self._tell_health(port)
        self._empty_rounds = 0 if heard else self._empty_rounds + 1
        if self._empty_rounds >= EMPTY_ROUNDS:
            raise DeviceError(f"{self._bus.port}: no encoder answers")

    def _ask(self, port: SeiPort, name: str, strobed_ns: int | None = None) -> Fix | None:
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
        wire_ns = protocol.wire_ns(len(request), self._bus.baud)
        if strobed_ns is not None:
            return Fix(raw, strobed_ns + wire_ns, exchange.complete_ns)
        return Fix(raw, exchange.sent_ns + wire_ns - protocol.SNAPSHOT_NS // 2, exchange.complete_ns)

    def _is_credible(self, name: str, first: Fix | None, second: Fix | None) -> bool:
        """Whether a second answer is possible, or like the first: then the wheel did jump."""
        if second is None or self._maker.is_possible(name, second):
            return second is not None
        counts_per_turn = self._counts_per_turn[name]
        apart = (second.raw - first.raw) % counts_per_turn if first is not None else counts_per_turn // 2
        return min(apart, counts_per_turn - apart) <= AGREEMENT_TURNS * counts_per_turn

    def _hand_over(self, fixes: dict[str, Fix]) -> None:
        reading = self._maker.reading(fixes)
        if reading.doubtful:
            self._tally["doubtful turns"] += len(reading.doubtful)
            gap_s = (reading.measured_ns - (self._measured_before_ns or reading.measured_ns)) * 1e-9
            self._last_doubtful = f"{', '.join(reading.doubtful)}, {gap_s:.1f} s after the reading before"
        self._measured_before_ns = reading.measured_ns
        self.hand_over(reading)

    def _seek_silent(self, port: SeiPort) -> bool:
        """Ask one of the silent ones, once the reading is handed over: that costs the others nothing. Is it back?"""
        if not self._silent:
            return False
        name, asked = next(iter(self._silent.items()))
        del self._silent[name]
        if self._ask(port, name) is not None:
            return True
        self._silent[name] = asked + 1  # at the end of the queue
        if (asked + 1) % BAUD_RECOVERY_ASKS == 0:
            port.recover_baud()
        return False

    def _tell_health(self, port: SeiPort) -> None:
        self.message = f"no answer from {', '.join(sorted(self._silent))}" if self._silent else "connected"
        self.diagnostics = {
            **{name: "silent" if name in self._silent else "ok" for name in self._addresses},
            **{event: str(self._tally[event]) for event in EVENTS},
            "last garbled": self._last_garbled,
            "last doubtful": self._last_doubtful,
            "lead_ms": f"{self._timing.lead_ns * 1e-6:.1f}",
            "echo": "yes" if port.echo else "no",
        }

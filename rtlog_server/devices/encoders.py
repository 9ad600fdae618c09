"""What every encoder driver shares: its frame, the reading, counting on over many turns, and radians.

In: counts within a turn, and when they were latched. Out: `EncoderReading`; wheels count on over many turns, steering
is signed about its zero (`contracts.md`: JointState).

An absolute encoder tells where in its turn a wheel is, not how often it went round. Between two readings the wheel went
on with its speed, give or take what it can accelerate by; of all totals that fit the reading, the nearest to that
prediction is taken. Where the silence was so long that this could be half a turn off, or the nearest total is no
possible movement, the total is *doubtful*: the least movement is taken, and the reading says so.

    counts in the turn    4000 |  64      total = 4096 * turns + counts in the turn
    total                 4000 | 4160     96 onward, not 3936 back

Encoders that are asked one after the other are latched at different moments, and a reading has one stamp: each position
is brought to it by the speed since the encoder's last reading. The counts stay as they were told.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hw_profiles.profile import Encoder
from rtlog_server.devices.device import Device, TickGrid

STALE_S, STALE_TICKS = 0.35, 3  # without a reading, the longer of the two
MAX_SPEED_M_S = 5.0  # of a wheel whose speed is not known yet
MAX_ACCELERATION_M_S2 = 5.0  # more than loose ground lets any wheel brake by; one that spins on it comes out doubtful
MARGIN_TURNS = 0.1  # what the jitter of stamps and speed may add to a movement
MIN_SPEED_AGE_NS = 20_000_000  # over a shorter time the jitter of stamps is most of the speed
MAX_SPEED_AGE_NS = 500_000_000  # over a longer gap two readings tell no speed


@dataclass(frozen=True, slots=True)
class Fix:
    """What one encoder told: counts within its turn, or modulo many turns if it counts turns itself."""

    raw: int
    latched_ns: int  # monotonic
    complete_ns: int


@dataclass(frozen=True, slots=True)
class EncoderReading:
    """All encoders that answered in one round; `names`, `counts` and `positions_rad` run in parallel."""

    measured_ns: int  # monotonic; the mean of the moments at which the positions were latched
    complete_ns: int  # monotonic; when the last answer was in
    names: tuple[str, ...]  # as in the profile
    counts: tuple[int, ...]  # as the encoder counts: wheels over many turns, steering within its turn
    positions_rad: tuple[float, ...]  # at measured_ns; wheels over many turns, steering -π … π; ahead, left positive
    doubtful: tuple[str, ...]  # wheels that may have turned more often since their last reading than `counts` says


class EncoderDevice(Device[EncoderReading]):
    """The frame of every encoder driver: a reading a tick, so how long it may be silent hangs on the period."""

    def __init__(self, name: str) -> None:
        super().__init__(name, STALE_S)

    def start(self, grid: TickGrid) -> None:
        self._stale_after_ns = max(self._stale_after_ns, STALE_TICKS * grid.period_ns)
        super().start(grid)


def nearest_total(raw: int, modulus: int, near: int) -> int:
    """Of all numbers congruent to `raw` modulo `modulus`, the one nearest to `near` (half-turn rule)."""
    return near + (raw - near + modulus // 2) % modulus - modulus // 2


def position_rad(encoder: Encoder, counts: int) -> float:
    """The angle that JointState tells: zero and direction of the profile applied, steering wrapped to -π … π."""
    turned_rad = 2 * math.pi * counts / encoder.counts_per_turn
    sign = -1.0 if encoder.reversed else 1.0
    if encoder.role != "steering":
        return sign * turned_rad
    return sign * math.remainder(turned_rad - math.radians(encoder.zero_deg), 2 * math.pi)


def counts_at(encoder: Encoder, angle_rad: float) -> int:
    """The counts at which `position_rad` tells this angle, the encoder's end of it: steering within its turn."""
    turned_rad = -angle_rad if encoder.reversed else angle_rad
    if encoder.role != "steering":
        return round(turned_rad / (2 * math.pi) * encoder.counts_per_turn)
    turned_rad += math.radians(encoder.zero_deg)
    return round(turned_rad / (2 * math.pi) * encoder.counts_per_turn) % encoder.counts_per_turn


class TurnCounter:
    """Counts one wheel on over many turns.

    Args:
        counts_per_turn: of the encoder.
        modulus: where its readings start again: `counts_per_turn`, or many times that if it counts turns itself.
        wheel_radius_m: tells how fast a wheel of a vehicle can turn.
    """

    def __init__(self, counts_per_turn: int, modulus: int, wheel_radius_m: float) -> None:
        self._counts_per_turn = counts_per_turn
        self._modulus = modulus
        self._counts_per_m = counts_per_turn / (2 * math.pi * wheel_radius_m)
        self._last: tuple[int, int] | None = None  # total, latched_ns
        self._rate: float | None = None  # counts/s
        self._lost = 0  # what an encoder that counts turns forgot when it lost its power

    def count(self, raw: int, latched_ns: int) -> tuple[int, bool]:
        """The total at a reading, and whether it is doubtful; the first reading is its own total."""
        if self._last is None:
            self._last = raw, latched_ns
            return raw, False
        last, last_ns = self._last
        total, ambiguous, possible = self._fit(raw, latched_ns)
        doubtful = ambiguous or not possible
        if doubtful:
            total = nearest_total(raw, self._counts_per_turn, last)
            self._lost = (total - raw) % self._modulus
        elapsed_s = (latched_ns - last_ns) * 1e-9
        # A doubtful movement tells no speed: the prediction would go on with it for ever, a whole turn too fast.
        known = not doubtful and MIN_SPEED_AGE_NS <= latched_ns - last_ns <= MAX_SPEED_AGE_NS
        self._rate = (total - last) / elapsed_s if known else None
        self._last = total, latched_ns
        return total, doubtful

    def is_possible(self, raw: int, latched_ns: int) -> bool:
        """Whether a wheel can have moved there since the last reading; always, if that is long ago."""
        if self._last is None:
            return True
        _, ambiguous, possible = self._fit(raw, latched_ns)
        return ambiguous or possible

    def _fit(self, raw: int, latched_ns: int) -> tuple[int, bool, bool]:
        """The total nearest to the prediction, whether another fits as well, and whether a wheel can get there."""
        assert self._last is not None
        last, last_ns = self._last
        elapsed_s = (latched_ns - last_ns) * 1e-9
        if self._rate is None:
            predicted, reach = last, self._counts_per_m * MAX_SPEED_M_S * elapsed_s
        else:
            predicted = last + round(self._rate * elapsed_s)
            reach = self._counts_per_m * MAX_ACCELERATION_M_S2 * elapsed_s**2 / 2
        total = nearest_total(raw + self._lost, self._modulus, predicted)
        movable = reach + MARGIN_TURNS * self._counts_per_turn
        return total, reach >= self._modulus / 2, abs(total - predicted) <= movable


class ReadingMaker:
    """Makes a reading of the fixes of a round. The wheels count on over a reconnect: they kept their places meanwhile.

    Args:
        encoders: of the profile; readings list them in this order.
        moduli: by name, where the raw counts of each start again.
    """

    def __init__(self, encoders: Sequence[Encoder], moduli: Mapping[str, int]) -> None:
        self._encoders = list(encoders)
        self._moduli: dict[str, int] = {}
        self._counters: dict[str, TurnCounter] = {}
        self._before: dict[str, tuple[float, int]] = {}  # position_rad, latched_ns of the last reading
        for name, modulus in moduli.items():
            self.set_modulus(name, modulus)

    def set_modulus(self, name: str, modulus: int) -> None:
        """An encoder that counts otherwise than before is counted anew."""
        if self._moduli.get(name) == modulus:
            return
        self._moduli[name] = modulus
        self._before.pop(name, None)
        encoder = next(encoder for encoder in self._encoders if encoder.name == name)
        if encoder.role != "steering" and encoder.wheel_radius_m is not None:
            self._counters[name] = TurnCounter(encoder.counts_per_turn, modulus, encoder.wheel_radius_m)

    def is_possible(self, name: str, fix: Fix) -> bool:
        """Whether the encoder can have moved there; if not, the fix is corrupted, or the wheel spins."""
        counter = self._counters.get(name)
        return counter is None or counter.is_possible(fix.raw, fix.latched_ns)

    def reading(self, fixes: Mapping[str, Fix]) -> EncoderReading:
        """The reading of at least one fix; encoders without one are left out."""
        answered = [encoder for encoder in self._encoders if encoder.name in fixes]
        measured_ns = sum(fix.latched_ns for fix in fixes.values()) // len(fixes)
        counts, positions_rad, doubtful = [], [], []
        for encoder in answered:
            fix = fixes[encoder.name]
            total, in_doubt = self._count(encoder, fix)
            counts.append(total)
            if in_doubt:
                doubtful.append(encoder.name)
                self._before.pop(encoder.name, None)  # it tells no speed
            positions_rad.append(self._position_at(encoder, position_rad(encoder, total), fix.latched_ns, measured_ns))
        return EncoderReading(
            measured_ns=measured_ns,
            complete_ns=max(fix.complete_ns for fix in fixes.values()),
            names=tuple(encoder.name for encoder in answered),
            counts=tuple(counts),
            positions_rad=tuple(positions_rad),
            doubtful=tuple(doubtful),
        )

    def _count(self, encoder: Encoder, fix: Fix) -> tuple[int, bool]:
        counter = self._counters.get(encoder.name)
        return counter.count(fix.raw, fix.latched_ns) if counter else (fix.raw % encoder.counts_per_turn, False)

    def _position_at(self, encoder: Encoder, latched_rad: float, latched_ns: int, measured_ns: int) -> float:
        """Where the encoder was at `measured_ns`, a few ms from its latch, by its speed since the last reading."""
        before_rad, before_ns = self._before.get(encoder.name, (latched_rad, latched_ns))
        self._before[encoder.name] = latched_rad, latched_ns
        if not 0 < latched_ns - before_ns <= MAX_SPEED_AGE_NS:
            return latched_rad
        share = (measured_ns - latched_ns) / (latched_ns - before_ns)
        if encoder.role != "steering":
            return latched_rad + share * (latched_rad - before_rad)
        moved_rad = math.remainder(latched_rad - before_rad, 2 * math.pi)
        return math.remainder(latched_rad + share * moved_rad, 2 * math.pi)

"""When positions are latched, and which of them make one reading. No I/O: the driver brings frames and the time.

In: raw positions as they come. Out: the `Fix`es of a tick, all of one moment at SYNC, of neighbouring moments by timer;
and when the driver has something to do next.

    at SYNC    SYNC |--- left - right ---|           tick       by timer   left    left    left |      tick
                 ^                       |<- 4 ms ->|                        right   right      |<4 ms>|
              latched: all encoders at once                                          └─ newest ─┘
"""

from collections.abc import Mapping

from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.encoders import Fix

MARGIN_NS = 4_000_000  # from the last position to the tick
REPLY_NS = 2_000_000  # first guess of what all replies take
SMOOTHING = 8  # rounds over which the time of the replies is averaged
STALE_TIMERS = 3  # a position so many periods of the encoder's timer old is no longer used


class SyncRounds:
    """A SYNC before each tick; the round is over when all have answered who answered the one before.

    Args:
        grid: of the ticks.
        sync_wire_ns: how long a SYNC takes on the wire; it is latched when it is received.
        reply_wire_ns: how long all replies take on the wire.
    """

    def __init__(self, grid: TickGrid, sync_wire_ns: int, reply_wire_ns: int) -> None:
        self._grid = grid
        self._sync_wire_ns = sync_wire_ns
        self._reply_ns = REPLY_NS + reply_wire_ns
        self._patience_ns = grid.period_ns // 2  # for replies
        self._tick_ns = 0
        self._latched_ns: int | None = None  # of the open round
        self._fixes: dict[str, Fix] = {}
        self._awaited: frozenset[str] = frozenset()
        self.answered_twice: set[str] = set()  # in one round: two nodes have one id; whoever told it clears it

    @property
    def lead_ns(self) -> int:
        """From the SYNC to its tick."""
        return self._reply_ns + MARGIN_NS

    def join(self, encoder: str) -> None:
        """The encoder's answers are waited for from the next round on."""
        self._awaited |= {encoder}

    def next_ns(self, now_ns: int) -> int:
        """When `step` has something to do."""
        if self._latched_ns is not None:
            return self._latched_ns + self._patience_ns
        if self._tick_ns <= now_ns:
            self._tick_ns = self._grid.next_after(now_ns + self.lead_ns)
        return self._tick_ns - self.lead_ns

    def step(self, now_ns: int) -> Mapping[str, Fix] | None:
        """What came of a round whose replies are overdue; None: it is time to send SYNC."""
        return None if self._latched_ns is None else self._close(now_ns)

    def sent(self, sent_ns: int) -> None:
        """SYNC went out."""
        self._latched_ns, self._fixes = sent_ns + self._sync_wire_ns, {}

    def add(self, encoder: str, raw: int, arrived_ns: int) -> Mapping[str, Fix] | None:
        """A position; if none is missing any more, the round's."""
        if encoder in self._fixes:
            self.answered_twice.add(encoder)
            return None
        if self._latched_ns is None:
            return None  # too late for its round
        self._fixes[encoder] = Fix(raw, self._latched_ns, arrived_ns)
        if not self._awaited.issubset(self._fixes):
            return None
        self._reply_ns += (arrived_ns - self._latched_ns - self._reply_ns) // SMOOTHING
        return self._close(arrived_ns)

    def _close(self, now_ns: int) -> Mapping[str, Fix]:
        self._latched_ns = None
        self._awaited = frozenset(self._fixes)
        self._tick_ns = self._grid.next_after(max(now_ns + self.lead_ns, self._tick_ns))
        return self._fixes


class TimerRounds:
    """Before each tick the newest position of every encoder, sent by the encoders' own clocks.

    Args:
        grid: of the ticks.
        position_wire_ns: how long a position takes on the wire; it is latched when it leaves.
        timer_ns: the period of the encoders' timers.
    """

    def __init__(self, grid: TickGrid, position_wire_ns: int, timer_ns: int) -> None:
        self._grid = grid
        self._position_wire_ns = position_wire_ns
        self._stale_ns = STALE_TIMERS * timer_ns
        self.answered_twice: set[str] = set()  # stays empty: what comes twice cannot be told from what comes early
        self._tick_ns = 0
        self._newest: dict[str, Fix] = {}

    def join(self, encoder: str) -> None:
        """Nothing is waited for."""

    def next_ns(self, now_ns: int) -> int:
        """When `step` has something to do."""
        if self._tick_ns <= now_ns:
            first_ns = self._stale_ns if self._tick_ns == 0 else 0  # until all have sent a position
            self._tick_ns = self._grid.next_after(now_ns + MARGIN_NS + first_ns)
        return self._tick_ns - MARGIN_NS

    def step(self, now_ns: int) -> Mapping[str, Fix]:
        """The newest position of every encoder that is still alive."""
        self._tick_ns = self._grid.next_after(self._tick_ns)
        return {name: fix for name, fix in self._newest.items() if now_ns - fix.latched_ns <= self._stale_ns}

    def sent(self, sent_ns: int) -> None:
        """No SYNC is sent."""

    def add(self, encoder: str, raw: int, arrived_ns: int) -> None:
        """A position."""
        self._newest[encoder] = Fix(raw, arrived_ns - self._position_wire_ns, arrived_ns)

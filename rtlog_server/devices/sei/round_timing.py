"""When to begin a round of questions so that the last answer is in just before the tick, and seldom after it.

    planned start                           done         tick
      |<------- round, on the average ------->|<- late ->|<- safety
      |<--------------------- lead_ns ------------------>|

In: when rounds were to begin and when they were done. Out: the lead. A reading that comes after its tick is a whole
period old at the next; so the lead follows the slowest of the last rounds, up to a bound, and forgets it slowly.
"""

SMOOTHING = 8  # rounds over which the length of a round is averaged
FORGETTING = 128  # rounds in which the slowest of them loses two thirds of its weight
FIRST_LATE_NS = 2_000_000
MAX_LATE_NS = 8_000_000  # what comes later than this costs its tick
SAFETY_NS = 500_000


class RoundTiming:
    def __init__(self, guessed_round_ns: int) -> None:
        self._round_ns = guessed_round_ns
        self._late_ns = FIRST_LATE_NS

    @property
    def lead_ns(self) -> int:
        """From the planned start of a round to its tick."""
        return self._round_ns + self._late_ns + SAFETY_NS

    def add(self, planned_ns: int, done_ns: int) -> None:
        """A round in which everybody answered at once; the host's own delays count."""
        excess_ns = min(done_ns - planned_ns - self._round_ns, MAX_LATE_NS)
        self._round_ns += excess_ns // SMOOTHING
        self._late_ns = max(excess_ns, self._late_ns - self._late_ns // FORGETTING)

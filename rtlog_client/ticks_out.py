"""The ticks of a recording that came out: when each was, how late, and which are missing.

In: a recording. Out: `TicksOut`, on the whole grid from the first recorded tick to the last; UTC of the server.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError
from rtlog_client.log_file import read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import TICK


@dataclass(frozen=True, slots=True)
class TicksOut:
    first_index: int
    first_ns: int
    period_ns: int
    recorded: NDArray[np.bool_]  # (T,)
    lateness_s: NDArray[np.float64]  # (T,) 0 where not recorded

    @property
    def last_ns(self) -> int:
        return self.at(len(self.recorded) - 1)

    def at(self, position: int) -> int:
        """When the tick at a position of the grid was scheduled; also beyond its ends."""
        return self.first_ns + position * self.period_ns

    def position(self, log_ns: int) -> int:
        """Of the tick at this time."""
        return round((log_ns - self.first_ns) / self.period_ns)

    def first_after(self, times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """(N,) the positions of the first ticks at or after these times; beyond the ends of the grid too."""
        return -((self.first_ns - times_ns) // self.period_ns)

    def index(self, position: int) -> int:
        return self.first_index + position


def read_ticks(recording: Path) -> TicksOut:
    """Raises: BadInputError: it has less than two ticks."""
    rows = []
    for message in read_messages(recording, [TICK.name]):
        tick = decode(message.data, message.msgtype)
        rows.append((tick.index, to_ns(tick.scheduled), tick.lateness))
    if len(rows) < 2:
        raise BadInputError(f"{recording}: {len(rows)} {TICK.name} in it; a recording of our server is wanted here")
    rows.sort()
    (first, first_ns, _), (last, last_ns, _) = rows[0], rows[-1]
    recorded, lateness_s = np.zeros(last - first + 1, np.bool_), np.zeros(last - first + 1)
    positions = np.array([index - first for index, _, _ in rows])
    recorded[positions], lateness_s[positions] = True, [late for _, _, late in rows]
    return TicksOut(first, first_ns, round((last_ns - first_ns) / (last - first)), recorded, lateness_s)

"""Which samples of a topic never came, by their sequence numbers, exactly.

    published   … 11 12 13 14 15 16 17 18 19|       heartbeat: the last was 19
    received          13 14       17                first seen 13: 11 and 12 were before our time
    holes                   15 16    18 19          lost 4

In: sequence numbers of one run of the server as they arrive, in any order, also twice; what the server says was its
last. Out: the holes. A late sample closes its part of a hole, so backfilled ones count as received.
"""

from bisect import bisect_right


class SequenceHoles:
    """The bookkeeping of one topic. What was published before `first` is not ours to miss."""

    def __init__(self, first: int) -> None:
        self.received = 0
        self._first = first
        self._next = first  # one above the highest number known to have been published
        self._holes: list[tuple[int, int]] = []  # ascending, [from, to), none empty, none touching

    def add(self, sequence: int) -> bool:
        """Note a sample; False if it was there already."""
        if sequence >= self._next:
            self.published_up_to(sequence)
        elif sequence < self._first:  # on its way when the heartbeat that told us `first` overtook it
            self._miss(sequence, self._first)
            self._first = sequence
        index = bisect_right(self._holes, sequence, key=lambda hole: hole[0]) - 1
        if index < 0 or sequence >= self._holes[index][1]:
            return False
        start, stop = self._holes[index]
        pieces = [(start, sequence), (sequence + 1, stop)]
        self._holes[index : index + 1] = [piece for piece in pieces if piece[0] < piece[1]]
        self.received += 1
        return True

    def published_up_to(self, last: int) -> None:
        """The server says that it has published `last`: what is missing up to there is a hole."""
        if last >= self._next:
            self._miss(self._next, last + 1)
            self._next = last + 1

    def _miss(self, start: int, stop: int) -> None:
        """A hole below or above all that is known; it grows together with one that it touches."""
        if self._holes and self._holes[-1][1] == start:
            self._holes[-1] = (self._holes[-1][0], stop)
        elif self._holes and self._holes[0][0] == stop:
            self._holes[0] = (start, self._holes[0][1])
        else:
            self._holes.append((start, stop))
            self._holes.sort()

    @property
    def holes(self) -> list[tuple[int, int]]:
        """The missing numbers as ranges, the last number included."""
        return [(start, stop - 1) for start, stop in self._holes]

    @property
    def lost(self) -> int:
        return sum(stop - start for start, stop in self._holes)

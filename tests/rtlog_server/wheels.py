"""Wheels that turn at a steady speed, and when an emulated encoder looked where they were.

What a driver tells is held against what the emulator saw, and when it saw it: however late a busy machine lets either
of them run, a position is one that the encoder had, between the question and the end of the answer.
"""

import math
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence

from rtlog_server.devices.encoders import EncoderReading


class Wheels:
    """The position of each encoder, by address, as an emulator wants it; remembers every look."""

    def __init__(self, turns_per_s: Mapping[int, float], counts_per_turn: int) -> None:
        self._turns_per_s = turns_per_s
        self._counts_per_turn = counts_per_turn
        self._began_ns = time.monotonic_ns()
        self.looks: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)

    def __call__(self, address: int, at_ns: int) -> int:
        """Counts over many turns."""
        total = math.floor((at_ns - self._began_ns) * 1e-9 * self._turns_per_s[address] * self._counts_per_turn)
        self.looks[address].append((total, at_ns))
        return total

    def looked_ns(self, readings: Sequence[EncoderReading], addresses: Mapping[str, int]) -> list[dict[str, int]]:
        """When the encoders looked, by name, for the positions of each reading.

        Raises: AssertionError: an encoder was not there, or a turn was lost and the reading does not say so.
        """
        found, last = [], dict[str, tuple[int, int]]()
        for reading in readings:
            looks = {}
            for name, counts in zip(reading.names, reading.counts, strict=True):
                total, looks[name] = self.look(addresses[name], counts, reading.complete_ns)
                if name in last and name not in reading.doubtful:
                    assert counts - last[name][0] == total - last[name][1]
                last[name] = counts, total
            found.append(looks)
        return found

    def were_at(self, reading: EncoderReading, addresses: Mapping[str, int]) -> bool:
        """Whether the encoders have been there."""
        try:
            return bool(self.looked_ns([reading], addresses))
        except AssertionError:
            return False

    def look(self, address: int, counts: int, until_ns: int) -> tuple[int, int]:
        """The last look that found these counts in the turn: counts over many turns, and when it was.

        Raises: AssertionError: there was none.
        """
        for total, at_ns in reversed(self.looks[address]):
            if at_ns <= until_ns and (total - counts) % self._counts_per_turn == 0:
                return total, at_ns
        raise AssertionError(f"encoder {address} was never at {counts} before {until_ns}")

"""Lots: what is left to chance, drawn from the seed, and from it alone.

In: a world, a run, a seed. Out: generators, one for each purpose; the hazards that strike the run, and when.
"""

import zlib
from dataclasses import dataclass

import numpy as np

from hw_profiles.errors import BadInputError
from processing.simulation.hazards import AnyHazard, Timed
from processing.simulation.world import Run, World


def generator(seed: int, *names: str) -> np.random.Generator:
    """One for each purpose, so that what one draws does not change what another does."""
    return np.random.default_rng([seed, *(zlib.crc32(name.encode()) for name in names)])


@dataclass(frozen=True, slots=True)
class Strike:
    """A hazard as it strikes one run."""

    hazard: AnyHazard
    what: str  # opens a line about it
    generator: np.random.Generator

    def refuse(self, why: str) -> None:
        """There is no room for the hazard. Raises: BadInputError: it names this run; else the run goes without it."""
        if self.hazard.run is not None:
            raise BadInputError(f"{self.what}: {why}")

    def spans_s(self, duration_s: float) -> list[tuple[float, float]]:
        """From when to when the hazard lasts, in seconds since the first tick of a run of this duration."""
        hazard = self.hazard
        assert isinstance(hazard, Timed)
        for_s: float | None = getattr(hazard, "for_s", 0.0)
        if hazard.at_s is not None and hazard.at_s > duration_s:
            self.refuse(f"at_s is {hazard.at_s:g}, and run {hazard.run} lasts {duration_s:.0f} s")
        if for_s is None:
            return [(-np.inf if hazard.at_s is None else hazard.at_s, np.inf)]
        if hazard.at_s is not None:
            return [(hazard.at_s, hazard.at_s + for_s)]
        times: int = getattr(hazard, "times", 1)
        starts_s = np.sort(self.generator.uniform(0.0, max(0.0, duration_s - for_s), times))
        return [(start_s, start_s + for_s) for start_s in starts_s.tolist()]


def strikes_of(world: World, run: Run, seed: int) -> list[Strike]:
    """The hazards that strike a run, each with a generator of its own."""
    return [
        Strike(
            hazard,
            f"world {world.name}: hazards[{index}] ({hazard.kind})",
            generator(seed, run.name, f"hazard {index}"),
        )
        for index, hazard in enumerate(world.hazards)
        if hazard.run in (None, run.name)
    ]

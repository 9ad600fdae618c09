"""Random hazards for a random world: kinds by lot, each with what makes it mild or bad by lot too.

In: how many, a generator, the range of the world's tags. Out: `[[hazards]]` tables for its TOML. What stands in none of
the tables (when, which wheel, which tag) the simulator draws from the world's seed; every hazard strikes every run.
"""

import numpy as np

from processing.simulation.hazards import KINDS


def random_hazards(count: int, rng: np.random.Generator, reach_m: float) -> list[str]:
    """Lines of TOML: so many hazards of as many kinds."""
    lines = []
    for kind in sorted(rng.choice(sorted(KINDS), count, replace=False).tolist()):
        lines += ["[[hazards]]", f'kind = "{kind}"', *_how_bad(kind, rng, reach_m)]
    return lines


def _how_bad(kind: str, rng: np.random.Generator, reach_m: float) -> list[str]:
    def about(key: str, low: float, high: float) -> str:
        return f"{key} = {rng.uniform(low, high):.3f}"

    match kind:
        case "slip" | "slide":
            return [f"times = {rng.integers(1, 7)}", about("for_s", 0.4, 1.5)]
        case "spin":
            return [f"times = {rng.integers(1, 4)}", about("for_s", 0.4, 2.0), about("extra_m_s", 0.3, 2.0)]
        case "stuck":
            return [about("for_s", 2.0, 20.0)]
        case "lost_counts":
            return [about("share", 0.01, 0.2)]
        case "odometry_late" | "scans_late":
            return [about("delay_s", 0.02, 0.1)]
        case "jitter":
            return [about("std_s", 0.005, 0.03)]
        case "odometry_missing" | "scans_missing":
            return [f"times = {rng.integers(1, 4)}", about("for_s", 0.5, 5.0)]
        case "dropouts":
            return [about("share", 0.1, 0.6)]
        case "dust":
            return [about("share", 0.05, 0.3), *[about("for_s", 5.0, 30.0)] * int(rng.integers(2))]
        case "traffic":
            return [f'way = "{rng.choice(["along", "oncoming", "parked"])}"', about("gap_m", 3.0, 10.0)]
        case "changed_walls":
            return [about("length_m", 3.0, 15.0), about("by_m", 0.1, 0.6)]
        case "far_reads":
            return [about("within_m", 3 * reach_m, 4 * reach_m), f"reads = {rng.integers(1, 7)}"]
        case "through_rock":
            return [about("within_m", 1.5 * reach_m, 3 * reach_m), f"reads = {rng.integers(1, 5)}"]
    return []

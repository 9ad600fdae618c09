"""Worlds for benchmarks: a square network of rough drifts, as long as is asked for, with a tag in every drift.

+--t--+--t--+      every line a drift, every t a tag; a run goes to and fro along the rows, or up and down the
t     t     t      columns, and turns at the rim; so every junction is crossed on both of its drifts
+--t--+--t--+
"""

from itertools import pairwise
from pathlib import Path

SPACING_M = 80.0
SPEED_M_S = 2.13


def length_m(blocks: int) -> float:
    return 2 * blocks * (blocks + 1) * SPACING_M


def write_network(path: Path, blocks: int, one_run: bool = False) -> None:
    """A world of blocks × blocks; two runs, along the rows and along the columns, or both one after the other."""
    rows = [(x, y) for y in range(blocks + 1) for x in range(blocks + 1)[:: 1 if y % 2 == 0 else -1]]
    columns = [(x, y) for x in range(blocks + 1) for y in range(blocks + 1)[:: 1 if x % 2 == 0 else -1]]
    if one_run:  # from where the rows end, the columns again
        last = rows[-1]
        columns = (
            columns[::-1] if columns[-1] == last else [(blocks - x if last[0] else x, blocks - y) for x, y in columns]
        )
        runs = {"both": rows + columns[1:]}
    else:
        runs = {"rows": rows, "columns": columns}
    lines = ["schema = 1", f'name = "network{blocks}"', "seed = 5", 'profile = "canmet_trailer"']
    lines += ["[walls]", "roughness_m = 0.2", "correlation_m = 1.8"]
    for k in range(blocks + 1):
        end = SPACING_M * blocks + 8.0
        for points in ([[-8.0, SPACING_M * k], [end, SPACING_M * k]], [[SPACING_M * k, -8.0], [SPACING_M * k, end]]):
            lines += ["[[drifts]]", f"points = {points}", "width_m = 4.8"]
    seen: set[tuple[float, float]] = set()
    for run in runs.values():
        for (x0, y0), (x1, y1) in pairwise(run):
            seen.add(((x0 + x1) / 2 * SPACING_M, (y0 + y1) / 2 * SPACING_M))
    for number, (x, y) in enumerate(sorted(seen)):
        lines += ["[[tags]]", f'epc = "E2003412{number:016d}"', f"at = [{x}, {y}]"]
    for name, run in runs.items():
        waypoints = [[x * SPACING_M, y * SPACING_M] for x, y in run]
        lines += ["[[runs]]", f'name = "{name}"', f"waypoints = {waypoints}", f"speed_m_s = {SPEED_M_S}"]
    lines += ["[noise]", "wheel_radius_error_percent = { left_wheel = 1.0, right_wheel = 0.8 }"]
    lines += ["slip_m_per_sqrt_m = 0.008", "dropped_scan_probability = 0.001"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")

"""What a user should know about a map before trusting it: what atlas.json tells, and whether the map rests on little.

In: what atlas.json holds. Out: lines for `build`, `info` and `report`.
"""

from collections.abc import Iterable, Mapping
from typing import Any

MANY_UNUSED = 0.1  # of the scans of a run: no few of them were dust or traffic


def caveats(document: Mapping[str, Any]) -> dict[str, list[str]]:
    """A line each, by the key of atlas.json: what was not believed, what was left out and why, other remarks."""
    return {
        "convictions": [
            f"run {found['run']}, ticks {found['ticks'][0]} to {found['ticks'][1]}: "
            f"{found['what']} not believed, {found['how_much']}"
            for found in document.get("convictions", [])
            if found["what"] != "tag"  # what is left out says it
        ],
        "left_out": [
            f"{item['what']} is left out of run {item['run']}, ticks {', '.join(map(str, item['ticks']))}: "
            f"{item['reason']}"
            for item in document.get("left_out", [])
        ],
        "remarks": list(document["remarks"]),
    }


def rests_on_little(document: Mapping[str, Any]) -> list[str]:
    """Why the map may be wrong although nothing failed, a phrase each; none where it rests on enough."""
    parts = {edge["part"] for edge in document["edges"]}
    out = [f"{len(parts)} parts that nothing joins"] if len(parts) > 1 else []
    out += [
        f"run {run['id']} has {run['scans_unused']} of {run['scans']} scans unused"
        for run in document["runs"]
        if run.get("scans_unused", 0) > MANY_UNUSED * run.get("scans", 0)
    ]
    for part in sorted(parts):
        out += _hanging_on_one_tag(document, part)
    stretches = sum(found["what"] in ("wheels", "scan") for found in document.get("convictions", []))
    return out + ([f"{stretches} stretch{'es' * (stretches > 1)} not believed"] if stretches else [])


def _hanging_on_one_tag(document: Mapping[str, Any], part: int) -> list[str]:
    """Runs that only one tag joins to the others of their part: without its node they would be a part of their own."""
    runs = list(dict.fromkeys(p["run"] for edge in document["edges"] if edge["part"] == part for p in edge["paths"]))
    passed_by = {node["id"]: {p["run"] for p in node["passes"]} for node in document["nodes"] if node["part"] == part}
    out = []
    for node, joined in passed_by.items():
        groups = _groups(runs, [of for other, of in passed_by.items() if other != node])
        hanging = sorted(groups, key=len, reverse=True)[1:]
        epc = document["nodes"][node]["epc"]
        out += [f"run {', '.join(sorted(group))} hangs on tag {epc} alone" for group in hanging if group & joined]
    return out


def _groups(runs: Iterable[str], meetings: Iterable[set[str]]) -> list[set[str]]:
    """The runs in groups of those that meet, directly or by way of others."""
    groups = [{run} for run in runs]
    for met in meetings:
        apart = [group for group in groups if not group & met]
        groups = [*apart, met.union(*(group for group in groups if group & met))]
    return groups

"""The table that a benchmark prints, and its exit status."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    what: str
    value: float
    unit: str = ""
    most: float | None = None  # the target, from above
    least: float | None = None  # or from below

    @property
    def is_met(self) -> bool:
        return (self.most is None or self.value <= self.most) and (self.least is None or self.value >= self.least)


def report(title: str, figures: list[Figure]) -> int:
    """Print them; 1 where a target is missed, else 0."""
    print(title)
    for figure in figures:
        target = f"at most {figure.most:g}" if figure.most is not None else ""
        target = f"at least {figure.least:g}" if figure.least is not None else target
        verdict = ("pass" if figure.is_met else "FAIL") if target else ""
        print(f"  {figure.what:<58} {figure.value:>10.4g} {figure.unit:<5} {target:<16} {verdict}")
    return int(not all(figure.is_met for figure in figures))

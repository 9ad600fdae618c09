"""What `rtlog-server check` found out of a device: one row of its table. A leaf."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    subject: str  # what was looked at: reachable, identity, rate, clock, window, antenna, bus …
    found: str  # in one line
    well: bool = True
    advice: str = ""  # what to do next

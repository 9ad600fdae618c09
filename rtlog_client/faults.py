"""The fault script of a replay: what goes wrong at the wire, on which device, when and for how long.

    [[fault]]
    device = "laser/primary"     # or laser/auxiliary, encoders, rfid
    kind = "cut"                 # drop, delay, cut, restart, garble, swap
    at_s = 12.5                  # after the start of the drive, on this machine's clock
    for_s = 1.5

| kind | what happens | key of its own |
|---|---|---|
| drop | what the device sends is lost | |
| delay | what the device sends comes `by_s` later | by_s |
| cut | the cable is pulled: nothing passes; a serial port and its name vanish | |
| restart | the device loses its power: connections are reset and refused; it comes back as after any power-up | |
| garble | a `share` of the bytes that the device sends is changed at random; a CAN frame hit so is lost | share |
| swap | the cable is in the socket of the device `other`, and the other way round | other |

In: TOML. Out: a `FaultScript`, checked. The law: a device has one fault at a time.
"""

from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Literal

from msgspec import field

from hw_profiles.errors import BadInputError
from hw_profiles.strict_toml import Record, parse_toml

DeviceName = Literal["laser/primary", "laser/auxiliary", "encoders", "rfid"]
OWN_KEYS = {"delay": "by_s", "garble": "share", "swap": "other"}


class Fault(Record, frozen=True):
    device: DeviceName
    kind: Literal["drop", "delay", "cut", "restart", "garble", "swap"]
    at_s: float
    for_s: float
    by_s: float | None = None
    share: float | None = None
    other: DeviceName | None = None

    @property
    def devices(self) -> tuple[str, ...]:
        """Those that feel it."""
        return (self.device,) if self.other is None else (self.device, self.other)


class FaultScript(Record, frozen=True):
    fault: list[Fault] = field(default_factory=list)
    seed: int = 0  # of what is garbled

    @property
    def devices(self) -> set[str]:
        return {device for fault in self.fault for device in fault.devices}


def load_faults(path: Path) -> FaultScript:
    """Read and check a script. Raises: BadInputError: one line with the file, the fault and what is wrong with it."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else "not UTF-8 text"
        raise BadInputError(f"faults {path}: {reason}") from error
    return parse_faults(text, str(path))


def parse_faults(text: str, source: str) -> FaultScript:
    """Check a script's TOML; `source` names it in errors. Raises: BadInputError."""
    script = parse_toml(text, FaultScript, f"faults {source}")
    for problem in _problems(script):
        raise BadInputError(f"faults {source}: {problem}")
    return script


def check_devices(script: FaultScript, present: Collection[str], profile_name: str) -> None:
    """Raises: BadInputError: a fault is of a device that the profile does not have."""
    for index, fault in enumerate(script.fault):
        for device in fault.devices:
            if device not in present:
                there = ", ".join(sorted(present)) or "none"
                raise BadInputError(
                    f"fault[{index}]: profile {profile_name} has no {device} to emulate; it has {there}"
                )


def _problems(script: FaultScript) -> Iterator[str]:
    for index, fault in enumerate(script.fault):
        where = f"fault[{index}] ({fault.kind})"
        if fault.at_s < 0:
            yield f"{where}: at_s is {fault.at_s}; it must be 0 or more"
        if fault.for_s <= 0:
            yield f"{where}: for_s is {fault.for_s}; it must be above 0"
        for kind, key in OWN_KEYS.items():
            if (getattr(fault, key) is not None) != (fault.kind == kind):
                yield f"{where}: {key} {'is missing' if fault.kind == kind else f'belongs to {kind} only'}"
        if fault.by_s is not None and fault.by_s <= 0:
            yield f"{where}: by_s is {fault.by_s}; it must be above 0"
        if fault.share is not None and not 0 < fault.share <= 1:
            yield f"{where}: share is {fault.share}; it must lie above 0, up to 1"
        if fault.device == fault.other:
            yield f"{where}: a device is not swapped with itself"
    for device in sorted(script.devices):
        own = sorted((fault.at_s, fault.at_s + fault.for_s) for fault in script.fault if device in fault.devices)
        for (_, end_s), (start_s, _) in pairwise(own):
            if start_s < end_s:
                yield f"{device}: a fault begins at {start_s:g} s, before the one before it ends at {end_s:g} s"

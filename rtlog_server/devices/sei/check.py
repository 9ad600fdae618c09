"""Are the encoders on the bus well? In: a bus that nobody has open. Out: rows for the table of `rtlog-server check`."""

from collections.abc import Sequence

from hw_profiles.profile import Encoder, SeiBus
from rtlog_server.devices.sei.identity import EncoderIdentity, identify_bus
from rtlog_server.finding import Finding


def check_bus(bus: SeiBus, encoders: Sequence[Encoder]) -> list[Finding]:
    """Ask every encoder who it is. Raises: DeviceError: the port cannot be opened, or no encoder answers."""
    identities = identify_bus(bus, encoders)
    reachable = Finding("reachable", f"{bus.port}, {bus.baud} baud")
    return [reachable, *(_check_encoder(identity) for identity in identities)]


def _check_encoder(identity: EncoderIdentity) -> Finding:
    subject = f"identity of {identity.name}"
    if identity.status == "ok":
        return Finding(subject, str(identity))
    if identity.status == "silent":
        advice = f"its power and cable; is its address {identity.address:X}?"
    else:
        advice = "counts_per_turn of the profile; the cable, if it comes and goes"
    return Finding(subject, str(identity), False, advice)

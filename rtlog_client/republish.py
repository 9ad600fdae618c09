"""Replay on zenoh: a recording is published again in real time, as if its server stood there.

In: a recording. Out: its messages on zenoh with the contract's keys and attachments, heartbeat, `@profile`, `@status`
and liveliness token. Stamps stay as they were recorded. The run has a boot id of its own and counts its samples anew,
so what was lost when it was recorded is no hole now; its tick indices are the recorded ones.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from uuid import uuid4

import zenoh

from hw_profiles.errors import RTLogError
from hw_profiles.profile import Profile
from rtlog_client.drive_log import Span, read_span
from rtlog_client.log_file import LoggedMessage, read_info, read_messages
from rtlog_server.bundle import Bundle, Sample, ServerInfo
from rtlog_server.messages import decode
from rtlog_server.publish import HEARTBEAT_S, Publisher
from rtlog_server.topics import BY_NAME, TICK

log = logging.getLogger(__name__)

LEAD_S = 2.0  # for listeners to find us before the first tick


@dataclass(frozen=True, slots=True)
class RepublishReport:
    ticks: int
    messages: dict[str, int]  # published, per topic


def republish(
    recording: Path,
    profile: Profile,
    profile_toml: str,
    stopping: threading.Event,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    lead_s: float = LEAD_S,
) -> RepublishReport:
    """Publish until the recording, or the part of it, is over or `stopping` is set. `profile` says where to listen;
    `profile_toml` is served where the recording has no profile of its own.

    Raises:
        BadInputError: no recording, or nothing in that part of it.
        RTLogError: the endpoint cannot be listened on.
    """
    span, recorded = read_span(recording, start_s, duration_s), read_info(recording)
    info = ServerInfo(
        boot_id=uuid4(),
        vehicle=recorded.metadata.get("vehicle", profile.name),
        software=f"rtlog-client replay {version('rtlog')}",
        profile_toml=recorded.profile_toml or profile_toml,
        listen=profile.zenoh.listen,
        started_ns=time.monotonic_ns(),
    )
    try:
        with Publisher(info) as publisher:
            log.info("publishing %s as %s on %s in %g s", recording, info.vehicle, ", ".join(info.listen), lead_s)
            return _publish(recording, span, publisher, round(profile.tick_period_s * 1e9), lead_s, stopping)
    except zenoh.ZError as error:
        raise RTLogError(f"zenoh on {', '.join(info.listen)}: {error}") from error


def _publish(
    recording: Path, span: Span, publisher: Publisher, period_ns: int, lead_s: float, stopping: threading.Event
) -> RepublishReport:
    start_s = next_beat_s = time.monotonic() + lead_s
    published: Counter[str] = Counter()
    ticks = 0
    for log_time_ns, messages in _ticks(recording, span):
        due_s = start_s + (log_time_ns - span.start_ns) * 1e-9
        if stopping.wait(max(0.0, due_s - time.monotonic())):
            break
        index = _tick_index(messages, (log_time_ns - span.first_tick_ns) // period_ns)
        samples = []
        for message in messages:
            samples.append(Sample(message.topic, published[message.topic], message.data))
            published[message.topic] += 1
        publisher.publish(Bundle(index, samples, None))
        ticks += 1
        if time.monotonic() >= next_beat_s:
            publisher.heartbeat()
            next_beat_s += HEARTBEAT_S
    return RepublishReport(ticks, dict(published))


def _ticks(recording: Path, span: Span) -> Iterator[tuple[int, list[LoggedMessage]]]:
    """The messages of the contract's topics that were logged at the same time, the Tick first."""
    known = (
        m for m in read_messages(recording) if m.topic in BY_NAME and span.start_ns <= m.log_time_ns <= span.end_ns
    )
    for log_time_ns, messages in groupby(known, key=lambda message: message.log_time_ns):
        yield log_time_ns, sorted(messages, key=lambda message: message.topic != TICK.name)


def _tick_index(messages: list[LoggedMessage], otherwise: int) -> int:
    first = messages[0]
    return int(decode(first.data, first.msgtype).index) if first.topic == TICK.name else otherwise

"""Audit: does a recording keep the contract, and is anything missing in it?

In: a recording. Out: an `Audit`, one line a topic and one a rule of the contract. Nothing is changed.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hw_profiles.errors import BadInputError
from hw_profiles.profile import parse_profile
from rtlog_client.holes import SequenceHoles
from rtlog_client.log_file import LogInfo, read_info, read_messages
from rtlog_server.messages import decode, to_ns
from rtlog_server.topics import BY_NAME, DIAGNOSTICS, TICK

METADATA_KEYS = ("run_id", "vehicle", "profile", "boot_id", "software")
TOLERANCE_NS = 1_000  # of times that a rule says are equal
OLDEST_SAMPLE_NS = 1_000_000_000  # before its tick
DEFAULT_PERIOD_NS = 100_000_000  # where there is no profile to say it
SHOWN = 3  # examples of what is wrong


@dataclass(frozen=True, slots=True)
class Check:
    rule: str
    ok: bool
    detail: str


@dataclass(frozen=True, slots=True)
class TopicAudit:
    topic: str
    messages: int
    rate_hz: float
    longest_gap_s: float  # between the ticks of two messages
    lost: int


@dataclass(frozen=True, slots=True)
class Audit:
    path: Path
    ok: bool
    topics: list[TopicAudit]
    checks: list[Check]


@dataclass(slots=True)
class _Topic:
    """All messages of a topic."""

    sequences: list[int] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    publish_ns: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)  # of their headers


def audit(path: Path, on_message: Callable[[int], Any] = lambda _: None) -> Audit:
    """Check every message; `on_message` is told how many were read.

    Raises:
        BadInputError: no such file, no MCAP, or cut off.
    """
    info = read_info(path)
    topics: dict[str, _Topic] = {}
    ticks: list[tuple[int, int]] = []  # index, scheduled
    undecodable: list[str] = []
    for count, message in enumerate(read_messages(path), start=1):
        on_message(count)
        topic = topics.setdefault(message.topic, _Topic())
        try:
            content = decode(message.data, message.msgtype)
            stamp_ns = to_ns(content.header.stamp)
        except (ValueError, AttributeError):
            undecodable.append(f"{message.topic} {message.sequence}")
            continue
        topic.sequences.append(message.sequence)
        topic.log_ns.append(message.log_time_ns)
        topic.publish_ns.append(message.publish_time_ns)
        topic.stamps_ns.append(stamp_ns)
        if message.topic == TICK.name:
            ticks.append((content.index, to_ns(content.scheduled)))
    lost = {name: max(_holes(topic.sequences), info.lost.get(name, 0)) for name, topic in topics.items()}
    lost |= {name: count for name, count in info.lost.items() if name not in lost}  # of these, all was lost
    profile_error, period_ns = _profile_of(info)
    facts = [
        *_about_file(path, info, profile_error),
        ("every message decodes as its type says", undecodable),
        *_about_ticks(ticks, period_ns),
        *(fact for name, topic in sorted(topics.items()) for fact in _about_topic(name, topic)),
        ("every message is logged at a tick", _off_the_grid(topics, ticks, period_ns)),
        ("nothing was lost", [f"{count} of {name}" for name, count in sorted(lost.items()) if count]),
    ]
    checks = [Check(rule, not wrong, _examples(wrong)) for rule, wrong in _merged(facts)]
    rows = [_row(name, topics.get(name, _Topic()), lost[name]) for name in sorted(lost)]
    return Audit(path, all(check.ok for check in checks), rows, checks)


Fact = tuple[str, list[str]]  # a rule, and what breaks it


def _merged(facts: list[Fact]) -> list[Fact]:
    """What breaks the same rule in several topics, together."""
    merged: dict[str, list[str]] = {}
    for rule, wrong in facts:
        merged.setdefault(rule, []).extend(wrong)
    return list(merged.items())


def _examples(wrong: list[str]) -> str:
    more = f" and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
    return ", ".join(wrong[:SHOWN]) + more


def _holes(sequences: list[int]) -> int:
    holes = SequenceHoles(min(sequences, default=0))
    for sequence in sequences:
        holes.add(sequence)
    return holes.lost


def _profile_of(info: LogInfo) -> tuple[str, int]:
    """What is wrong with the profile in it, if anything; the tick period in ns."""
    if info.profile_toml is None:
        return "there is none", DEFAULT_PERIOD_NS
    try:
        return "", round(parse_profile(info.profile_toml, "profile.toml").tick_period_s * 1e9)
    except BadInputError as error:
        return str(error), DEFAULT_PERIOD_NS


def _about_file(path: Path, info: LogInfo, profile_error: str) -> Iterator[Fact]:
    yield "metadata `rtlog` is complete", [key for key in METADATA_KEYS if not info.metadata.get(key)]
    yield "profile.toml is there and valid", [profile_error] if profile_error else []
    yield "run_id is the file's stem", [] if info.run_id in (path.stem, path.name.split(".")[0]) else [info.run_id]
    wrong = [t for t, msgtype in info.msgtypes.items() if t in BY_NAME and BY_NAME[t].msgtype != msgtype]
    yield "topics have their types", wrong


def _about_ticks(ticks: list[tuple[int, int]], period_ns: int) -> Iterator[Fact]:
    yield f"{TICK.name} is there", [] if ticks else ["no message"]
    pairs = list(pairwise(sorted(ticks)))
    wrong = [f"{a}→{b}" for (a, _), (b, _) in pairs if b != a + 1]
    yield "tick indices have no gaps", wrong
    wrong = [
        f"{a}→{b}: {(later - earlier) * 1e-9:.6f} s"
        for (a, earlier), (b, later) in pairs
        if abs(later - earlier - (b - a) * period_ns) > TOLERANCE_NS
    ]
    yield f"ticks are {period_ns * 1e-9:g} s apart", wrong


def _off_the_grid(topics: dict[str, _Topic], ticks: list[tuple[int, int]], period_ns: int) -> list[str]:
    if not ticks:
        return []
    first_ns = ticks[0][1]

    def is_off(log_ns: int) -> bool:
        phase_ns = (log_ns - first_ns) % period_ns
        return min(phase_ns, period_ns - phase_ns) > TOLERANCE_NS

    return [
        f"{name} {n}"
        for name, t in sorted(topics.items())
        for n, ns in zip(t.sequences, t.log_ns, strict=True)
        if is_off(ns)
    ]


def _about_topic(name: str, topic: _Topic) -> Iterator[Fact]:
    """In the order of the sequence numbers, which is the order in which they were published."""
    order = np.argsort(np.array(topic.sequences), kind="stable")
    sequence, log_ns, publish_ns, stamp_ns = (
        np.array(column, np.int64)[order]
        for column in (topic.sequences, topic.log_ns, topic.publish_ns, topic.stamps_ns)
    )

    def at(wrong: Any) -> list[str]:
        return [f"{name} {number}" for number in sequence[np.flatnonzero(wrong)]]

    yield "no message is there twice", at(np.diff(sequence, prepend=-1) == 0)
    yield "publish_time is the header's stamp", at(publish_ns != stamp_ns)
    yield "log_time never runs backwards", at(np.diff(log_ns, prepend=log_ns[:1]) < 0)
    yield "stamps never run backwards", at(np.diff(stamp_ns, prepend=stamp_ns[:1]) < 0)
    if name not in (TICK.name, DIAGNOSTICS.name):  # these are made after the tick began
        age_ns = log_ns - stamp_ns
        yield "samples are from just before their tick", at((age_ns < 0) | (age_ns > OLDEST_SAMPLE_NS))


def _row(name: str, topic: _Topic, lost: int) -> TopicAudit:
    ticks_ns = np.sort(np.array(topic.log_ns, np.int64))
    span_s = float(ticks_ns[-1] - ticks_ns[0]) * 1e-9 if len(ticks_ns) else 0.0
    rate_hz = (len(ticks_ns) - 1) / span_s if span_s > 0 else 0.0
    gap_s = float(np.diff(ticks_ns).max(initial=0)) * 1e-9
    return TopicAudit(name, len(ticks_ns), rate_hz, gap_s, lost)

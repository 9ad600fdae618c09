"""The laptop's end of zenoh: find the server, ask it, listen to it. Only this file and republish.py know zenoh.

In: an endpoint. Out: `Arrived`, `Heartbeat` and `Presence` in a queue, in order of arrival. The law: zenoh's threads
only enqueue. What finds the queue full is dropped here, and its sequence number is missed like any other.
"""

import json
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any
from uuid import UUID

import zenoh

from hw_profiles.errors import BadInputError
from rtlog_server.topics import zenoh_key

SEARCH_S = 0.5  # between two looks for a server


@dataclass(frozen=True, slots=True)
class Arrived:
    topic: str
    data: bytes  # CDR
    attachment: bytes


@dataclass(frozen=True, slots=True)
class Heartbeat:
    boot_id: UUID
    last_sequence: dict[str, int]  # per topic that was published at all


@dataclass(frozen=True, slots=True)
class Presence:
    boot_id: UUID
    there: bool


Inbox = queue.Queue[Arrived | Heartbeat | Presence]


def client_config(connect: str) -> zenoh.Config:
    """A peer that connects to one endpoint, again and again if need be, and looks for nobody else."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", json.dumps([connect]))
    config.insert_json5("connect/retry", '{"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}')
    for switch in ("scouting/multicast", "scouting/gossip", "transport/shared_memory"):
        config.insert_json5(f"{switch}/enabled", "false")
    return config


class Link:
    """A zenoh session of the laptop. Raises: BadInputError: the endpoint is none."""

    def __init__(self, connect: str) -> None:
        self._connect = connect
        self._subscribers: list[Any] = []
        try:
            self._session = zenoh.open(client_config(connect))
        except zenoh.ZError as error:
            raise BadInputError(f"{connect}: no zenoh endpoint like tcp/HOST:PORT ({error})") from error

    def find_vehicle(self, wanted: str | None, stopping: threading.Event, tell: Callable[[str], object]) -> str | None:
        """Wait for a server of the vehicle `wanted`, or of the only one there; None if `stopping` comes first.

        Raises:
            BadInputError: `wanted` is None and there are several vehicles.
        """
        told: set[str] | None = None
        while not stopping.is_set():
            replies = self._session.liveliness().get("rtlog/*/@server/*", timeout=SEARCH_S)
            there = {str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None}
            if wanted is None and len(there) > 1:
                raise BadInputError(f"several vehicles are at {self._connect}: {', '.join(sorted(there))}; name one")
            if there and (wanted is None or wanted in there):
                return wanted or there.pop()
            if there != told:
                others = f"; there is {', '.join(sorted(there))}" if there else ""
                tell(f"waiting for a server{f' of {wanted}' if wanted else ''} at {self._connect}{others}")
                told = there
            stopping.wait(SEARCH_S)
        return None

    def ask(self, vehicle: str, name: str, timeout_s: float = 5.0) -> str | None:
        """What the server's queryable `name` answers; None if nobody does in time."""
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            for reply in self._session.get(zenoh_key(vehicle, name), timeout=left_s):
                if reply.ok is not None:
                    return reply.ok.payload.to_string()
            time.sleep(0.05)  # nobody has declared it yet: then get() returns at once
        return None

    def subscribe(self, vehicle: str, inbox: Inbox) -> None:
        """From now on all of the vehicle's topics go into `inbox`, and who serves them."""
        prefix = zenoh_key(vehicle, "")

        def put(item: Arrived | Heartbeat | Presence) -> None:
            try:
                inbox.put_nowait(item)
            except queue.Full:
                return  # the sequence numbers tell

        def arrived(sample: zenoh.Sample) -> None:
            topic = "/" + str(sample.key_expr).removeprefix(prefix)
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            put(Arrived(topic, sample.payload.to_bytes(), attachment))

        def heartbeat(sample: zenoh.Sample) -> None:
            beat = json.loads(sample.payload.to_string())
            put(Heartbeat(UUID(beat["boot_id"]), beat["last_sequence"]))

        def presence(sample: zenoh.Sample) -> None:
            put(Presence(UUID(str(sample.key_expr).rsplit("/", 1)[1]), sample.kind == zenoh.SampleKind.PUT))

        # `**` does not match chunks that start with @. The topics come first: a heartbeat proves that they work.
        # Direct: by default each subscriber calls back from a thread of its own, and a heartbeat overtakes samples.
        direct = [zenoh.handlers.Callback(function, indirect=False) for function in (presence, arrived, heartbeat)]
        self._subscribers = [
            self._session.liveliness().declare_subscriber(f"{prefix}@server/*", direct[0], history=True),
            self._session.declare_subscriber(f"{prefix}**", direct[1]),
            self._session.declare_subscriber(f"{prefix}@heartbeat", direct[2]),
        ]

    def unsubscribe(self) -> None:
        """After this, nothing more comes into the inbox."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers = []

    def close(self) -> None:
        self.unsubscribe()
        self._session.close()

    def __enter__(self) -> "Link":
        return self

    def __exit__(self, _kind: type[BaseException] | None, _value: object, _trace: TracebackType | None) -> None:
        self.close()

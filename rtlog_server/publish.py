"""The publishing process: bundles in from the sampling process, samples out on zenoh. Only this file imports zenoh.

    rtlog/<vehicle>/<topic>              CDR, with an attachment (attachment.py); the Tick of a tick before its sensors
    rtlog/<vehicle>/@server/<boot id>    liveliness token
    rtlog/<vehicle>/@heartbeat           JSON at 1 Hz and at the end: the last numbers, so that a lost tail is noticed
    rtlog/<vehicle>/@profile, @status    queryables: TOML, JSON

The law: no subscriber holds up the others. What a link cannot take is dropped by zenoh, and the sequence numbers show
it. (Blocking puts stand still for seconds when a link is down, and then close it.)
"""

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from queue import SimpleQueue

import zenoh

from rtlog_server.attachment import pack_attachment
from rtlog_server.bundle import Bundle, Report, Sample, ServerInfo
from rtlog_server.health import diagnostics, status
from rtlog_server.messages import encode
from rtlog_server.topics import BY_NAME, DIAGNOSTICS, zenoh_key

HEARTBEAT_S = 1.0
# How long a put waits for a congested link before it drops. With the default of 1 ms a subscriber that is well lost
# 5 % of a burst of 12,000 samples (40 % on a loaded board), with 5 ms none; one that stands still costs 20 ms a tick.
WAIT_BEFORE_DROP_US = 5000


def publish_bundles(connection: Connection, info: ServerInfo) -> None:
    """Publish what comes; returns when the other end of the pipe is closed or its owner died.

    Sends "" when the session is open, or one line that says why zenoh failed, and then returns.
    """
    try:
        with Publisher(info) as publisher:
            _tell(connection, "")
            next_beat = time.monotonic()
            while True:
                if connection.poll(max(0.0, next_beat - time.monotonic())):
                    publisher.publish(connection.recv())
                if time.monotonic() >= next_beat:
                    publisher.heartbeat()
                    next_beat += HEARTBEAT_S
    except (EOFError, ConnectionResetError):
        return  # the sampling process has ended, and all that it sent is out
    except zenoh.ZError as error:
        _tell(connection, f"zenoh on {', '.join(info.listen)}: {error}")


def _tell(connection: Connection, line: str) -> None:
    with suppress(BrokenPipeError):  # the sampling process has ended; what it sent before is still to be published
        connection.send(line)


def server_config(listen: tuple[str, ...]) -> zenoh.Config:
    """A peer that listens where it is told, looks for nobody, and sends everything through the link.

    Shared memory is off: between processes of one host it would go past the congestion control.
    """
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", json.dumps(listen))
    config.insert_json5("transport/link/tx/queue/congestion_control/drop/wait_before_drop", str(WAIT_BEFORE_DROP_US))
    for switch in ("scouting/multicast", "scouting/gossip", "transport/shared_memory"):
        config.insert_json5(f"{switch}/enabled", "false")
    return config


class Publisher:
    """The server's presence on zenoh. Raises: zenoh.ZError: an endpoint cannot be listened on."""

    def __init__(self, info: ServerInfo) -> None:
        self._info = info
        self._report: Report | None = None
        self._last_tick: int | None = None
        self._last_sequence: dict[str, int] = {}
        self._published: Counter[str] = Counter()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._queries: SimpleQueue[tuple[zenoh.Query, str, Callable[[], str]] | None] = SimpleQueue()
        self._session = zenoh.open(server_config(info.listen))
        self._declare_queryable("@profile", lambda: info.profile_toml)
        self._declare_queryable("@status", self._status)
        self._token = self._session.liveliness().declare_token(zenoh_key(info.vehicle, f"@server/{info.boot_id}"))
        self._replier = threading.Thread(target=self._reply, name="replies", daemon=True)
        self._replier.start()

    def publish(self, bundle: Bundle) -> None:
        """Put a tick's samples, and `/diagnostics` if the bundle brings a report."""
        for sample in bundle.samples:
            self._put(bundle.tick, sample)
        self._last_tick = bundle.tick
        if bundle.report is not None:
            data = encode(diagnostics(bundle.report, self._report))
            self._report = bundle.report
            self._put(bundle.tick, Sample(DIAGNOSTICS.name, self._published[DIAGNOSTICS.name], data))

    def heartbeat(self) -> None:
        beat = {
            "boot_id": str(self._info.boot_id),
            "last_tick": self._last_tick,
            "last_sequence": self._last_sequence,
        }
        key = zenoh_key(self._info.vehicle, "@heartbeat")
        self._session.put(key, json.dumps(beat), encoding=zenoh.Encoding.APPLICATION_JSON)

    def _put(self, tick: int, sample: Sample) -> None:
        if sample.topic not in self._publishers:
            self._publishers[sample.topic] = self._session.declare_publisher(
                zenoh_key(self._info.vehicle, sample.topic),
                encoding=zenoh.Encoding.APPLICATION_CDR.with_schema(BY_NAME[sample.topic].msgtype),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
            )
        attachment = pack_attachment(self._info.boot_id, tick, sample.sequence)
        self._publishers[sample.topic].put(sample.data, attachment=attachment)
        self._published[sample.topic] += 1
        self._last_sequence[sample.topic] = sample.sequence

    def _status(self) -> str:
        return json.dumps(status(self._info, self._report, dict(self._published)))

    def _declare_queryable(self, name: str, answer: Callable[[], str]) -> None:
        key = zenoh_key(self._info.vehicle, name)
        self._session.declare_queryable(key, lambda query: self._queries.put((query, key, answer)), complete=True)

    def _reply(self) -> None:
        """A thread of its own: a reply waits for a slow link, and neither zenoh's threads nor the samples may."""
        while (waiting := self._queries.get()) is not None:
            query, key, answer = waiting
            with query:
                query.reply(key, answer())

    def __enter__(self) -> "Publisher":
        return self

    def __exit__(self, *_: object) -> None:
        self.heartbeat()
        self._session.close()


def main() -> None:
    """The publishing process: its argument is the number of the pipe, whose first item is a ServerInfo."""
    connection = Connection(int(sys.argv[1]))
    try:
        info = connection.recv()
    except EOFError:
        return  # the server is gone already
    publish_bundles(connection, info)


if __name__ == "__main__":
    main()

"""Record: what the server publishes, into MCAP files on the laptop's disk, one for each run of the server.

    zenoh's threads ── inbox ──> writer thread: RunLog, sync once a second ──> NAME.mcap.part … NAME.mcap
                                 main thread: shows progress, waits for the end

In: an endpoint and a folder. Out: recordings and their summaries. The law: a recording is finished whatever ends it,
a signal, another run of the server or a disk that fills up; only a disk that fails leaves a part file, for `recover`.
"""

import logging
import queue
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from hw_profiles.errors import BadInputError, RTLogError
from rtlog_client.recorder import POLL_S, Progress, RecordConfig, Recorder, check_disk, recording_paths
from rtlog_client.run_log import RunSummary
from rtlog_client.session import Inbox, Link

log = logging.getLogger(__name__)

INBOX_ITEMS = 10_000  # 4 minutes of a server's samples, while the disk stands still


def record(
    config: RecordConfig, stopping: threading.Event, show: Callable[[Progress], object] = lambda _: None
) -> list[RunSummary]:
    """Record until `stopping` is set or the duration is over.

    Raises:
        BadInputError: the folder, the name, the endpoint or the vehicle is wrong.
        RTLogError: the disk is full, or there was nothing to record.
    """
    check_folder(config)
    with Link(config.connect) as link:
        vehicle = link.find_vehicle(config.vehicle, stopping, log.info)
        if vehicle is None:
            raise RTLogError(f"nothing recorded: no server was found at {config.connect}")
        log.info("recording %s from %s into %s", vehicle, config.connect, config.folder)
        inbox: Inbox = queue.Queue(INBOX_ITEMS)
        recorder = Recorder(config, vehicle, link, inbox)
        link.subscribe(vehicle, inbox)
        with ThreadPoolExecutor(1, "writer") as pool:
            writing = pool.submit(recorder.run)
            shown: Progress | None = None
            try:
                while not (stopping.wait(POLL_S) or writing.done() or recorder.time_is_up()):
                    newest = recorder.progress
                    if newest is not None and newest is not shown:
                        shown = newest
                        show(newest)
                link.unsubscribe()
            finally:
                recorder.ending.set()
            writing.result()
    if not recorder.summaries:
        raise RTLogError(f"nothing recorded: {vehicle} sent no tick")
    return recorder.summaries


def check_folder(config: RecordConfig) -> None:
    """Make the folder, try to write there. Raises: BadInputError, RTLogError."""
    try:
        config.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=config.folder):
            pass
    except OSError as error:
        raise BadInputError(f"{config.folder}: cannot be written: {error.strerror or error}") from error
    taken = [path for path in recording_paths(config.folder, config.name or "") if path.exists()]
    if config.name is not None and taken:
        raise BadInputError(f"{taken[0]} exists already; it is left as it is")
    check_disk(config)

"""What the operator sees while recording: on a terminal one line that is rewritten, elsewhere a line now and then.

12:04:31  3012 ticks  0 lost  scans 10.0 Hz  all sensors OK  tag …3F2A 4 s ago  31.2 MB  free 118 GB
"""

import shutil
import time
from typing import TextIO

from rtlog_client.recorder import Progress
from rtlog_server.health import STATE_NAMES
from rtlog_server.messages import OK

PLAIN_EVERY_S = 10.0  # where it is no terminal: a log file, a unit's journal
CLEAR_LINE = "\r\x1b[K"
EPC_TAIL = 4


def format_progress(progress: Progress) -> str:
    not_ok = [f"{name} {STATE_NAMES[state]}" for name, state in progress.sensors.items() if state != OK]
    tag = "no tag yet"
    if progress.last_tag is not None:
        ago_s = max(0.0, (progress.newest_tick_ns - progress.last_tag.stamp_ns) * 1e-9)
        tag = f"tag …{progress.last_tag.epc[-EPC_TAIL:]} {ago_s:.0f} s ago"
    parts = [
        f"{progress.ticks} ticks",
        f"{progress.lost} lost",
        f"scans {progress.scan_hz:.1f} Hz",
        ", ".join(not_ok) or "all sensors OK",
        tag,
        f"{progress.size_bytes / 1e6:.1f} MB",
        f"free {progress.free_bytes / 1e9:.1f} GB",
    ]
    return "  ".join(parts if progress.there else ["SERVER GONE", *parts])


class LiveLine:
    """Shows progress on `stream`. Anything else that is written there should start with `self.clear`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._terminal = stream.isatty()
        self.clear = CLEAR_LINE if self._terminal else ""
        self._next_s = 0.0

    def show(self, progress: Progress) -> None:
        if not self._terminal and time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + PLAIN_EVERY_S
        line = format_progress(progress)
        if self._terminal:
            self._stream.write(self.clear + line[: shutil.get_terminal_size().columns - 1])
        else:
            self._stream.write(line + "\n")
        self._stream.flush()

"""What every tag reader's driver hands over."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TagSample:
    """Reads of one tag by one antenna that the reader told of at once."""

    measured_ns: int  # monotonic; the last of these reads, by the reader's clock if that is right, else as complete_ns
    complete_ns: int  # monotonic; when the host received it
    epc: str  # upper-case hex, no spaces
    antenna: int  # 0 … 255
    count: int  # reads since the reader last told of this tag, 1 or more
    rssi: float  # as the reader gives it; NaN if it does not
    reader_ms: int | None  # when the reader last saw the tag, by its own clock (ms since 1970)

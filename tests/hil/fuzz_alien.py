"""What a hostile wire says to an ALR-9650 driver, or to the reader itself. With coverage as its guide (atheris).

    python fuzz_alien.py WAY RUNS CORPUS      way: console, lines, reader; corpus: a folder to fill

The law under test: whatever comes, nothing is raised but AlienError, no more than a limit is kept, and a read that is
handed over is whole: hexadecimal EPC, antenna in a byte, one read or more, measured before it was received.
"""

import sys
from contextlib import suppress

import atheris
from fuzzing import fuzz

with atheris.instrument_imports(include=["rtlog_server.devices.alien"]):
    from rtlog_server.devices.alien import protocol
    from rtlog_server.devices.alien.emulated_reader import EmulatedReader
    from rtlog_server.devices.alien.protocol import AlienError
    from rtlog_server.devices.alien.tag_line import TAG_FORMAT, TagRead, format_tag, parse_tag
    from rtlog_server.devices.alien.tag_memory import EARLIEST_S, MAX_TAGS, TagMemory

RECEIVED_NS = 10**15
EARLIEST_NS = int(2 * EARLIEST_S * 1e9)
PIECE = 29
TAG = TagRead("E20000165919007818405C7B", 1, 908, -40.3, 1518784324007, 1518784353958)


def try_lines(data: bytes, memory: TagMemory) -> None:
    """From what is pushed, in pieces and in one, to reads."""
    splitter, lines = protocol.line_splitter(), []
    try:
        for start in range(0, len(data), PIECE):
            lines += splitter.feed(data[start : start + PIECE])
            assert len(splitter.rest) <= protocol.MAX_LINE_BYTES
    except AlienError:
        return
    assert lines == protocol.line_splitter().feed(data)
    for line in lines:
        try_line(line, memory)


def try_line(line: str, memory: TagMemory) -> None:
    with suppress(AlienError):
        tag = parse_tag(line)
        sample = None if tag is None else memory.take(tag, RECEIVED_NS)
        if sample is not None:
            assert int(sample.epc, 16) >= 0
            assert 0 <= sample.antenna <= 255
            assert sample.count >= 1
            assert RECEIVED_NS - EARLIEST_NS <= sample.measured_ns <= sample.complete_ns
    assert len(memory._told) <= MAX_TAGS


def try_console(data: bytes, memory: TagMemory) -> None:
    """From what a console says to replies, prompts, settings and tag lists."""
    with suppress(AlienError):
        for piece in protocol.console_splitter().feed(data):
            protocol.find_prompt(piece)
            if not protocol.is_reply(piece):
                continue
            reply = protocol.clean_reply(piece)
            if not protocol.is_error(reply):
                for line in reply.removeprefix("TagList =").split("\n"):
                    try_line(line, memory)
            with suppress(AlienError):
                name, _ = protocol.parse_setting(reply)
                assert name == name.lower()


def try_reader(data: bytes) -> None:
    """The emulated reader's end: any commands, and a tag that is read between them."""
    reader = EmulatedReader()
    for number, line in enumerate(protocol.Splitter(b"\n", protocol.MAX_LINE_BYTES).feed(data[:4000])):
        reply = reader.execute(line.removeprefix("\x01"), 1000 * number)
        assert protocol.encode_reply(reply).endswith(b"\r\n\0")
        reader.read_tag("E2", 0, -40.0, 1, 1000 * number)
        reader.end_cycle(1000 * number)
        reader.notified_lines(1000 * number)


def samples() -> list[bytes]:
    """Something of each kind that there is."""
    lines = [format_tag(TAG, kind, TAG_FORMAT) for kind in ("TEXT", "TERSE", "CUSTOM")]
    texts = [protocol.GREETING, protocol.READY_PROMPT, protocol.INVALID_LOGIN, protocol.BUSY, protocol.NOT_UNDERSTOOD]
    settings = [
        "ReaderName = Alien",
        "Uptime (secs) = 702048",
        "Time = 1970/01/01 00:00:00",
        "TagList = \r\n" + lines[0],
    ]
    commands = (
        b"\x01set AutoMode = ON\r\nget TagList\r\nset Time = 2026/01/01 00:00:00\r\nClear TagList\r\nNotifyTime=1\r\n"
    )
    switches = (
        b"set TagStreamMode = ON\r\nTagStreamAddress=a:1\r\nset PersistTime = 5\r\nset AcqG2Mask = 1, 2, 3, FF\r\n"
    )
    fields = {"ReaderName": "a", "Time": "1970/03/11 16:06:33.338", "Reason": "TAGS ADDED"}
    pushed = [protocol.encode_notification(fields, lines), "\r\n".join([*lines, ""]).encode()]
    return [*pushed, *(f"{text}\r\n\0".encode() for text in [*texts, *settings, *lines]), commands, switches]


def main(way: str) -> None:
    memory = TagMemory()

    def try_one(data: bytes) -> None:
        if way == "lines":
            try_lines(data, memory)
        elif way == "console":
            try_console(data, memory)
        else:
            with suppress(AlienError):
                try_reader(data)

    fuzz(try_one, samples(), longest=300)


if __name__ == "__main__":
    main(sys.argv[1])

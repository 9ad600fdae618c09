"""The Alien Reader Protocol by example: texts of real readers and of the manual, whole, byte by byte, with a tail."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtlog_server.devices.alien import protocol, tag_line
from rtlog_server.devices.alien.protocol import AlienError, Prompt
from rtlog_server.devices.alien.tag_line import TagRead

SAMPLES = Path(__file__).parents[4] / "shared" / "data" / "alien"

# A line of a reader's tag stream, as quoted in the tests of RfidDotNet (TagStreamParserTests).
STREAM_LINE = "E20000165919007818405C7B;1518784324007;1518784353958;0;-40.3;908"
# Reader Interface Guide 8101938-000 rev 05, p. 53.
TEXT_LINE = "Tag:1115 F268 81C3 C012, Disc:2003/01/21 09:00:51, Last:2003/01/21 09:00:51, Count:4, Ant:0"


@pytest.fixture
def samples() -> dict[str, Any]:
    if not SAMPLES.is_dir():
        pytest.skip(f"{SAMPLES} is not here")
    content: dict[str, Any] = json.loads((SAMPLES / "samples.json").read_text())
    return content


def test_a_custom_line_has_all_fields() -> None:
    tag = TagRead("E20000165919007818405C7B", 0, 908, -40.3, 1518784324007, 1518784353958)
    assert tag_line.parse_tag(STREAM_LINE) == tag
    assert tag_line.format_tag(tag, "CUSTOM", tag_line.TAG_FORMAT) == STREAM_LINE


def test_a_text_line_has_dates_of_the_readers_clock() -> None:
    tag = tag_line.parse_tag(TEXT_LINE)
    assert tag is not None
    assert (tag.epc, tag.count, tag.antenna) == ("1115F26881C3C012", 4, 0)
    assert tag.last_seen_ms == 1_043_139_651_000
    assert math.isnan(tag.rssi)


def test_a_terse_line_is_antenna_and_count_unless_a_zero_says_otherwise() -> None:
    for line, antenna, count in (("1115 F268 81C3 C012,4,0", 0, 4), ("35E4 4B57,0,1", 0, 1), ("35E4 4B57,2,9", 2, 9)):
        tag = tag_line.parse_tag(line)
        assert tag is not None
        assert (tag.antenna, tag.count) == (antenna, count)
        assert tag.last_seen_ms is None


@pytest.mark.parametrize(
    "line", ["", "  ", "#Alien RFID Reader Tag Stream", "(No Tags)", "#Time: 1970/01/01 00:00:00.0"]
)
def test_other_lines_are_no_tags(line: str) -> None:
    assert tag_line.parse_tag(line) is None


@pytest.mark.parametrize(
    "line",
    [
        "XYZ;1;2;0;-40.3;1",
        "E200;1;2;0;-40.3",
        "E200;1;2;256;-40.3;1",
        "E200;1;2;0;-40.3;0",
        "E200;1;2;0;inf;1",
        ";1;2;0;-40.3;1",
        "Tag:1115, Disc:2003/13/21 09:00:51, Count:4",
        "Tag:1115, Last:0000/01/01 09:00:51",
        "Tag:1115, Disc",
        "E200,1",
        "hello",
        "F" * 129 + ";1;2;0;-40.3;1",
    ],
)
def test_what_is_no_tag_is_refused(line: str) -> None:
    with pytest.raises(AlienError, match=r"no tag: "):
        tag_line.parse_tag(line)


def test_the_samples_of_real_readers_are_read(samples: dict[str, Any]) -> None:
    assert samples["custom_k_msec_stream"]["text"] == STREAM_LINE
    assert samples["manual_text_taglist"]["text"] == TEXT_LINE
    message = samples["alr9900plus_notify_text"]["text"].replace("\n", "\r\n").encode() + b"\r\n\0"
    lines = protocol.line_splitter().feed(message)
    tags = [tag for line in lines if (tag := tag_line.parse_tag(line))]
    assert tags == [TagRead("11C400E32A39", 0, 1, tags[0].rssi, 6019593285, 6020253285)]
    for name, value in samples["alr9650_info"]["fields"].items():
        assert protocol.parse_setting(f"{name} = {value}") == (name.lower(), value)


def test_a_real_notification_is_read_however_the_wire_cuts_it(samples: dict[str, Any]) -> None:
    message = (SAMPLES / "alien_notify_alr9800_terse.txt").read_bytes()
    whole = protocol.line_splitter().feed(message)
    slowly = protocol.line_splitter()
    assert [line for byte in message for line in slowly.feed(bytes([byte]))] == whole
    tags = [tag for line in whole if (tag := tag_line.parse_tag(line))]
    assert [(tag.epc, tag.antenna, tag.count) for tag in tags] == [
        ("35E44B573390000A0F29B40A", 0, 1),
        ("35F384108DEE8E8B377EF26D", 0, 1),
        ("35F978ABAAEB521C5CD98367", 0, 1),
        ("35A36B849EF5296EFB159AC5", 0, 1),
    ]


def test_only_nul_ends_a_reply() -> None:
    splitter = protocol.console_splitter()
    assert splitter.feed(b"ReaderName = Alien Reader\r\n") == []
    assert splitter.feed(b"\0TagList = \r\nA\r\nB\r\n\0Rea") == [
        "ReaderName = Alien Reader\r\n",
        "TagList = \r\nA\r\nB\r\n",
    ]
    assert splitter.rest == "Rea"


@pytest.mark.parametrize("make", [protocol.console_splitter, protocol.line_splitter])
def test_what_never_ends_is_refused(make: Any) -> None:
    splitter = make()
    splitter.feed(b"x" * 4000)
    with pytest.raises(AlienError, match="without an end"):
        splitter.feed(b"x" * protocol.MAX_REPLY_BYTES)
    assert splitter.feed(b"y\0") == ["y"]


@pytest.mark.parametrize(
    ("text", "prompt"),
    [
        (protocol.GREETING, Prompt.USERNAME),
        ("***\r\n* Alien Technology : RFID Reader\r\n***\r\n\r\nUsername>", Prompt.USERNAME),
        ("\r\nPassword>", Prompt.PASSWORD),
        ("\r\n\r\nAlien>", Prompt.READY),
        ("Error: Invalid Username and/or Password\r\nUsername>", Prompt.REFUSED),
        ("Reader is busy, please try later.\r\n", Prompt.BUSY),
        ("* Alien Technology", None),
        ("", None),
    ],
)
def test_the_login_dialogue(text: str, prompt: Prompt | None) -> None:
    assert protocol.find_prompt(text) == prompt


def test_commands_ask_for_no_echo() -> None:
    assert protocol.command("get ReaderName") == b"\x01get ReaderName\r\n"
    assert protocol.login_answer("alien") == b"alien\r\n"
    for text in ("a\r\nset AutoMode = OFF", "\0", "ä"):
        with pytest.raises(AlienError, match="printable"):
            protocol.login_answer(text)


def test_replies() -> None:
    assert protocol.parse_setting("notifyMode = On\r\n") == ("notifymode", "On")
    assert protocol.parse_setting("Uptime (secs) = 702048") == ("uptime", "702048")
    assert protocol.parse_setting("AutoTruePause(ms) = 0") == ("autotruepause", "0")
    assert protocol.parse_setting("TagStreamAddress = ") == ("tagstreamaddress", "")
    assert protocol.is_error("Error 1: Command not understood.")
    assert protocol.is_error("Error: Invalid Username and/or Password")
    assert not protocol.is_error("ErrorLog = none")
    assert protocol.clean_reply("Alien>\r\nReaderName = A\r\n") == "ReaderName = A"
    with pytest.raises(AlienError, match="no setting"):
        protocol.parse_setting("Goodbye!")


@given(st.binary(max_size=300))
def test_any_bytes_give_tags_or_an_alien_error(data: bytes) -> None:
    for line in protocol.line_splitter().feed(data):
        protocol.find_prompt(line)
        for parse in (tag_line.parse_tag, protocol.parse_setting):
            try:
                parse(line)
            except AlienError:
                continue


FIELD = st.one_of(st.integers(-5, 10**20).map(str), st.text(alphabet="0123456789ABCDEFabcx:/. -_²", max_size=14))


@given(st.lists(FIELD, min_size=1, max_size=7), st.sampled_from([";", ",", ", Disc:", ", Count:", ", Last:20"]))
def test_near_misses_give_whole_tags_or_an_alien_error(fields: list[str], separator: str) -> None:
    for line in (separator.join(fields), "Tag:" + separator.join(fields)):
        try:
            tag = tag_line.parse_tag(line)
        except AlienError:
            continue
        if tag is not None:
            assert tag.epc == tag.epc.upper()
            int(tag.epc, 16)
            assert 0 <= tag.antenna <= 255
            assert tag.count >= 1


@given(
    st.text(alphabet="0123456789ABCDEF", min_size=1, max_size=128),
    st.integers(0, 255),
    st.integers(1, 10**6),
    st.one_of(st.just(math.nan), st.integers(-990, 0).map(lambda tenths: tenths / 10)),
    st.integers(0, 2**42),
)
def test_what_a_reader_sends_is_read(epc: str, antenna: int, count: int, rssi: float, seen_ms: int) -> None:
    tag = TagRead(epc, antenna, count, rssi, seen_ms, seen_ms)
    custom = tag_line.parse_tag(tag_line.format_tag(tag, "CUSTOM", tag_line.TAG_FORMAT))
    assert repr(custom) == repr(tag)  # NaN is no equal of itself
    text = tag_line.parse_tag(tag_line.format_tag(tag, "TEXT", ""))
    assert text is not None
    assert (text.epc, text.antenna, text.count, text.last_seen_ms) == (epc, antenna, count, seen_ms)


@given(st.binary(max_size=400), st.lists(st.integers(0, 400), max_size=8))
def test_it_makes_no_difference_how_the_wire_cuts(data: bytes, cuts: list[int]) -> None:
    whole, pieces = protocol.line_splitter(), protocol.line_splitter()
    ends = [*sorted(cuts), len(data)]
    lines = [line for start, end in zip([0, *ends], ends, strict=False) for line in pieces.feed(data[start:end])]
    assert lines == whole.feed(data)
    assert pieces.rest == whole.rest

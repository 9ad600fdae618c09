"""Recordings: what goes in comes out, and bad files are named in one line."""

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from hw_profiles.errors import BadInputError
from rtlog_client.log_file import LogWriter, read_info, read_messages
from rtlog_server.messages import TagReads, encode, header
from rtlog_server.topics import TAGS


def write_log(path: Path, count: int = 20) -> None:
    with LogWriter(path, {"vehicle": "v"}, "schema = 1\n") as log:
        for k in range(count):
            log.write(TAGS.name, TAGS.msgtype, encode(TagReads(header(k, ""), [])), k * 10, k)


def test_what_goes_in_comes_out(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    info = read_info(tmp_path / "a.mcap")
    assert info.run_id == "a"
    assert info.metadata["vehicle"] == "v"
    assert info.profile_toml == "schema = 1\n"
    assert info.message_counts == {TAGS.name: 20}
    messages = list(read_messages(tmp_path / "a.mcap"))
    assert [m.log_time_ns for m in messages] == [10 * k for k in range(20)]
    assert [m.sequence for m in messages] == list(range(20))
    assert not list(tmp_path.glob("*.part"))


def test_an_existing_recording_is_left_alone(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    before = (tmp_path / "a.mcap").read_bytes()
    with pytest.raises(BadInputError, match="exists already"):
        write_log(tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == before


def test_bad_files_are_named(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap")
    whole = (tmp_path / "a.mcap").read_bytes()
    for content, word in [(b"", "empty"), (b"hello, this is text", "not an MCAP"), (whole[:-40], "cut off")]:
        (tmp_path / "b.mcap").write_bytes(content)
        with pytest.raises(BadInputError, match=word):
            read_info(tmp_path / "b.mcap")
    with pytest.raises(BadInputError, match="No such file"):
        read_info(tmp_path / "c.mcap")


def test_writer_that_fails_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyError), LogWriter(tmp_path / "a.mcap", {}, None):
        raise KeyError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("index_types", [IndexType.ALL, IndexType.ALL & ~IndexType.MESSAGE])
@pytest.mark.parametrize("topics", [None, ["/b"], ["/b", "/c"], ["/none"]])
def test_messages_of_others_come_in_the_order_of_mcap_s_own_reader(
    tmp_path: Path, index_types: IndexType, topics: list[str] | None
) -> None:
    """Chunks that overlap in time, and equal times; with and without an index of the messages."""
    draw = np.random.default_rng(3)
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=500, compression=CompressionType.ZSTD, index_types=index_types)
        writer.start()
        schema = writer.register_schema("any", "ros2msg", b"")
        channels = [writer.register_channel(name, "cdr", schema) for name in ("/a", "/b", "/c")]
        for k in range(300):
            channel = channels[draw.integers(2 + (k > 250))]
            writer.add_message(channel, int(k // 5 + draw.integers(30)), bytes(20), 7 * k, k)
        writer.finish()
    with (tmp_path / "a.mcap").open("rb") as file:
        expected = [(c.topic, m.log_time, m.sequence) for _, c, m in make_reader(file).iter_messages(topics=topics)]
    found = [(m.topic, m.log_time_ns, m.sequence) for m in read_messages(tmp_path / "a.mcap", topics)]
    assert found == expected
    assert bool(found) == (topics != ["/none"])

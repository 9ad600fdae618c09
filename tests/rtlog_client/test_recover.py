"""Recovery: cut anywhere, everything synced before the cut comes back; the damaged file is left as it is."""

import random
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from hw_profiles.errors import BadInputError, RTLogError
from rtlog_client.log_file import LogWriter, read_info, read_messages
from rtlog_client.recover import RECOVERY_NAME, default_output, recover
from rtlog_server.messages import LaserScan, TagReads, encode, header
from rtlog_server.topics import PRIMARY_SCAN, TAGS

PROFILE = "schema = 1\nname = 'p'\n"
SECONDS, TICKS = 12, 10


def scan(k: int) -> bytes:
    ranges = np.random.default_rng(k).uniform(1, 9, 200).astype(np.float32)
    return encode(LaserScan(header(k, "laser"), -1, 1, 0.01, 0.0, 0.02, 0.1, 20, ranges, np.empty(0, np.float32)))


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[tuple[int, int]]]:
    """The bytes of a recording in the making, and (size, messages in it) after each sync."""
    log = LogWriter(tmp_path_factory.mktemp("part") / "run.mcap", {"vehicle": "v", "boot_id": "b"}, PROFILE)
    synced = []
    for k in range(SECONDS * TICKS):
        log.write(PRIMARY_SCAN.name, PRIMARY_SCAN.msgtype, scan(k), 10 * k, 10 * k - 3 if k else 0)
        log.write(TAGS.name, TAGS.msgtype, encode(TagReads(header(k, ""), [])), 10 * k, k)
        if k % TICKS == TICKS - 1:
            log.sync()
            synced.append((log.part.stat().st_size, 2 * (k + 1)))
    content = log.part.read_bytes()
    log.abandon()
    return content, synced


def test_cut_at_any_byte_gives_back_what_was_synced(tmp_path: Path, part: tuple[bytes, list[tuple[int, int]]]) -> None:
    content, synced = part
    borders = [size + step for size, _ in synced for step in (-1, 0, 1)]
    anywhere = random.Random(1).sample(range(len(content)), 60)
    for cut in sorted(c for c in {*borders, *anywhere} if c <= len(content)):
        damaged = tmp_path / "run.mcap.part"
        damaged.write_bytes(content[:cut])
        promised = max((count for size, count in synced if size <= cut), default=0)
        try:
            recovery = recover(damaged)
        except RTLogError:
            assert promised == 0
            assert list(tmp_path.iterdir()) == [damaged]
            continue
        assert damaged.read_bytes() == content[:cut]
        messages = list(read_messages(recovery.path))
        assert len(messages) == sum(recovery.messages.values())
        assert promised <= len(messages) <= promised + 2 * TICKS  # the last chunk may be whole and its index not
        info = read_info(recovery.path)
        assert (info.profile_toml, info.run_id, info.metadata["boot_id"]) == (PROFILE, "run", "b")
        scans = [m for m in messages if m.topic == PRIMARY_SCAN.name]
        for k, m in enumerate(scans[-3:], start=max(0, len(scans) - 3)):
            expected = (scan(k), 10 * k, 10 * k - 3 if k else 0, k)
            assert (m.data, m.log_time_ns, m.publish_time_ns, m.sequence) == expected
        recovery.path.unlink()


def test_damaged_bytes_cost_their_own_chunk_only(tmp_path: Path, part: tuple[bytes, list[tuple[int, int]]]) -> None:
    content, synced = part
    damaged = tmp_path / "run.mcap"
    for position in random.Random(2).sample(range(len(content)), 120):
        broken = bytearray(content)
        broken[position : position + 30] = bytes(byte ^ 0x5A for byte in broken[position : position + 30])
        damaged.write_bytes(broken)
        recovery = recover(damaged)
        assert recovery.path == tmp_path / "run.recovered.mcap"
        lost = synced[-1][1] - sum(recovery.messages.values())
        assert lost <= 4 * TICKS, f"at byte {position}"  # two chunks where the damage spans their border
        known = {scan(k) for k in range(SECONDS * TICKS)}
        scans = [m.data for m in read_messages(recovery.path) if m.topic == PRIMARY_SCAN.name]
        assert known.issuperset(scans)
        recovery.path.unlink()


def test_damage_is_reported(tmp_path: Path, part: tuple[bytes, list[tuple[int, int]]]) -> None:
    content, synced = part
    broken = bytearray(content)
    broken[synced[3][0] - 2000] ^= 1  # inside the fourth chunk
    (tmp_path / "run.mcap.part").write_bytes(broken[:-100])
    recovery = recover(tmp_path / "run.mcap.part")
    assert recovery.path == tmp_path / "run.mcap"
    assert recovery.damaged_chunks == 1
    assert 0 < recovery.skipped_bytes < 2 * (synced[1][0] - synced[0][0])
    assert not recovery.was_whole
    with recovery.path.open("rb") as file:
        records = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
    assert records[RECOVERY_NAME]["damaged_chunks"] == "1"
    assert records[RECOVERY_NAME]["source"] == "run.mcap.part"


def test_a_whole_recording_comes_out_the_same(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", {}, PROFILE) as log:
        for k in range(30):
            log.write(TAGS.name, TAGS.msgtype, encode(TagReads(header(k, ""), [])), k, k)
    recovery = recover(tmp_path / "a.mcap")
    assert recovery.was_whole
    assert list(read_messages(recovery.path)) == list(read_messages(tmp_path / "a.mcap"))


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("use_chunking", [True, False])
def test_files_of_other_writers(tmp_path: Path, compression: CompressionType, use_chunking: bool) -> None:
    with (tmp_path / "b.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=compression, use_chunking=use_chunking)
        writer.start("other", "somebody")
        channel = writer.register_channel("/text", "json", 0, {"key": "value"})
        for k in range(200):
            writer.add_message(channel, k, b'{"text": "%d"}' % k, k, k)
        writer.finish()
    whole = (tmp_path / "b.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(whole[: len(whole) // 2])
    recovery = recover(tmp_path / "b.mcap", tmp_path / "c.mcap")
    messages = list(read_messages(tmp_path / "c.mcap"))
    assert 10 < len(messages) == recovery.messages["/text"] < 200
    assert [m.sequence for m in messages] == list(range(len(messages)))


def test_nothing_is_overwritten(tmp_path: Path, part: tuple[bytes, list[tuple[int, int]]]) -> None:
    (tmp_path / "run.mcap.part").write_bytes(part[0])
    (tmp_path / "run.mcap").write_bytes(b"mine")
    for output in (None, tmp_path / "run.mcap.part"):
        with pytest.raises(BadInputError, match="exists already"):
            recover(tmp_path / "run.mcap.part", output)
    assert (tmp_path / "run.mcap").read_bytes() == b"mine"
    assert (tmp_path / "run.mcap.part").read_bytes() == part[0]


def test_bad_input_is_named(tmp_path: Path) -> None:
    for content, word in [(b"", "the file is empty"), (b"hello, this is text", "not an MCAP recording")]:
        (tmp_path / "x.mcap").write_bytes(content)
        with pytest.raises(BadInputError, match=word):
            recover(tmp_path / "x.mcap")
    with pytest.raises(BadInputError, match=r"y\.mcap: No such file"):
        recover(tmp_path / "y.mcap")
    with pytest.raises(BadInputError, match="nowhere"):
        recover(tmp_path / "x.mcap", tmp_path / "nowhere" / "z.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["x.mcap"]


def test_output_names() -> None:
    assert default_output(Path("d/run.mcap.part")) == Path("d/run.mcap")
    assert default_output(Path("d/run.mcap")) == Path("d/run.recovered.mcap")

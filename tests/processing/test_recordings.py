"""Which files are one run: parts of a split run are, in any order; everything else is refused by name."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hw_profiles.errors import BadInputError
from processing.build import Config, build
from processing.read_log import read_log
from processing.recordings import group_parts
from rtlog_client.log_file import LogWriter, read_info, read_messages


def cut(source: Path, folder: Path, *cuts_s: float, metadata: dict[str, str] | None = None) -> list[Path]:
    """A recording in parts: they begin when `cuts_s` seconds have passed since it began."""
    info = read_info(source)
    borders = [info.start_ns, *(info.start_ns + int(cut_s * 1e9) for cut_s in cuts_s), info.end_ns + 1]
    parts = []
    for number, (first_ns, last_ns) in enumerate(pairwise(borders)):
        parts.append(folder / f"part{number}.mcap")
        with LogWriter(parts[-1], info.metadata if metadata is None else metadata, info.profile_toml) as log:
            for m in read_messages(source):
                if first_ns <= m.log_time_ns < last_ns:
                    log.write(m.topic, m.msgtype, m.data, m.log_time_ns, m.publish_time_ns, m.sequence)
    return parts


@pytest.fixture(scope="module")
def whole(small_world: Path) -> Path:
    return small_world / "small-back.mcap"


@pytest.fixture(scope="module")
def parts(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return cut(whole, tmp_path_factory.mktemp("parts"), 10.0, 20.02)


def test_parts_of_a_run_are_one_in_any_order(parts: list[Path], small_world: Path) -> None:
    other = small_world / "small-around.mcap"
    assert group_parts([parts[2], other, parts[0], parts[1]]) == [tuple(parts), (other,)]
    assert group_parts([other]) == [(other,)]


def test_a_split_run_reads_as_the_whole_one(parts: list[Path], whole: Path) -> None:
    one, split = read_log(whole), read_log(parts[0], None, parts[1:])
    assert split.run_id == one.run_id == "small-back"
    assert split.ticks == one.ticks == 432
    assert split.sha256 != one.sha256
    for name in ("scan_ticks", "motion_ns", "motion_times", "wheels"):
        assert np.array_equal(getattr(split, name), getattr(one, name)), name
    assert np.array_equal(split.scans.ranges, one.scans.ranges, equal_nan=True)
    assert np.array_equal(split.scans.stamps_ns, one.scans.stamps_ns)
    assert np.array_equal(split.tags.times, one.tags.times)


def test_a_part_that_stands_there_twice_is_named(parts: list[Path], whole: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.mcap"
    link.symlink_to(parts[1])
    with pytest.raises(BadInputError, match=r"part1\.mcap is named twice$"):
        group_parts([parts[0], parts[1], link])
    with pytest.raises(BadInputError, match=r"hold the same time of run small-back; which of them is it\?$"):
        group_parts([parts[2], whole])


@pytest.mark.parametrize("boot", ["", "f4c8a3f6-0000-4000-8000-000000000000"])
def test_two_runs_of_one_name_are_not_taken_for_one(whole: Path, tmp_path: Path, boot: str) -> None:
    info = read_info(whole)
    metadata = {key: value for key, value in info.metadata.items() if key != "boot_id"} | (
        {"boot_id": boot} if boot else {}
    )
    first = cut(whole, tmp_path, 20.0)[0]
    (tmp_path / "other").mkdir()
    second = cut(whole, tmp_path / "other", 20.0, metadata=metadata)[1]
    with pytest.raises(
        BadInputError, match=r"part0\.mcap and .*part1\.mcap are both called run small-back, and are not"
    ):
        group_parts([second, first])


def test_a_split_run_is_mapped_as_the_whole_one(parts: list[Path], whole: Path, tmp_path: Path) -> None:
    one = build([whole], None, Config(), tmp_path / "one.atlas")
    split = build([parts[1], parts[2], parts[0]], None, Config(), tmp_path / "split.atlas")
    assert list(split.trajectories) == ["small-back"]
    for ours, theirs in zip(split.trajectories["small-back"], one.trajectories["small-back"], strict=True):
        assert np.array_equal(ours, theirs)
    assert split.document["edges"] == one.document["edges"]


def test_a_missing_part_is_told(parts: list[Path], tmp_path: Path) -> None:
    lost = build([parts[0], parts[2]], None, Config(), tmp_path / "lost.atlas")
    (gap,) = [line for line in lost.document["remarks"] if "without a scan" in line]
    assert gap.startswith("run small-back moved 2")  # 10 s at 3 m/s at most
    assert "m in 10.2 s without a scan after tick 99" in gap

"""TUM files: what is written is read back, what others write is read, what is wrong is named by its line."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hw_profiles.errors import BadInputError
from processing.geometry import wrap_angle
from processing.tum import read_tum, write_tum


def test_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    stamps = 1_767_592_800_123_456_789 + np.cumsum(rng.integers(1, 10**9, 500))
    poses = np.column_stack([rng.normal(0, 1000, (500, 2)), rng.uniform(-np.pi, np.pi, 500)])
    poses[0, 2], poses[1, 2] = np.pi, -np.pi + 1e-6
    write_tum(tmp_path / "a.tum", stamps, poses)
    stamps_read, poses_read = read_tum(tmp_path / "a.tum")
    assert_array_equal(stamps_read, stamps)  # to the nanosecond, which a float could not hold
    assert_allclose(poses_read[:, :2], poses[:, :2], atol=5.1e-7)
    assert_allclose(wrap_angle(poses_read[:, 2] - poses[:, 2]), 0, atol=5e-9)


def test_the_format_is_that_of_the_benchmark(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", np.array([1_000_000_000_000_000_001]), np.array([[1.5, -2.25, np.pi / 2]]))
    words = (tmp_path / "a.tum").read_text().split(" ")
    assert words[:4] == ["1000000000.000000001", "1.500000", "-2.250000", "0"]  # t x y z
    assert words[4:6] == ["0", "0"]  # qx qy
    assert [float(word) for word in words[6:]] == pytest.approx([np.sqrt(0.5)] * 2)  # qz qw
    assert words[7].endswith("\n")


def test_files_of_others(tmp_path: Path) -> None:
    (tmp_path / "other.tum").write_text(
        "# ground truth\n\n"
        "1305031098 1 2 3 0 0 0 1\n"
        "1305031098.5   4e0 5 -6\t0 0 1 0\n"
        "1.305031098665902000e+09 7 8 9 0 0 0.7071067811865476 0.7071067811865476\n"  # as numpy.savetxt writes it
        "1305031099.1234567891 0 0 0 0 0 -0.7071067811865476 0.7071067811865476"
    )
    stamps, poses = read_tum(tmp_path / "other.tum")
    start = 1305031098 * 10**9
    assert stamps.tolist() == [start, start + 500_000_000, start + 665_902_000, start + 1_123_456_789]
    assert_allclose(poses, [[1, 2, 0], [4, 5, np.pi], [7, 8, np.pi / 2], [0, 0, -np.pi / 2]], atol=1e-12)


def test_an_empty_file_is_an_empty_trajectory(tmp_path: Path) -> None:
    (tmp_path / "empty.tum").write_text("# nothing\n")
    stamps, poses = read_tum(tmp_path / "empty.tum")
    assert (stamps.shape, poses.shape) == ((0,), (0, 3))


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("1 2 3", "3 numbers instead of 8"),
        ("1 2 3 0 0 0 0 1 9", "9 numbers instead of 8"),
        ("1.0 2 3 0 0 0 x 1", "not a number among '1.0 2 3 0 0 0 x 1'"),
        ("half 2 3 0 0 0 0 1", "not a number among"),
        ("nan 2 3 0 0 0 0 1", "not a number among"),
        ("1e40 2 3 0 0 0 0 1", "not a number among"),
        ("1.0 nan 3 0 0 0 0 1", "a pose that is not finite"),
    ],
)
def test_a_malformed_line_is_named(tmp_path: Path, line: str, complaint: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(f"# t x y z qx qy qz qw\n1.0 2 3 0 0 0 0 1\n{line}\n")
    with pytest.raises(BadInputError) as raised:
        read_tum(path)
    assert str(raised.value).startswith(f"{path}, line 3: {complaint}")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"none\.tum: No such file or directory$"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "picture.tum").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(BadInputError, match=r"picture\.tum: not UTF-8 text"):
        read_tum(tmp_path / "picture.tum")

"""A file of an edge is read as it was written, or named as damaged in one line."""

from pathlib import Path

import numpy as np
from numpy.testing import assert_array_equal

from hw_profiles.errors import BadInputError
from processing.edge_arrays import read_edge_arrays


def test_a_changed_byte_anywhere_is_survived_or_named(tmp_path: Path) -> None:
    """In the directory of the zip, in a header, in the compressed numbers."""
    file = tmp_path / "0-1.npz"
    poses = np.random.default_rng(1).normal(size=(30, 3))
    np.savez_compressed(file, poses=poses)
    whole = file.read_bytes()
    refusals = []
    for at in range(len(whole)):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        try:
            assert_array_equal(read_edge_arrays(file, ["poses"])["poses"], poses)
        except BadInputError as error:
            refusals.append(str(error))
    assert len(refusals) > len(whole) // 2
    assert all(line.startswith(f"{file}: ") and "\n" not in line for line in refusals)

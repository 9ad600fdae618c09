"""An edge's npz read back from an atlas: what `edge_files` wrote there, or one line that names the file.

In: the file. Out: the arrays that are asked for.
"""

import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw_profiles.errors import BadInputError


def read_edge_arrays(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """By name. Raises: BadInputError: the file is missing or damaged, or holds no such array."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names}
    except KeyError as error:
        raise BadInputError(f"{path}: {error.args[0]}") from error
    except OSError as error:
        raise BadInputError(f"{path}: {error.strerror or error}") from error
    except (
        ValueError,
        TypeError,
        EOFError,
        NotImplementedError,
        RuntimeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise BadInputError(f"{path}: damaged: {error}") from error

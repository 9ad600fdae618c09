"""Where results go: what is there already is never overwritten."""

import os
from pathlib import Path

from hw_profiles.errors import BadInputError


def refuse_existing(path: Path) -> None:
    """Raises: BadInputError: the atlas exists already, or its folder does not, or may not be written to."""
    try:
        if path.exists() or path.is_symlink():
            raise BadInputError(f"{path} exists already; it is left as it is")
        if not path.parent.is_dir():
            raise BadInputError(f"{path.parent}: no such folder")
    except OSError as error:  # a name that is too long, a folder above that is closed
        raise BadInputError(f"{path}: {error.strerror or error}") from error
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise BadInputError(f"{path.parent}: no permission to write here")

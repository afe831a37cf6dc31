"""A folder that a user named and that appears whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import UserError


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Where to write what shall be in `out`: a folder beside it, under a hidden name until all of it is there.

    What an exception ends is removed; a killed process leaves the hidden folder, and never `out`.

    Raises:
        UserError: `out` is there already, or cannot be written.
    """
    if out.exists() or out.is_symlink():
        raise UserError(f"There is something at {out} already: name a new folder with -o, or remove that one.")
    unfinished = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        unfinished.mkdir(parents=True)
        yield unfinished
        unfinished.rename(out)
    except OSError as error:
        raise UserError(f"Cannot write {out} ({error.strerror or error}): choose another folder with -o.") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)

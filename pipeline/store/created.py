"""A folder that a user named and that appears whole or not at all."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.scratch import scratch


@contextmanager
def new_folder(out: Path, replaces: Callable[[Path], bool] = lambda _: False) -> Iterator[Path]:
    """Where to write what shall be in `out`: a folder beside it, under a hidden name until all of it is there.

    What an exception ends is removed. A killed process leaves `out` as it was, and the hidden folder to the next one
    that writes `out`. A folder that is there makes way for the new one if `replaces` says that it may.

    Raises:
        UserError: `out` is there and stays, or cannot be written.
    """
    there = out.is_symlink() or out.exists()
    if there and (out.is_symlink() or not out.is_dir() or not replaces(out)):
        raise UserError(f"There is something at {out} already: name a new folder with -o, or remove that one.")
    whole = out.absolute()  # `gallery/` and `.` have names
    replaced = whole.with_name(f".{whole.name}.{os.getpid()}.old")
    try:
        whole.parent.mkdir(parents=True, exist_ok=True)
        with scratch(whole.parent, f".{whole.name}.unfinished-") as unfinished:
            yield unfinished
            if there:
                whole.rename(replaced)
            unfinished.rename(whole)
            shutil.rmtree(replaced, ignore_errors=True)
    except OSError as error:
        raise UserError(f"Cannot write {out} ({error.strerror or error}): choose another folder with -o.") from None

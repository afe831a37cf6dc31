"""Outputs that users name: folders, which appear whole or not at all, and single files."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store.scratch import scratch


@contextmanager
def new_folder(out: Path, replaces: Callable[[Path], bool] = lambda _: False) -> Iterator[Path]:
    """Yield a hidden folder beside `out`, which is renamed to `out` when the block ends.

    After an exception it is removed. A killed process leaves `out` as it was, and a hidden folder, which the next
    process that writes `out` removes. An existing folder is replaced, by two renames, if `replaces` returns True for
    it; a process that is killed just between them leaves no `out`.

    Raises:
        UserError: `out` exists and may not be replaced, or cannot be written.
    """
    exists = out.is_symlink() or out.exists()
    if exists and (out.is_symlink() or not out.is_dir() or not replaces(out)):
        raise UserError(f"{out} already exists: name a new folder with -o, or remove that one.")
    whole = out.absolute()  # gives `gallery/` and `.` names
    try:
        whole.parent.mkdir(parents=True, exist_ok=True)
        with scratch(whole.parent, f".{whole.name}.unfinished-") as unfinished:
            yield unfinished
            replaced = unfinished.with_name("replaced")  # removed with what else is left here
            if exists:
                whole.rename(replaced)
            try:
                unfinished.rename(whole)
            except OSError:
                if exists:
                    replaced.rename(whole)
                raise
    except OSError as error:
        raise UserError(f"Cannot write {out} ({error.strerror or error}): choose another folder with -o.") from None


@contextmanager
def writing_to(out: Path) -> Iterator[None]:
    """Create the parent folder of `out`, and report I/O errors of the `with` block, which writes `out`.

    Raises:
        UserError: `out` cannot be written.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise UserError(f"Cannot write {out} ({error.strerror or error}): choose another file with -o.") from None

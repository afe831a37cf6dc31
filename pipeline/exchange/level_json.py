"""Export of a single level as a level file, which the reference and its editor open."""

from pathlib import Path

from levelproof.levelgen.files.entries import LevelFileError
from levelproof.levelgen.files.level_file import LevelFile, write_level_file
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.read.levels import find_level, levels_of, rules_of
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.created import writing_to
from levelproof.pipeline.store.files import replacing


def export(split: Path, level_id: int, out: Path) -> None:
    """Write a level of `split` and the rules that it was played by to `out`; print a line about it.

    Raises:
        UserError: the level does not exist, does not fit in a level file, or the file cannot be written.
        Failure: the split is damaged.
    """
    if out.suffix.lower() != ".json":
        raise UserError(f"Cannot export to {out}: its name must end in .json.")
    prepare_jax()
    manifest, row = find_level(split, level_id)
    file = LevelFile(levels_of(manifest, manifest.table), rules_of(manifest))
    try:
        with writing_to(out), replacing(out) as unfinished:
            write_level_file(file, unfinished)
    except LevelFileError as error:
        raise UserError(f"Cannot export level {level_id} of {split}: {error}.") from None
    print(f"{out}: level {level_id} of size {row['size']}, for Kinetix")

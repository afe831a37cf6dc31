"""The sealed levels, which measure policies and are never trained on: their ids, contents, labels and experts."""

import json
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from levelproof.experts.labels import Label
from levelproof.levelgen.identity.content import VERSION
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.read.select import both
from levelproof.pipeline.words import many

SEALED_IDS = range(2_000_000_000, 2_000_002_048)  # ids of the sealed levels
KNOWN, HASHES = "sealed.json", "sealed_hashes.npy"  # made by manifests/make_sealed.py; hashes: uint8 [level, 16]
LETTERS = {Label.SOLVED: "s", Label.TRIVIAL: "t", Label.UNSOLVABLE: "x", Label.UNSOLVED: "u"}
SUCCESSES = "0123456789abcdefg"  # one character per level: successes in 16 attempts


class KnownSealed(NamedTuple):
    """What is known of the sealed levels of a size, in the order of their ids."""

    solved: Bool[np.ndarray, " level"]  # labelled solved at the largest budget
    successes: dict[str, Int[np.ndarray, " level"]]  # by budget: successes of a level's expert in 16 attempts


@cache
def known_sealed(size: str) -> KnownSealed | None:
    """Return labels and experts' successes of the sealed levels of a size; None if they have no labels."""
    of_size = json.loads(Path(__file__).with_name(KNOWN).read_text())["sizes"].get(size)
    if of_size is None:
        return None
    solved = np.array([*of_size["labels"]]) == LETTERS[Label.SOLVED]
    read = lambda text: np.array([SUCCESSES.index(digit) for digit in text])
    return KnownSealed(solved, {name: read(text) for name, text in of_size["successes"].items()})


@cache
def sealed_hashes() -> frozenset[str]:
    """Return the content hashes of all sealed levels, which identify bit-equal copies whatever their ids."""
    digests = np.load(Path(__file__).with_name(HASHES))
    return frozenset(f"c{VERSION}:{bytes(digest).hex()}" for digest in digests)


def require_not_sealed(split: Path, ids: Int[np.ndarray, " level"], where: str) -> None:
    """Raise UserError if a split has sealed ids among these, which the condition `where` selects."""
    if sealed := int(((ids >= SEALED_IDS.start) & (ids < SEALED_IDS.stop)).sum()):
        raise UserError(
            f"{split} has {many(sealed, 'level')} with ids from {SEALED_IDS.start} to {SEALED_IDS.stop - 1}, which are "
            f'sealed to measure policies: exclude them, as in where="{both(where, f"level_id < {SEALED_IDS.start}")}".'
        )


def without_sealed(place: Path, hashes: Iterable[str], tell: Callable[[str], None]) -> Bool[np.ndarray, " level"]:
    """Return which levels of a split or of files, by content hash, are not copies of sealed ones; report the others."""
    sealed = sealed_hashes()
    usable = np.array([content_hash not in sealed for content_hash in hashes])
    if copies := int((~usable).sum()):
        tell(f"Left out {many(copies, 'level')} of {place}: copies of sealed levels, kept to measure policies.")
    return usable


def require_some_usable(place: Path, usable: Bool[np.ndarray, " level"]) -> None:
    """Raise UserError if all levels are copies of sealed ones."""
    if not usable.any():
        raise UserError(f"{place} has only copies of sealed levels, kept to measure policies: choose others.")

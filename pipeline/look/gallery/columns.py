"""The manifest for the pages of a gallery: columns as numbers, words as places in a list, a page of rows after another.

A number that does not exist is NaN, a word that does not exist is NOTHING.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from levelproof.pipeline.look.gallery.worlds import text_of
from levelproof.pipeline.look.reasons import kind_of_reason
from levelproof.pipeline.store.columns import COLUMNS

PAGE = 8192  # rows
NOTHING = 2**16 - 1  # in place of a word
WORDS = ("label", "label_reason", "witness")
NOT_SHOWN = ("row",)  # numbers that tell where data is
FLAGS = [of.name for of in COLUMNS if pa.types.is_boolean(of.type)]
NUMBERS = [
    of.name
    for of in COLUMNS
    if (pa.types.is_integer(of.type) or pa.types.is_floating(of.type)) and of.name not in NOT_SHOWN
]
READ = [*NUMBERS, *FLAGS, *WORDS]  # columns of the manifest


def worded(column: pa.ChunkedArray | pa.Array, name: str) -> tuple[list[str], np.ndarray]:
    """The words of a column, the most frequent first, and for each row the place of its word."""
    values: list[Any] = column.cast(pa.string()).to_pylist()
    if name in FLAGS:
        values = [None if value is None else {"true": "yes", "false": "no"}[value] for value in values]
    if name == "label_reason":
        values = [kind_of_reason(value) for value in values]
    counts: dict[str, int] = {}
    for value in values:
        if value is not None:
            counts[value] = counts.get(value, 0) + 1
    words = sorted(counts, key=lambda word: (-counts[word], word))[:NOTHING]
    places = dict(zip(words, range(len(words)), strict=True))
    return words, np.array([places.get(value, NOTHING) for value in values], np.uint16)


def number_of(column: pa.ChunkedArray | pa.Array) -> np.ndarray:
    """A column of numbers in as few bits as keep them exact."""
    wide = column.to_numpy().astype(np.float64)
    narrow = wide.astype(np.float32)
    return narrow if np.array_equal(narrow, wide, equal_nan=True) else wide


def columns_of(rows: pa.Table, counted: Mapping[str, np.ndarray]) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """What pages are told of each column, and its values; `counted` are whole numbers beside the manifest's."""
    about, values = [], {}
    for name in [*WORDS, *FLAGS]:
        words, values[name] = worded(rows[name], name)
        about.append({"name": name, "words": words})
    for name in NUMBERS:
        values[name] = number_of(rows[name])
    values |= {name: numbers.astype(np.float32) for name, numbers in counted.items()}
    about += [{"name": name, "bits": 8 * values[name].itemsize} for name in [*NUMBERS, *counted]]
    return about, values


def page_of(values: Mapping[str, np.ndarray], number: int) -> dict[str, str]:
    """The rows of a page, each column as text."""
    here = slice(number * PAGE, (number + 1) * PAGE)
    return {name: text_of(numbers[here]) for name, numbers in values.items()}

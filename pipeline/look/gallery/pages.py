"""The manifest's columns for a gallery, in pages of rows: numbers as floats, words as indices into a list.

A missing number is NaN; a missing word is NOTHING.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from levelproof.pipeline.look.gallery.worlds import encode_array
from levelproof.pipeline.look.reasons import kind_of_reason
from levelproof.pipeline.store.columns import COLUMNS

PAGE = 8192  # rows per page
NOTHING = 2**16 - 1  # index of a missing word
WORDS = ("label", "label_reason", "witness")
NOT_SHOWN = ("row",)  # numbers that only locate data
FLAGS = [field.name for field in COLUMNS if pa.types.is_boolean(field.type)]
NUMBERS = [
    field.name
    for field in COLUMNS
    if (pa.types.is_integer(field.type) or pa.types.is_floating(field.type)) and field.name not in NOT_SHOWN
]
READ = [*NUMBERS, *FLAGS, *WORDS]  # manifest columns


def encode_words(column: pa.ChunkedArray | pa.Array, name: str) -> tuple[list[str], np.ndarray]:
    """List a column's words, most frequent first, and index each row's word in that list."""
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
    indices = dict(zip(words, range(len(words)), strict=True))
    return words, np.array([indices.get(value, NOTHING) for value in values], np.uint16)


def narrow_floats(column: pa.ChunkedArray | pa.Array) -> np.ndarray:
    """Convert numbers to 32-bit floats if that is exact, else to 64-bit ones."""
    wide = column.to_numpy().astype(np.float64)
    narrow = wide.astype(np.float32)
    return narrow if np.array_equal(narrow, wide, equal_nan=True) else wide


def encode_columns(
    rows: pa.Table, counted: Mapping[str, np.ndarray], worded: Mapping[str, Sequence[str]]
) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Describe each column and encode its values.

    `counted` and `worded` are columns of numbers and of words that the manifest lacks.
    """
    about, values = [], {}
    added = {name: pa.array(words) for name, words in worded.items()}
    for name, column in (added | {name: rows[name] for name in (*WORDS, *FLAGS)}).items():
        words, values[name] = encode_words(column, name)
        about.append({"name": name, "words": words})
    for name in NUMBERS:
        values[name] = narrow_floats(rows[name])
    values |= {name: numbers.astype(np.float32) for name, numbers in counted.items()}
    about += [{"name": name, "bits": 8 * values[name].itemsize} for name in [*NUMBERS, *counted]]
    return about, values


def encode_page(values: Mapping[str, np.ndarray], number: int) -> dict[str, str]:
    """Encode a page of rows, each column as a base64 string."""
    here = slice(number * PAGE, (number + 1) * PAGE)
    return {name: encode_array(numbers[here]) for name, numbers in values.items()}

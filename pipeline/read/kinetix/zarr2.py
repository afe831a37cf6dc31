"""Reader and writer of trajectory arrays in zarr format 2, in which zarr-python 3 cannot write structured arrays.

An array is a folder with metadata, `.zarray`, and one file per chunk; a group is a folder with `.zgroup`.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numcodecs.blosc import Blosc

from levelproof.configs.errors import readable
from levelproof.experts.config import RECORD_STEPS

ARRAY, GROUP = ".zarray", ".zgroup"
ROWS = 16  # trajectories per chunk
# Successive steps, 1,487 bytes or more each, are nearly alike, so compression needs blocks of many steps: 256 KiB
# compresses as well as the released data
BLOSC = Blosc(cname="zstd", clevel=3, shuffle=Blosc.NOSHUFFLE, blocksize=1 << 18)
# Limits on files that are read
NUMBER = r"[<|][biuf][1248]"  # dtypes of fields
MAX_TEXT = 2**20  # bytes of metadata
MAX_ROWS = 2**40  # also the limit of other integers in the metadata
MAX_BYTES = 2**30  # per decoded chunk
BLOSC_HEADER = 16  # bytes; incompressible data grows by this much


def write_group(path: Path) -> None:
    """Mark an existing folder as a group."""
    (path / GROUP).write_text(json.dumps({"zarr_format": 2}))


def write_chunk(path: Path, number: int, values: np.ndarray) -> None:
    """Write a chunk (trajectory, time) of at most ROWS trajectories, padded with zeros to ROWS."""
    chunk = np.zeros((ROWS, *values.shape[1:]), values.dtype)
    chunk[: len(values)] = values
    path.mkdir(exist_ok=True)
    (path / f"{number}.0").write_bytes(BLOSC.encode(chunk.view(np.uint8)))


def write_array(path: Path, rows: int, dtype: np.dtype) -> None:
    """Write the metadata of an array, after its chunks."""
    about = {
        "zarr_format": 2,
        "shape": (rows, RECORD_STEPS),
        "chunks": (ROWS, RECORD_STEPS),
        "dtype": [[name, dtype[name].base.str, dtype[name].shape] for name in dtype.names or ()],
        "compressor": BLOSC.get_config(),
        "fill_value": None,
        "order": "C",
        "filters": None,
    }
    (path / ARRAY).write_text(json.dumps(about))


class FormatError(ValueError):
    """A folder has no readable trajectories; the message completes a sentence about the folder."""

    def __str__(self) -> str:
        return readable(super().__str__())


@dataclass(frozen=True)
class StoredArray:
    """An array with checked metadata; its chunks are checked when read."""

    path: Path
    rows: int
    chunks: tuple[int, int]  # trajectories and steps
    dtype: np.dtype  # each field with its own shape
    compressor: dict[str, Any] | None
    suffix: str  # of chunk names: ".0" per extra axis of length 1

    def read(self, first: int, last: int) -> Iterator[tuple[int, int, np.ndarray]]:
        """Yield rows `first` to `last - 1` chunk by chunk: first row, first step, and values (row, step).

        Raises:
            FormatError: there are no such rows; or a chunk is missing or damaged, or its size disagrees with its
                header.
        """
        if not 0 <= first < last <= self.rows:
            raise FormatError(f"its array {self.path.name} has {self.rows:,} rows, so no row {last - 1}")
        rows, steps = self.chunks
        for i, j in product(range(first // rows, -(-last // rows)), range(-(-RECORD_STEPS // steps))):
            low, high = max(first - i * rows, 0), min(last - i * rows, rows)
            yield i * rows + low, j * steps, self._chunk(i, j)[low:high, : RECORD_STEPS - j * steps]

    def _chunk(self, i: int, j: int) -> np.ndarray:
        path, wanted = self.path / f"{i}.{j}{self.suffix}", self.chunks[0] * self.chunks[1] * self.dtype.itemsize
        try:
            if not path.is_file():
                raise FormatError("is missing")
            if path.stat().st_size > wanted + BLOSC_HEADER:
                raise FormatError("is larger than its contents")
            raw = path.read_bytes()
            if self.compressor is not None:
                sizes = [int.from_bytes(raw[at : at + 4], "little") for at in (4, 12)]  # bytes: decoded, encoded
                if sizes != [wanted, len(raw)]:
                    raise FormatError(f"is not the {wanted:,} bytes of its array's chunks")
                raw = BLOSC.decode(raw)
            return np.frombuffer(raw, self.dtype).reshape(self.chunks)
        except FormatError as error:
            raise FormatError(f"its chunk {path} {error}") from None
        except Exception as error:  # codecs raise many kinds
            raise FormatError(f"its chunk {path} is damaged ({type(error).__name__})") from None


def arrays_in(folder: Path) -> list[StoredArray]:
    """List the non-empty arrays of a group, sorted by name.

    Raises:
        FormatError: the folder is not a zarr 2 group, or an array cannot contain trajectories.
    """
    if _metadata(folder / GROUP).get("zarr_format") != 2:
        raise FormatError(f"its {GROUP} is not of zarr format 2")
    paths = sorted(path.parent for path in folder.glob(f"*/{ARRAY}"))
    arrays = [array for array in map(_array, paths) if array.rows]
    if not arrays:
        raise FormatError("it has no trajectories")
    return arrays


def _array(path: Path) -> StoredArray:
    about = _metadata(path / ARRAY)
    refuse = lambda what: FormatError(f"its array {path.name} {what}")
    try:
        shape, chunks, compressor = about["shape"], about["chunks"], about["compressor"]
        dtype = _dtype(about["dtype"])
        good = all(type(n) is int and 0 <= n <= MAX_ROWS for n in (*shape, *chunks)) and 0 not in chunks
        if not good or len(shape) != len(chunks) or list(shape[1:]) not in ([RECORD_STEPS], [RECORD_STEPS, 1]):
            raise refuse(f"has the shape {str(shape)[:40]}, but must have (trajectories, {RECORD_STEPS})")
        if len(shape) == 2:  # the extra axis is the first of every field
            fields = {name: dtype[name] for name in dtype.names or ()}
            if any(field.shape[:1] != (1,) for field in fields.values()):
                raise refuse("has fields without a leading axis of length 1")
            dtype = np.dtype([(name, field.base, field.shape[1:]) for name, field in fields.items()])
        if chunks[2:] not in ([], [1]) or chunks[0] * chunks[1] * dtype.itemsize > MAX_BYTES:
            raise refuse(f"has chunks {str(chunks)[:40]} of more than {MAX_BYTES:,} bytes")
        if compressor is not None and compressor["id"] != "blosc":
            raise refuse(f"is compressed by {str(compressor['id'])[:20]!r}, but must use blosc")
        if about.get("filters") or about["order"] != "C" or about.get("dimension_separator", ".") != ".":
            raise refuse("has filters, an order other than C, or nested chunk folders")
    except FormatError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise refuse(f"has invalid metadata ({type(error).__name__})") from None
    return StoredArray(path, shape[0], (chunks[0], chunks[1]), dtype, compressor, ".0" * (len(shape) - 2))


def _dtype(fields: Any) -> np.dtype:
    """Parse a structured dtype of numbers and flags only: other types might be unpickled."""
    parts = []
    for name, kind, *rest in fields:
        shape = rest[0] if rest else []
        if not re.fullmatch(NUMBER, kind) or not all(type(n) is int and 0 <= n <= MAX_ROWS for n in shape):
            raise FormatError(
                f"its field {str(name)[:60]} has the type {str(kind)[:20]}, which is not a number or flag"
            )
        parts.append((name, kind, tuple(shape)))
    return np.dtype(parts)


def _metadata(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FormatError(f"there is no {path.name} in {path.parent}")
    try:
        with path.open() as file:
            about = json.loads(file.read(MAX_TEXT))
    except (OSError, ValueError, RecursionError) as error:
        raise FormatError(f"its {path} cannot be read ({type(error).__name__})") from None
    return about if isinstance(about, dict) else {}

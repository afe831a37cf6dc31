"""Arrays of trajectories in zarr's format 2, which zarr 3 writes no structured arrays of: a folder of chunk files.

An array is a folder with its description, `.zarray`, and a file for each chunk; a group is a folder with `.zgroup`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numcodecs.blosc import Blosc

ARRAY, GROUP = ".zarray", ".zgroup"
ROWS = 16  # trajectories of a chunk
# A step's 1,487 or more bytes come again nearly alike: blocks have to hold many. As large as the released data
BLOSC = {"id": "blosc", "cname": "zstd", "clevel": 3, "shuffle": 0, "blocksize": 1 << 18}


def write_group(path: Path) -> None:
    """The mark of a group, in a folder that is there."""
    (path / GROUP).write_text(json.dumps({"zarr_format": 2}))


def write_chunk(path: Path, number: int, values: np.ndarray) -> None:
    """One chunk of an array, (trajectory, time), of at most ROWS trajectories; the rest of the chunk is zero."""
    chunk = np.zeros((ROWS, *values.shape[1:]), values.dtype)
    chunk[: len(values)] = values
    path.mkdir(exist_ok=True)
    (path / f"{number}.0").write_bytes(_blosc(BLOSC).encode(chunk.view(np.uint8)))


def write_array(path: Path, shape: tuple[int, int], dtype: np.dtype) -> None:
    """The description of an array whose chunks are written."""
    about = {
        "zarr_format": 2,
        "shape": shape,
        "chunks": (ROWS, shape[1]),
        "dtype": [[name, dtype[name].base.str, dtype[name].shape] for name in dtype.names or ()],
        "compressor": BLOSC,
        "fill_value": None,
        "order": "C",
        "filters": None,
    }
    (path / ARRAY).write_text(json.dumps(about))


def _blosc(about: dict[str, Any]) -> Blosc:
    return Blosc(**{name: value for name, value in about.items() if name != "id"})

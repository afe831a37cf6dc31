"""A folder in the reference's layout, read with zarr's own codec and nothing of ours."""

import json
from pathlib import Path

import numpy as np
from numcodecs import get_codec


def trajectories_in(folder: Path) -> np.ndarray:
    """All of them, (trajectory, 256), in the order of arrays and rows; as the reference reads them."""
    assert json.loads((folder / ".zgroup").read_text()) == {"zarr_format": 2}
    return np.concatenate([array_at(path) for path in sorted(folder.iterdir()) if path.is_dir()])


def array_at(path: Path) -> np.ndarray:
    about = json.loads((path / ".zarray").read_text())
    dtype = np.dtype([(name, kind, tuple(shape)) for name, kind, shape in about["dtype"]])
    rows, steps = about["shape"]
    chunk_rows, chunk_steps = about["chunks"]
    assert (chunk_steps, about["order"], about["filters"]) == (steps, "C", None)
    codec = get_codec(about["compressor"])
    chunks = []
    for first in range(0, rows, chunk_rows):
        raw = np.frombuffer(codec.decode((path / f"{first // chunk_rows}.0").read_bytes()), dtype)
        chunks.append(raw.reshape(chunk_rows, chunk_steps))
    assert {entry.name for entry in path.iterdir()} == {".zarray", *(f"{i}.0" for i in range(len(chunks)))}
    return np.concatenate(chunks)[:rows]

"""Folders in the reference's layout, read with zarr's codecs and none of our code; conversion to our types."""

import json
from itertools import product
from pathlib import Path

import numpy as np
from numcodecs import get_codec

from levelproof.experts.witness.witness import Record
from levelproof.levelgen.files.kinetix import MANIFOLD, _ours, level_from_kinetix, state_from_kinetix
from levelproof.levelgen.level import Level
from levelproof.physics.types import Manifold

GOLDEN = Path(__file__).parents[3] / "golden/kinetix"  # benchmarks/reference/trajectories.py wrote it
SOLVED, OTHERS = 5, 2  # trajectories of each size in GOLDEN: solved ones first
STEPS = 256


def trajectories_in(folder: Path) -> np.ndarray:
    """Return all trajectories, (trajectory, 256), in the order of arrays and rows, as the reference reads them."""
    assert json.loads((folder / ".zgroup").read_text()) == {"zarr_format": 2}
    return np.concatenate([array_at(path) for path in sorted(folder.iterdir()) if path.is_dir()])


def array_at(path: Path) -> np.ndarray:
    about = json.loads((path / ".zarray").read_text())
    dtype = np.dtype([(name, kind, tuple(shape)) for name, kind, shape in about["dtype"]])
    shape, chunks = about["shape"], about["chunks"]
    codec = get_codec(about["compressor"])
    grid = [range(-(-length // chunk)) for length, chunk in zip(shape, chunks, strict=True)]
    found = np.zeros([len(numbers) * chunk for numbers, chunk in zip(grid, chunks, strict=True)], dtype)
    for i, j in product(*grid):
        raw = np.frombuffer(codec.decode((path / f"{i}.{j}").read_bytes()), dtype).reshape(chunks)
        found[i * chunks[0] : (i + 1) * chunks[0], j * chunks[1] : (j + 1) * chunks[1]] = raw
    assert {entry.name for entry in path.iterdir()} == {".zarray", *(f"{i}.{j}" for i, j in product(*grid))}
    return found[: shape[0], : shape[1]]


def to_ours(trajectories: np.ndarray) -> tuple[Level, Record]:
    """Convert trajectories of the reference to our levels and records by moving bits, without simulation."""
    count = len(trajectories)
    theirs = {name: trajectories[name][:, :, 0] for name in trajectories.dtype.names or ()}
    state = {name.removeprefix("env_state/"): x for name, x in theirs.items() if name.startswith("env_state/")}
    lanes = {name: x.reshape(count * STEPS, *x.shape[2:]) for name, x in state.items()}
    moving = state_from_kinetix(lanes)
    manifold = Manifold(active=moving.contact_active, **_ours(lanes, MANIFOLD))
    in_time = lambda x: np.moveaxis(x.reshape(*x.shape[:-1], count, STEPS), -1, 0)
    back = lambda x: np.moveaxis(x, 0, -1)
    none = np.zeros((STEPS, count), np.float32)
    record = Record(
        state=type(moving)(**{name: in_time(x) for name, x in vars(moving).items()}),
        manifold=Manifold(**{name: in_time(x) for name, x in vars(manifold).items()}),
        joint_point=back(state["joint/global_position"]),
        thruster_point=back(state["thruster/global_position"]),
        timestep=back(state["timestep"]),
        last_distance=back(state["last_distance"]),
        action=back(theirs["action"]),
        reward=none,
        done=back(theirs["done"]),
        goal=none.astype(bool),
    )
    return level_from_kinetix({name: x[:, 0] for name, x in state.items()}), record

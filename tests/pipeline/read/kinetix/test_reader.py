"""The reference's reader and renderer on our exports: it runs `benchmarks/reference/reader.py`."""

from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks import oracle
from levelproof.experts.witness.witness import Record
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.task.observe.pixels import pixels
from levelproof.pipeline.read.kinetix.records import dtype_of, trajectories_of
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import require_manifest
from tests.pipeline.command import here

pytestmark = pytest.mark.campaign
ROWS = 4  # few, because the reference's reader holds 500 batches
STEPS = (0, 5, 40)


@pytest.mark.parametrize("size", SIZES)
def test_reference_opens_and_draws_kinetix_exports(reference: Path, size: str, tmp_path: Path) -> None:
    settings = [f"size={size}", "levels=24", "budget=5k", "procedure=label", "executor=inline"]
    assert here(["generate", *settings], tmp_path).returncode == 0
    split = tmp_path / "data/5k" / size
    rows = require_manifest(split).table
    rows = rows.filter(rows.column("shard").is_valid()).slice(0, ROWS)
    last = rows.column("level_id")[-1]
    done = here(["export", str(split), "--format", "kinetix", "-o", "k", "--where", f"level_id <= {last}"], tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "theirs.npz"
    arguments = [out, tmp_path / "k", "--size", size, "--rows", rows.num_rows, "--steps", *STEPS]
    oracle.run_script(reference, "reader", arguments, "open an export with the reference")
    with np.load(out) as file:
        theirs = dict(file)

    fields = read_rows(split, rows)
    level, record = tree_of(Level, fields, "level/"), tree_of(Record, fields, "record/")
    ours = trajectories_of(level, record)
    frames = theirs.pop("frame")
    assert theirs.pop("mask").all()
    assert set(theirs) == set(dtype_of(SIZES[size]).names or ())
    for name, values in theirs.items():
        assert values.dtype == ours.dtype[name].base, name
        assert values.tobytes() == ours[name][:, :, 0].tobytes(), name

    draw = jax.jit(lambda level, state: pixels(level, state).image)
    for i in range(rows.num_rows):
        lane = lambda tree, i=i: jax.tree.map(lambda x: np.asarray(x)[..., i], tree)
        for frame, step in zip(frames[i], STEPS, strict=True):
            image = 255 * np.asarray(draw(lane(level), lane(jax.tree.map(lambda x, t=step: x[t], record.state))))
            assert image.shape == frame.shape
            assert np.abs(image - frame).mean() < 2  # of 255

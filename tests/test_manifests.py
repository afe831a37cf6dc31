"""The committed reference manifest is reproducible."""

import json
from pathlib import Path

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

import levelproof
from benchmarks.alone import label
from levelproof.configs.compose import compose_job
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.pictures.palette import palette_css
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.dataset.sample import SAMPLE
from levelproof.pipeline.look.gallery.gallery import SITE
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.verify.verify import examine

FOLDER = Path(__file__).parent.parent / "manifests"
EXAMPLE = FOLDER.parent / "docs" / "example"
ROWS = pq.read_table(FOLDER / "128k-s.parquet").to_pylist()
WORLDS = dict(np.load(FOLDER / "128k-s-levels.npz"))
IDS = np.array([row["level_id"] for row in ROWS])
FILES = sorted(file.parent for file in FOLDER.glob("*/*/part-000.parquet"))
SEEDS = [folder for folder in FILES if not folder.name.endswith("-handmade")]
# Turns the warning of a level whose states differ into an error
strict = pytest.mark.filterwarnings("error::levelproof.EngineDiffers")


def test_manifest_describes_the_default_dataset() -> None:
    assert IDS.tolist() == list(range(64))
    assert {row["config_hash"] for row in ROWS} == {compose_job([]).hash}, "regenerate it: manifests/README.md"
    assert {row["label"] for row in ROWS} == {"solved", "unsolved", "trivial", "unsolvable"}


def test_manifest_has_null_instead_of_nan() -> None:
    assert [row for row in ROWS if row["label"] == "trivial" and row["best_return"] is not None] == []
    numbers = [x for row in ROWS for x in [*row.values(), *row["learning_curve"]] if isinstance(x, float)]
    assert np.isfinite(numbers).all()


def test_sampler_reproduces_the_initial_worlds() -> None:
    for name, values in arrays_of(sample_levels(IDS, SIZES["s"])).items():
        np.testing.assert_array_equal(values, WORLDS[name], err_msg=name)


def test_example_in_the_docs_is_the_manifests_gallery() -> None:
    """Its pages link to the program's own, and its data match these rows."""
    links = {path.name: path.resolve() for path in EXAMPLE.iterdir() if path.is_symlink()}
    assert links == {path.name: path.resolve() for path in SITE.iterdir()}
    assert {path.name for path in EXAMPLE.iterdir()} == {*links, "palette.css", "data"}
    assert (EXAMPLE / "palette.css").read_text() == palette_css()
    for row in ROWS:
        text = (EXAMPLE / f"data/levels/0/{row['level_id']}.js").read_text()
        shown = json.loads(text[text.index("{") : text.rindex("}") + 1])["row"]
        assert all(shown[name] == row[name] for name in ("content_hash", "label", "steps_to_goal", "config_hash"))


@strict
@pytest.mark.parametrize(
    ("folder", "rows"),
    [(FOLDER / "256k" / "s", 64), *(pytest.param(folder, 500, marks=pytest.mark.slow) for folder in SEEDS)],
    ids=lambda value: "-".join(value.parts[-2:]) if isinstance(value, Path) else str(value),
)
def test_seeds_grow_to_the_states_of_their_checksums(folder: Path, rows: int) -> None:
    """Any level whose first episode ended otherwise would be warned of."""
    data = levelproof.open(folder)
    some = np.random.default_rng(0).choice(len(data), rows, replace=False)
    batch = data.read(some, observation=None)
    steps = data.manifest["steps_to_goal"].to_numpy()[some]
    assert batch.goal[np.arange(rows), steps - 1].all()


@strict
@pytest.mark.campaign
@pytest.mark.parametrize("folder", SEEDS, ids=lambda folder: "-".join(folder.parts[-2:]))
def test_every_seed_grows_to_its_checksum(folder: Path) -> None:
    data = levelproof.open(folder)
    steps = [data.episodes(part, observation=None).steps for part in np.array_split(np.arange(len(data)), 16)]
    assert np.array_equal(np.concatenate(steps), data.manifest["steps_to_goal"].to_numpy())


@pytest.mark.campaign
@pytest.mark.parametrize("folder", sorted({*FILES} - {*SEEDS}), ids=lambda folder: folder.name)
def test_witnesses_of_handmade_levels_reach_the_goal(folder: Path, tmp_path: Path) -> None:
    """The levels are in the reference's package, which is fetched."""
    words = ["export", str(folder), "--format", "seed", "--levels", "handmade", "-o", str(tmp_path / "whole.parquet")]
    assert main(words) == 0
    findings = examine(tmp_path / "whole.parquet")
    assert findings.wrong == {}
    count = {"s-handmade": 10, "m-handmade": 24, "l-handmade": 40}[folder.name]
    assert (findings.levels, findings.same_bits) == (count, min(count, 32))


@pytest.mark.slow
def test_sample_data_is_the_first_levels_of_the_seeds() -> None:
    """The file is a cut of the committed seeds, small enough for the wheel."""
    assert SAMPLE.stat().st_size < 400_000
    everything = pq.read_table(FOLDER / "256k" / "s" / "part-000.parquet")
    assert pq.read_table(SAMPLE).equals(everything.slice(0, 10_000))
    data = levelproof.sample_data(where="steps_to_goal < 64")
    assert data.read([0, 1]).goal.any(1).all()


def test_three_levels_keep_their_labels() -> None:
    """Two were solved early and one never reached the goal, so differences in last bits do not change their labels."""
    by_expert = [row for row in ROWS if row["label"] == "solved" and row["steps_to_first_success"] is not None]
    early = sorted(by_expert, key=lambda row: row["steps_to_first_success"])[1:3]
    never = next(r for r in ROWS if r["label"] == "unsolved" and r["steps_to_first_success"] is None)
    chosen = np.array([row["level_id"] for row in (*early, never)])
    job = compose_job([])
    levels = jax.tree.map(np.asarray, sample_levels(chosen, SIZES["s"], job.distribution))
    result = label(levels, chosen, job.env_steps, job.procedure, job.task)
    assert [v.label for v in result.verdicts] == ["solved", "solved", "unsolved"]

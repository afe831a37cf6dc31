"""Levels, records and results of random bits, which files must restore exactly; and real splits without training."""

import dataclasses
import shutil
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from levelproof.configs.compose import compose_job
from levelproof.configs.schema import JobConfig
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import WITNESSED, Label, Source, Verdict
from levelproof.experts.networks.over_levels import NetworkConfig, PolicyKind, initial_policy
from levelproof.experts.networks.saved import Policy
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.steps import EnvSteps
from levelproof.experts.verdict.before import decide
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.experts.witness.witness import Record, replay, steps_to_goal, succeeds
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import ACTIONS, SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import MAX_VERTICES, Size
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.store.checksums import with_own
from levelproof.pipeline.store.columns import OF_THE_RUN
from levelproof.pipeline.store.contents import highest
from levelproof.pipeline.store.fields import arrays_of, same_bits, tree_of
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.layout import split_path
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.store.shard import Shard
from tests.quick import jit_once

T = TypeVar("T")
PLAYED = 64  # levels of `played_split`
SPENT = EnvSteps()


def made(kind: type, size: Size, count: int, rng: np.random.Generator, *, time: bool = False) -> Any:
    """Return an instance of a dataclass of arrays for `count` levels, with the shapes in its annotations.

    Floats have random bits, including NaN, infinities, -0.0 and denormals. Integers are at most 255.
    """
    counts = {"body": size.bodies, "polygon": size.polygons, "circle": size.circles, "joint": size.joints}
    counts |= {"thruster": size.thrusters, "vertex": MAX_VERTICES, "contact": pairs_of(size).contacts}
    counts |= {"lane": count, "level": count, "2": 2, "6": ACTIONS, "256": RECORD_STEPS}
    values = {}
    for name, hint in get_type_hints(kind).items():
        if dataclasses.is_dataclass(hint):
            assert isinstance(hint, type)
            values[name] = made(hint, size, count, rng, time=kind is Record)
            continue
        shape = tuple(counts[word] for word in hint.dim_str.split())
        shape = (RECORD_STEPS, *shape) if time else shape
        values[name] = _random(str(hint.dtypes), shape, rng)
    return kind(**values)


def _random(dtypes: str, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    if "bool" in dtypes:
        return rng.random(shape) < 0.5
    if "float" in dtypes:
        return rng.integers(0, 2**32, shape, np.uint32).view(np.float32)
    return rng.integers(0, 256, shape, np.int32)


def made_level(size: str = "s", count: int = 3, seed: int = 0) -> Level:
    return _possible(made(Level, SIZES[size], count, np.random.default_rng(seed)), size, "level/")


def made_record(size: str = "s", count: int = 3, seed: int = 0) -> Record:
    return _possible(made(Record, SIZES[size], count, np.random.default_rng(seed)), size, "record/")


def made_fields(size: str = "s", count: int = 3, seed: int = 0) -> dict[str, np.ndarray]:
    """Return a shard's fields of random levels and records."""
    return arrays_of(made_level(size, count, seed), "level/") | arrays_of(made_record(size, count, seed), "record/")


def assert_same(actual: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray]) -> None:
    """Check that two sets of fields have the same names, types and bits."""
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        assert actual[name].dtype == values.dtype
        assert same_bits(actual[name], values).all(), name


def _possible(tree: T, size: str, path: str) -> T:
    """Limit integers to those that are valid for a size."""
    maxima = highest(SIZES[size])
    arrays = arrays_of(tree, path)
    arrays |= {name: np.minimum(x, maxima[name]).astype(x.dtype) for name, x in arrays.items() if name in maxima}
    return tree_of(type(tree), arrays, path)


def made_verdict(label: Label = Label.SOLVED, **changes: Any) -> Verdict:
    solved = label is Label.SOLVED
    verdict = Verdict(
        label=label,
        label_reason="made for a test",
        failed_by_noop=False,
        witness=Source.SAMPLED if solved else None,
        success_rate=1.0 if solved else float("nan"),
        most_probable_succeeds=False,
        sticky_success_rate=0.5 if solved else float("nan"),
        perturbed_success_rate=0.75 if solved else float("nan"),
        steps_to_goal=17 if solved else None,
        portability=0.875 if solved else None,
        steps_to_first_success=640 if solved else None,
        env_steps=4096,
        learning_curve=[float("nan"), 0.5],
        best_return=1.5 if solved else float("-inf"),
        episodes=40,
    )
    return dataclasses.replace(verdict, **changes)


def made_result(level_ids: list[int], labels: list[Label], size: str = "s") -> UnitResult:
    """Return a result of random bits, which can be written and read but does not replay."""
    count = len(level_ids)
    verdicts = [made_verdict(label) for label in labels]
    return UnitResult(np.array(level_ids), made_level(size, count), made_record(size, count), verdicts, SPENT)


def made_job(out: str = "data", *overrides: str) -> JobConfig:
    return compose_job([f"out={out}", "executor=inline", *overrides])


def played_split(folder: Path, held: int = 16, size: str = "s", copies: Sequence[int] = ()) -> Path:
    """Make a real split in `folder`: levels under random actions, each held for `held` env steps.

    Levels whose episode reaches the goal are labelled solved. The first levels have the content of those with the ids
    `copies`.
    """
    job = made_job(str(folder), f"size={size}", f"levels={PLAYED}")
    ids = np.arange(PLAYED, dtype=np.int32)
    content = jnp.asarray([*copies, *ids[len(copies) :]])
    levels = jax.tree.map(np.asarray, sample_levels(content, SIZES[size], job.distribution))
    rng = np.random.default_rng(0)
    action = np.repeat(rng.integers(0, 2, (RECORD_STEPS // held, 6, PLAYED)), held, axis=0).astype(np.int32)
    record = replay(levels, action, job.task)
    solved = succeeds(np.asarray(record.done), np.asarray(record.goal))
    assert 1 < solved.sum() < PLAYED
    verdicts = [made_verdict(Label.SOLVED if good else Label.UNSOLVED) for good in solved]
    path = split_path(job.out, job.budget, job.size)
    path.mkdir(parents=True)
    note_job(path, job, ["levelproof", "generate"], [(0, PLAYED - 1)])
    commit(
        job,
        path,
        WorkUnit(tuple(int(i) for i in ids)),
        UnitResult(ids.astype(np.int64), levels, record, verdicts, SPENT),
    )
    return path


def honest_split(folder: Path, unit: int, units: int, *words: str, experts: bool = False) -> Path:
    """Make a split without training whose rows are true: levels are solved if random actions solve them.

    With `experts`, each unit stores some, whose files are real but whose content is not.
    """
    job, ids = made_job(str(folder), "size=s", *words), np.arange(unit * units)
    levels = jax.tree.map(np.asarray, sample_levels(jnp.asarray(ids), SIZES["s"], job.distribution))
    before, failed = decide(levels, job.task)
    action = np.repeat(np.random.default_rng(0).integers(0, 2, (16, 6, len(ids))), 16, axis=0).astype(np.int32)
    action[..., [verdict is not None for verdict in before]] = 0
    record = replay(levels, action, job.task)
    solved, steps = succeeds(record.done, record.goal), steps_to_goal(record.done)
    verdicts = [
        known or made_verdict(Label.SOLVED if solved[i] else Label.UNSOLVED, failed_by_noop=bool(failed[i]))
        for i, known in enumerate(before)
    ]
    path = split_path(job.out, job.budget, job.size)
    path.mkdir(parents=True)
    note_job(path, job, ["levelproof", "generate"], [(0, len(ids) - 1)])
    for lanes in ids.reshape(units, unit):
        unit_verdicts = [
            dataclasses.replace(verdicts[i], steps_to_goal=int(steps[i]) if verdicts[i].label in WITNESSED else None)
            for i in lanes
        ]
        weights: Any = {"weights": np.arange(4.0)}
        kept = {int(i): KeptExpert(weights, [0.5]) for i in lanes if experts}
        result = UnitResult(lanes, take(levels, lanes), take(record, lanes), unit_verdicts, SPENT, kept)
        commit(job, path, WorkUnit(tuple(lanes.tolist())), result)
    return path


def lasting(split: Path) -> list[dict[str, Any]]:
    """Return the reproducible part of the rows: no columns about the run, and only whether there is data."""
    rows = read_manifest(split).table.to_pylist()
    return [{k: v for k, v in row.items() if k not in OF_THE_RUN} | {"data": bool(row["shard"])} for row in rows]


def assert_same_content(split: Path, other: Path, level_ids: Collection[int] | None = None) -> None:
    """Check that two splits have the same reproducible rows, and the same data of every level that has any.

    With `level_ids`, the first split may have other levels, too.
    """
    kept = lambda rows: [row for row in rows if level_ids is None or row["level_id"] in level_ids]
    assert repr(kept(lasting(split))) == repr(lasting(other))
    ours, theirs = _data_of(split), _data_of(other)
    ours = {level_id: fields for level_id, fields in ours.items() if level_ids is None or level_id in level_ids}
    assert ours.keys() == theirs.keys()
    for level_id, fields in ours.items():
        assert_same(fields, theirs[level_id])


def _data_of(split: Path) -> dict[int, dict[str, np.ndarray]]:
    """Return the fields of every level that has data, by id."""
    rows = read_manifest(split).table.to_pylist()
    return {row["level_id"]: Shard(split / row["shard"]).read([row["row"]]) for row in rows if row["shard"]}


def made_split(folder: Path, units: Sequence[Sequence[Label]], *words: str) -> Path:
    """Make a split of units with these labels and consecutive level ids; levels and records are random bits."""
    job = made_job(str(folder), "size=s", *words)
    path, first = split_path(job.out, job.budget, job.size), 0
    path.mkdir(parents=True)
    for labels in units:
        ids = list(range(first, first + len(labels)))
        commit(job, path, WorkUnit(tuple(ids)), made_result(ids, list(labels)))
        first += len(labels)
    note_job(path, job, ["levelproof", "generate"], [(0, first - 1)])
    return path


def small_policy(size: Size | None = None, kind: PolicyKind = PolicyKind.INVARIANT) -> Policy:
    """Return a policy with random weights, for levels of this size only or of any."""
    network = NetworkConfig(kind, width=8, depth=1)
    params = jit_once(initial_policy, static_argnums=(1, 2))(jax.random.key(0), network, size or SIZES["s"])
    return Policy(network, params, size, {})


def rewrite(path: Path, table: pa.Table, metadata: Mapping[Any, Any] | None = None, **how: Any) -> None:
    """Write a table, with more metadata, as a fragment or a seed file with a valid digest; `how`: as in pyarrow."""
    whole, about = pa.BufferOutputStream(), {**(table.schema.metadata or {}), **(metadata or {})}
    pq.write_table(table.replace_schema_metadata(about), whole, **how)
    path.write_bytes(with_own(whole.getvalue().to_pybytes()))


def commit_copy(source: Path, number: int, split: Path) -> None:
    """Commit to `split` the unit with index `number` in `source`, a split of the same configuration."""
    fragment = fragment_paths(source)[number]
    for folder in ("manifest", "shards"):
        (split / folder).mkdir(parents=True, exist_ok=True)
    for shard in (source / "shards").glob(f"{fragment.stem}-*"):
        shutil.copytree(shard, split / "shards" / shard.name)
    shutil.copy(fragment, split / "manifest")

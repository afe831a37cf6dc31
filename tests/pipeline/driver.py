"""A job without training: `python -m tests.pipeline.driver OUT` commits units of random bits as `generate` does."""

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label
from levelproof.experts.pool.run import UnitResult
from levelproof.pipeline.jobs.schedule import WorkUnit, plan_units
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.manifest import Manifest, read_manifest, require_manifest
from levelproof.pipeline.store.shard import Shard
from levelproof.pipeline.store.split import writing
from tests.pipeline.made import assert_same, made_job, made_result

LEVELS, UNIT = 6, 2
SPLIT = Path("128k/s")  # below OUT


def drive(out: str, say: Callable[[str], None] = print) -> None:
    """Commit the missing units."""
    job = job_of(out)
    with writing(job, say) as (split, manifest):
        note_job(split, job, ["levelproof", "generate"], [(0, LEVELS - 1)])
        for unit in plan_units(range(LEVELS), manifest.level_ids, UNIT):
            commit_made(split, unit)


@cache
def job_of(out: str) -> JobConfig:
    return made_job(out, "size=s", f"levels={LEVELS}", f"unit={UNIT}")


@cache
def result_of(level_ids: tuple[int, ...]) -> UnitResult:
    """Return a result of random bits, the same each time."""
    return made_result([*level_ids], [[Label.SOLVED, Label.UNSOLVED][i % 2] for i in level_ids])


def commit_made(split: Path, unit: WorkUnit) -> None:
    """Commit a unit as its worker does."""
    commit(job_of("data"), split, unit, result_of(tuple(unit.level_ids)))


def require_same_content(split: Path, other: Path) -> Manifest:
    """Check that rows, except where their witnesses are stored, and all fields of witnesses are equal."""
    manifests = require_manifest(split), read_manifest(other)
    rows, others = (manifest.table.to_pylist() for manifest in manifests)
    for row, twin in zip(rows, others, strict=True):
        assert row | {"shard": bool(row["shard"]), "row": 0} == twin | {"shard": bool(twin["shard"]), "row": 0}
        if row["shard"]:
            one, two = (Shard(at / r["shard"]).read([r["row"]]) for at, r in ((split, row), (other, twin)))
            assert_same(one, two)
    return manifests[0]


if __name__ == "__main__":
    drive(sys.argv[1])

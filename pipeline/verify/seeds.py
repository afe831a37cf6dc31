"""Verification of seed files: every byte, every level's content, every label that needs no expert, every witness."""

from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from rich.console import Console

from levelproof.levelgen.sampling.sampler import CHUNK
from levelproof.pipeline.store.checksums import has_own
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.named import open_shard
from levelproof.pipeline.store.progress_bar import ProgressBar
from levelproof.pipeline.store.seed.columns import ROW_GROUP
from levelproof.pipeline.store.seed.file import STORED, describe_seed, missing_seed, read_seed, seed_files
from levelproof.pipeline.store.seed.source import LevelSource
from levelproof.pipeline.store.seed.write import content_digest
from levelproof.pipeline.verify.cores import Device, Map, on_cores
from levelproof.pipeline.verify.evidence import COLUMNS, Recipe, examine_rows
from levelproof.pipeline.verify.findings import Findings

READ = 16 * CHUNK  # rows read together: to read any of a row group decompresses all of it


def examine_seeds(source: Path, console: Console | None, device: Device = None) -> Findings:
    """Check the seed files at a path; show progress on `console`. `device`: of `prepare_jax`, which was called.

    Raises:
        Failure: there is none, this program makes other levels from their ids, they mix several configurations, or a
            process died.
    """
    findings, files = Findings(stored=STORED), seed_files(source)
    try:
        whole = [path for path in files if has_own(path)]
    except FileNotFoundError:
        raise missing_seed(source) from None
    for path in sorted({*files} - {*whole}):
        findings.add(f"The seed file {path} is not what was written: its bytes have changed.", [])
    if len(whole) == len(files):
        findings.config = read_manifest(source, []).config  # raises if they mix several configurations
    elif whole:
        findings.config = describe_seed(whole[0]).fragment.config
    count = sum(describe_seed(path).fragment.rows for path in whole)
    with ProgressBar("levels", count, console) as progress, on_cores(count, device) as cores:
        for path in whole:
            _examine_file(path, findings, cores.map, progress)
    return findings


def _examine_file(path: Path, findings: Findings, run: Map, progress: ProgressBar) -> None:
    about, table = read_seed(path, [])
    source = LevelSource.of(about.fragment.config, path)
    recipe = Recipe(path, about.fragment.config["size"], source.distribution, source.rules)
    ids = table.column("level_id").to_numpy()
    findings.shards += 1
    findings.budget = about.budget
    groups = [ids[first : first + ROW_GROUP] for first in range(0, len(ids), ROW_GROUP)]
    blocks = [some[first : first + READ] for some in groups for first in range(0, len(some), READ)]
    examined = run(partial(_examined_block, recipe), blocks)
    for digest, some in zip(about.content, groups, strict=True):
        hashes: list[str] = []
        for found, contents in islice(examined, -(-len(some) // READ)):
            findings.include(found)
            hashes += contents
            progress.advance(found.levels)
        if content_digest(hashes) != digest:
            last = int(some[-1])
            findings.add(f"Levels {some[0]} to {last} of {path} differ from those that it was written from.", [])


def _examined_block(recipe: Recipe, level_ids: np.ndarray) -> tuple[Findings, list[str]]:
    """Examine some levels of a seed file, perhaps in another process; return their content hashes, too."""
    findings, path = Findings(), recipe.split
    rows = read_manifest(path, ["level_id", *COLUMNS], level_ids).table
    shard = open_shard(path, path.name, recipe.size)
    examine_rows(rows, recipe, {path.name: shard}, findings)
    return findings, rows.column("content_hash").to_pylist()

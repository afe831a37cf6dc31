"""Verification of seed files: every byte, every level's content, every label that needs no expert, every witness."""

from pathlib import Path

from rich.console import Console

from levelproof.levelgen.sampling.sampler import CHUNK
from levelproof.pipeline.store.checksums import has_own
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.progress_bar import ProgressBar
from levelproof.pipeline.store.seed.columns import ROW_GROUP
from levelproof.pipeline.store.seed.file import STORED, missing_seed, read_seed, seed_files
from levelproof.pipeline.store.seed.shard import SeedShard
from levelproof.pipeline.store.seed.source import LevelSource
from levelproof.pipeline.store.seed.write import content_digest
from levelproof.pipeline.verify.evidence import COLUMNS, Evidence, Recipe
from levelproof.pipeline.verify.findings import Findings

READ = 16 * CHUNK  # rows read together: to read any of a row group decompresses all of it


def examine_seeds(source: Path, console: Console | None) -> Findings:
    """Check the seed files at a path; show progress on `console`.

    Raises:
        Failure: there is none, this program makes other levels from their ids, or they mix several configurations.
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
        findings.config = read_seed(whole[0], [])[0].fragment.config
    with ProgressBar("levels", sum(read_seed(path, [])[0].fragment.rows for path in whole), console) as progress:
        for path in whole:
            _examine_file(path, findings, progress)
    return findings


def _examine_file(path: Path, findings: Findings, progress: ProgressBar) -> None:
    about, table = read_seed(path, [])
    config, shard = about.fragment.config, SeedShard(path)
    source = LevelSource.of(config, path)
    recipe, ids = Recipe(path, config["size"], source.distribution, source.rules), table.column("level_id").to_numpy()
    findings.shards += 1
    findings.budget = about.budget
    for digest, first in zip(about.content, range(0, len(ids), ROW_GROUP), strict=True):
        hashes: list[str] = []
        some = ids[first : first + ROW_GROUP]
        for begin in range(0, len(some), READ):
            rows = read_manifest(path, ["level_id", *COLUMNS], some[begin : begin + READ]).table
            hashes += rows.column("content_hash").to_pylist()
            for part in range(0, rows.num_rows, CHUNK):
                examined = rows.slice(part, CHUNK)
                Evidence(examined, recipe, {path.name: shard}, findings).examine()
                progress.advance(examined.num_rows)
        if content_digest(hashes) != digest:
            last = int(some[-1])
            findings.add(f"Levels {some[0]} to {last} of {path} differ from those that it was written from.", [])

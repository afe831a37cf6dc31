"""Is a split what it claims to be? Every level made again from its id or its file, every label that needs no expert
worked out again, every shard read, every witness replayed.

Bits are promised on the stack that made a row. On another one a level has to look as its id makes it, its world has to
be the one that its row's content hash says, and its witness has to reach the goal.
"""

import json
from pathlib import Path

from rich.console import Console
from rich.progress import track

from configs.convert import typed
from configs.errors import ConfigError
from configs.schema import from_files
from levelgen.identity.keys import SAMPLER_VERSION
from levelgen.level import size_of
from levelgen.sampling.sampler import CHUNK, Distribution
from levelgen.task.rules import TaskParams
from pipeline.errors import Exit, Failure
from pipeline.read.evidence import COLUMNS, Evidence, Findings, Making
from pipeline.runtime import prepare_jax
from pipeline.store.manifest import Manifest, require_manifest
from pipeline.store.shard import Shard, open_shard


def verify(split: Path, as_json: bool) -> Exit:
    """Print what is wrong with `split`; FAILED if anything is.

    Raises:
        UserError: no split.
        Failure: a fragment is damaged, or other levels are made here.
    """
    findings = examine(split)
    if as_json:
        print(json.dumps(findings.__dict__, indent=2))
    else:
        for sentence in findings.wrong:
            print(sentence)
        print(
            f"{split}: {findings.levels} levels made again, {findings.shards} shards read, {findings.witnesses} "
            f"witnesses replayed, {findings.same_bits} of them bit for bit, {len(findings.wrong)} problems."
        )
    return Exit.FAILED if findings.wrong else Exit.DONE


def examine(split: Path) -> Findings:
    """Look at every row and every shard of a split."""
    manifest, findings = require_manifest(split, COLUMNS), Findings()
    making = _making(manifest)
    prepare_jax()
    shards: dict[str, Shard | None] = {}
    console, rows = Console(stderr=True), range(0, manifest.table.num_rows, CHUNK)  # as many as the sampler makes
    for first in track(rows, "levels looked at", console=console, transient=True, disable=not console.is_terminal):
        block = manifest.table.slice(first, CHUNK)
        names = block.column("shard").drop_null().unique().to_pylist()
        shards = {name: shards[name] if name in shards else _opened(name, making, findings) for name in names}
        Evidence(block, making, shards, findings).examine()
    return findings


def _making(manifest: Manifest) -> Making:
    """Raises Failure where this program makes other levels, or plays them by other rules."""
    config = manifest.config or {}
    try:
        if config["sampler_version"] != SAMPLER_VERSION:
            raise ConfigError(f"sampler version {config['sampler_version']}, here it is {SAMPLER_VERSION}")
        size_of(config["size"])
        rules = typed(TaskParams, config["task"], "task")
        distribution = None if from_files(config) else typed(Distribution, config["distribution"], "distribution")
    except (ValueError, KeyError, TypeError) as error:
        raise Failure(
            f"The split {manifest.split} was made by a levelproof with other settings ({error}): use that one."
        ) from None
    return Making(manifest.split, config["size"], distribution, rules)


def _opened(name: str, making: Making, findings: Findings) -> Shard | None:
    try:
        shard = open_shard(making.split, name, making.size)
    except Failure as failure:
        findings.wrong.append(str(failure))
        return None
    findings.shards += 1
    return shard

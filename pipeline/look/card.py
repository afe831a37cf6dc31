"""The README of a dataset for the Hugging Face hub, with figures and a preview beside it.

The hub's viewer opens with the preview; each split's manifest is a subset. Facts about a split come from its manifest;
only the licence must be chosen by a person.
"""

import io
import os
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from levelproof.configs.compose import name_and_hash
from levelproof.configs.schema import FROM_RECORDS
from levelproof.experts.config import RECORD_STEPS, Rule
from levelproof.experts.labels import Label
from levelproof.levelgen.pictures.raster import sheet, write_png
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.figures import draw_panels, draw_shares
from levelproof.pipeline.look.preview import preview
from levelproof.pipeline.look.readme import (
    FIGURES,
    IMPORTED,
    MARK,
    PREVIEW,
    RANDOM,
    RATES,
    SHEET,
    STEPS,
    CardOptions,
    SplitFacts,
    readme,
)
from levelproof.pipeline.read.levels import distribution_of
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.created import writing_to
from levelproof.pipeline.store.disk import NotRegular
from levelproof.pipeline.store.files import replacing, write
from levelproof.pipeline.store.layout import SHARDS
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from levelproof.pipeline.store.named import bytes_named
from levelproof.pipeline.store.remote import is_listed, require_folder
from levelproof.pipeline.store.seed.file import SUFFIX, is_seed
from levelproof.pipeline.store.shard import stored_bytes
from levelproof.pipeline.urls import HUB, as_typed, is_remote, quoted
from levelproof.pipeline.version import __version__

README = "README.md"
COLUMNS_READ = ("label", "steps_to_goal", "content_hash", "shard", "budget", "versions", "device")
SAMPLE = 200  # levels of a split in the preview
SHEET_LEVELS, COLUMNS = 12, 4
BINS = 32
HUB_PARTS = 4  # parts of hf://datasets/USER/NAME


def card(splits: Sequence[Path], out: Path | None, options: CardOptions) -> None:
    """Write the card of a dataset of these splits; print its path and how to upload it.

    Args:
        splits: folders below that of the card, or URLs of one dataset.
        out: file to write; None: beside the splits, which are folders.
        options: what no split records.

    Raises:
        UserError: a split is missing, not in the dataset or on a server that does not list its files, URLs are given
            without `out`, or the file exists and is not a card.
        Failure: a split is damaged.
    """
    root, remote = _above(splits[0]), is_remote(splits[0])
    if remote and out is None:
        raise UserError(
            f"The card of {as_typed(splits[0])} is written on this machine: name its file with -o, as in "
            f"-o card/{README}."
        )
    out = out or root / README
    folder = out.absolute().parent.resolve()
    _require_ours(out)
    _require_plain([out])
    prepare_jax()  # to hash levels of seeds, and to draw
    named = {_below(root if remote else folder, split): split for split in splits}  # each once, however it is written
    paths, manifests = [*named], [require_manifest(split, COLUMNS_READ, compact=True) for split in named.values()]
    facts = [_facts(path, manifest) for path, manifest in zip(paths, manifests, strict=True)]
    _require_own_names(facts)
    with writing_to(out):
        for name in (PREVIEW, FIGURES):
            (folder / name).mkdir(parents=True, exist_ok=True)
            _require_plain([folder / name, *(folder / name).iterdir()])
        tables = [preview(manifest, SAMPLE) for manifest in manifests]
        for split_facts, table in zip(facts, tables, strict=True):
            with replacing(folder / PREVIEW / f"{split_facts.subset}.parquet") as unfinished:
                pq.write_table(table, unfinished, row_group_size=100)
        figures = _draw(folder, facts, tables)
        name = options.name or (options.repo or (root if remote else folder).name.partition("@")[0]).rpartition("/")[2]
        write(out, readme(name, facts, options, figures, __version__).encode())
    print(f"{out}: the card of {', '.join(paths)}, with {PREVIEW}/ and {FIGURES}/ beside it.")
    if not options.license:
        print("It names no licence: choose one with --license, such as cc-by-4.0 or mit.")
    if remote:
        print(f"Next:  copy them to {as_typed(root)}")
        return
    excluded = '--exclude "*.lock" --exclude "*/events/*" --exclude "*/.*"'
    print(f"Next:  hf upload {options.repo or 'USER/NAME'} {quoted(folder)} . --repo-type dataset {excluded}")


def _above(split: Path) -> Path:
    """Return the folder or URL of a dataset: above `{budget}/`, or that of a seed file; on the hub, the repository."""
    if is_remote(split):
        above = split.parent if is_seed(split) else split.parent.parent
        return Path(*split.parts[:HUB_PARTS]) if split.parts[0] in HUB else above
    whole = Path(os.path.abspath(split))  # without `..`
    return whole.parent.parent if whole.is_dir() else whole.parent


def _require_ours(out: Path) -> None:
    if out.exists() and not (out.is_file() and MARK in out.read_text(encoding="utf-8", errors="replace")):
        raise UserError(f"{out} exists, but `levelproof card` did not write it: name another file with -o.")


def _require_own_names(facts: Sequence[SplitFacts]) -> None:
    """Refuse splits whose subsets on the hub, and previews, would have the same name."""
    paths, previews = dict[str, str](), dict[str, str]()
    for split in facts:
        if split.subset == PREVIEW:
            raise UserError(
                f"The subset of {split.path} would be named {PREVIEW}, as that of the pictures is: rename it."
            )
        for names, name, kind in ((paths, split.subset, "subset"), (previews, split.preview, "preview")):
            if (other := names.setdefault(name, split.path)) != split.path:
                raise UserError(f"Both {other} and {split.path} would be the {kind} {name}: rename one of them.")


def _require_plain(paths: Iterable[Path]) -> None:
    """Refuse to write through links, hard links and pipes: the dataset, and thus they, may be untrusted."""
    for path in paths:
        if path.is_symlink():
            raise UserError(f"{path} is a link: remove it, then run the same command again.")
        if path.exists() and not path.is_dir() and (not path.is_file() or path.stat().st_nlink > 1):
            raise NotRegular(path)


def _below(folder: Path, split: Path) -> str:
    """Path of a split relative to the dataset's folder or URL, which must contain every split."""
    path = split if is_remote(split) else split.absolute().resolve()
    if folder not in path.parents:
        raise UserError(f"The split {split} is not below {folder}: put all splits of a dataset into one folder.")
    return path.relative_to(folder).as_posix()


def _facts(path: str, manifest: Manifest) -> SplitFacts:
    table = manifest.table
    labels = {entry["values"]: entry["counts"] for entry in table.column("label").value_counts().to_pylist()}
    solved, config = table.filter(manifest.labels == Label.SOLVED), manifest.config or {}
    split, shards, seeds = manifest.split, manifest.split / SHARDS, is_seed(manifest.split)
    if seeds:
        rows = f"{path}/*{SUFFIX}" if split.is_dir() else path
        split_bytes = shard_bytes = bytes_named(split, manifest.shards)
    else:
        if not is_listed(split):
            require_folder(split, "measure it for its card")
        rows, split_bytes, shard_bytes = f"{path}/manifest/*.parquet", stored_bytes(split), stored_bytes(shards)
    return SplitFacts(
        path=path,
        seeds=seeds,
        rows=rows,
        labels=labels,
        distinct=len(table.column("content_hash").unique()),
        witnesses=table.num_rows - table.column("shard").null_count,
        transitions=manifest.transitions,
        steps_to_goal=solved.column("steps_to_goal").to_numpy(),
        split_bytes=split_bytes,
        shard_bytes=shard_bytes,
        budget=table.column("budget")[0].as_py(),
        distribution=_distribution(manifest),
        searched=bool(config.get("search", {}).get("env_steps")),
        experts=config.get("stop", {}).get("rule", Rule.NONE) != Rule.NONE,
        config_hash=manifest.config_hash or "",
        stored_as=", ".join(sorted(set[str]().union(*(fragment.densities for fragment in manifest.counting)))),
        made_with=_made_with(table),
        whole=not manifest.repeats and distribution_of(manifest) is not None,
    )


def _distribution(manifest: Manifest) -> str:
    distribution = distribution_of(manifest)
    if distribution is None:
        return IMPORTED if (manifest.config or {})["distribution"] == FROM_RECORDS else "level files"
    name, short = name_and_hash(distribution)
    return f"{RANDOM}, `{name}`" if name else f"{RANDOM}, custom distribution (`{short}`)"


def _made_with(table: pa.Table) -> list[str]:
    """Describe each stack of versions and device, most frequent first."""
    query = "SELECT versions, device FROM stacks GROUP BY ALL ORDER BY count(*) DESC, device"
    with duckdb.connect() as connection:
        connection.register("stacks", table.select(["versions", "device"]))
        stacks = connection.sql(query).fetchall()
    return [
        f"levelproof {v['levelproof']}, Python {v['python']}, JAX {v['jax']}, sampler {v['sampler']}, {device}"
        for v, device in stacks
    ]


def _draw(folder: Path, facts: Sequence[SplitFacts], tables: Sequence[pa.Table]) -> list[str]:
    """Draw the figures that have data; return their paths."""
    drawn = []
    rows = (table.select(["label", "goal"]).to_pylist() for table in tables)
    goals = [[row["goal"] for row in split_rows if row["label"] == Label.SOLVED] for split_rows in rows]
    each = -(-SHEET_LEVELS // len(goals))
    if chosen := list(chain(*(pictures[:each] for pictures in goals)))[:SHEET_LEVELS]:
        pictures = [Image.open(io.BytesIO(goal["bytes"])) for goal in chosen]
        with replacing(folder / SHEET) as unfinished:
            write_png(sheet(pictures, COLUMNS), unfinished)
        drawn.append(SHEET)
    if shares := {split.path: split.solved for split in facts if split.solved}:
        with replacing(folder / RATES) as unfinished:
            draw_shares(shares, "Share solved of the levels that were trained or searched", unfinished)
        drawn.append(RATES)
    if steps := {split.path: split.steps_to_goal for split in facts if len(split.steps_to_goal)}:
        title = f"Steps to goal of solved levels (bins of {RECORD_STEPS // BINS})"
        with replacing(folder / STEPS) as unfinished:
            draw_panels(steps, {}, BINS, title, unfinished, RECORD_STEPS)
        drawn.append(STEPS)
    return drawn

"""The levels on which the reference publishes solve rates: its handmade ones, and random ones that its sampler draws.

The handmade levels come with the reference's package, which is fetched without its dependencies. The random ones depend
on its sampler, so the reference itself has to write them: `python -m benchmarks.published` does, in a checkout.
Rates and protocol: README of kinetix-env 3.0.2.
"""

import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from levelproof.levelgen.files.kinetix import level_from_kinetix
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.learn.measured import MeasuredLevels, levels_in
from levelproof.pipeline.runtime import cache_folder
from levelproof.pipeline.store.scratch import scratch

PACKAGE = "kinetix-env==3.0.2"
HANDMADE, RANDOM = "handmade", "reference-random"
HANDMADE_LEVELS = {"s": 10, "m": 24, "l": 40}
RANDOM_LEVELS = 512  # levels per size
AGENTS = {"sfl-paper": ("18 billion", "random l"), "sfl-1m-envs": ("376 billion", "random m")}  # env steps, levels


class Protocol(NamedTuple):
    """Evaluation protocol of the reference, and the solve rates that it published."""

    attempts: int
    rates: dict[str, dict[str, float]]  # by size, then by agent


PROTOCOLS = {
    HANDMADE: Protocol(
        20,
        {
            "s": {"sfl-paper": 0.42, "sfl-1m-envs": 0.70},
            "m": {"sfl-paper": 0.32, "sfl-1m-envs": 0.43},
            "l": {"sfl-paper": 0.11, "sfl-1m-envs": 0.18},
        },
    ),
    RANDOM: Protocol(
        5,
        {
            "s": {"sfl-paper": 0.33, "sfl-1m-envs": 0.56},
            "m": {"sfl-paper": 0.24, "sfl-1m-envs": 0.36},
            "l": {"sfl-paper": 0.16, "sfl-1m-envs": 0.22},
        },
    ),
}


def published_levels(
    name: str, sizes: Sequence[str], count: int | None, say: Callable[[str], None]
) -> Iterator[MeasuredLevels]:
    """Yield the levels of one of PROTOCOLS, by size, with the published rates; of each size the first `count`.

    Raises:
        UserError: the reference has no levels of a size, or the levels are not here; the message says how to get them.
        Failure: their file is damaged.
    """
    if unknown := [size for size in sizes if size not in SIZES]:
        raise UserError(f"The reference has no {name} levels of size {unknown[0]}: set --size to s, m or l.")
    folder = handmade_folder(say) if name == HANDMADE else None
    for size in sizes:
        group = _handmade(folder, size, count, say) if folder else _random(size, count)
        # Only all levels have the published rate
        rates = PROTOCOLS[name].rates[size] if count is None else {}
        yield group._replace(name=f"{name} {size}", published=rates)


def _handmade(folder: Path, size: str, count: int | None, say: Callable[[str], None]) -> MeasuredLevels:
    group = next(levels_in(folder / size, None, None, say))
    if len(group.level_ids) != HANDMADE_LEVELS[size]:
        raise Failure(
            f"The folder {folder / size} does not have the {HANDMADE_LEVELS[size]} handmade levels of size {size}: "
            f"delete {folder}, and they are fetched again."
        )
    return group.first(count)


def handmade_folder(say: Callable[[str], None] = print) -> Path:
    """Return the folder of the 74 handmade levels, a folder for each size; fetch them on first use.

    Raises:
        UserError: they cannot be fetched.
        Failure: they cannot be written, or the package lacks some.
    """
    folder = cache_folder() / "published" / HANDMADE
    if _is_whole(folder):
        return folder
    say(f"Fetching the handmade levels with the package {PACKAGE} (once).")
    try:
        folder.parent.mkdir(exist_ok=True)
        with scratch(folder.parent, f".{HANDMADE}-") as temporary:
            _fetch(temporary)
            unpacked = temporary / "kinetix" / "levels"
            if not _is_whole(unpacked):
                raise Failure(f"The package {PACKAGE} lacks some of the handmade levels: use another package index.")
            if folder.exists() and not _is_whole(folder):
                shutil.rmtree(folder)
            unpacked.rename(folder)
    except OSError as error:
        if _is_whole(folder):  # another process was faster
            return folder
        raise Failure(
            f"Cannot write the handmade levels to {folder} ({error.strerror or error}): set LEVELPROOF_CACHE_DIR to a "
            "folder with room that you may write to."
        ) from None
    return folder


def _is_whole(folder: Path) -> bool:
    return all(len([*(folder / size).glob("*.json")]) == count for size, count in HANDMADE_LEVELS.items())


def _fetch(folder: Path) -> None:
    """Unpack the reference's package in a folder, with the installer that this environment has."""
    reasons = []
    for installer in [sys.executable, "-m", "pip"], ["uv", "pip"]:
        command = [*installer, "install", "--quiet", "--no-deps", "--target", str(folder), PACKAGE]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            reasons.append(f"{installer[0]}: {error.strerror}")
            continue
        if not done.returncode:
            return
        reasons.append((done.stderr.strip().splitlines() or ["no message"])[-1])
    raise UserError(
        f"Cannot fetch the handmade levels ({'; '.join(reasons)}): run `pip download --no-deps {PACKAGE}` on another "
        f"machine, unzip the file, and name its folder kinetix/levels instead of {HANDMADE}."
    )


def random_file(size: str) -> Path:
    """Return the path of the file of random levels, the reference's arrays by name; it may be missing."""
    return cache_folder() / "published" / f"{RANDOM}-{size}.npz"


def _random(size: str, count: int | None) -> MeasuredLevels:
    path = random_file(size)
    try:
        with np.load(path) as file:
            levels = level_from_kinetix({name: file[name] for name in file.files})
    except FileNotFoundError:
        raise UserError(
            f"The reference's random levels of size {size} are not on this machine: write them with `python -m "
            "benchmarks.published` in a checkout of levelproof (once, some minutes; installs the reference beside it)."
        ) from None
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise Failure(f"The file {path} is damaged ({error}): delete it and write it again.") from None
    ids = np.array(list(map(level_id_for, content_hashes(levels))))
    if levels.size != SIZES[size] or len(ids) != RANDOM_LEVELS:
        raise Failure(
            f"The file {path} does not have {RANDOM_LEVELS} levels of size {size}: delete it and write it again."
        )
    return MeasuredLevels(RANDOM, ids, levels, DEFAULT_RULES, None).first(count)

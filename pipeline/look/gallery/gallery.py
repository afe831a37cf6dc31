"""Writer of a split as a site that browsers open from disk: pages, the same for every split, and data.

Data files are scripts that pass a value to the page, because pages opened from disk may load only scripts:
`data/about.js` describes the split, `data/columns/` has pages of the manifest, `data/worlds/` the initial worlds of
BLOCK levels per file, `data/levels/` a file per level with its row and its witness's motion, and that of a policy's
attempt if one plays.
"""

import json
import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from levelproof.experts.witness.witness import steps_to_goal, succeeds
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.pictures.palette import palette_css
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.look import cost
from levelproof.pipeline.look.entities import ENTITIES, count_entities
from levelproof.pipeline.look.gallery.contender import FAILS, SOLVES, Contender, PolicyAttempt
from levelproof.pipeline.look.gallery.pages import PAGE, encode_columns, encode_page
from levelproof.pipeline.look.gallery.worlds import drawn_bodies, encode_array, states_of, world_of
from levelproof.pipeline.look.spread import spread
from levelproof.pipeline.read.levels import levels_of, rules_of, with_known_costs
from levelproof.pipeline.read.policies import policy_at, require_size
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.created import new_folder
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from levelproof.pipeline.store.progress_bar import shown_blocks
from levelproof.pipeline.urls import as_typed, quoted
from levelproof.pipeline.words import many

SITE = Path(__file__).parent / "site"
ABOUT, PALETTE = Path("data") / "about.js", "palette.css"
BLOCK = 64  # levels per file of worlds, and records in memory at a time
FOLDER = 1000  # levels per folder of level files
DIGITS = 6  # significant digits of fractions in a level's file
STATES = ("position", "rotation", "velocity", "angular_velocity")
MOTION = (*(f"record/state/{name}" for name in STATES), "record/action", "record/done", "record/goal")


def gallery(split: Path, out: Path, where: str | None, most: int, policy: Path | None = None) -> None:
    """Write the site; print its path and how to open it.

    Args:
        split: path or URL of the split.
        out: folder to write.
        where: SQL condition that selects levels.
        most: maximum number of levels.
        policy: folder of a policy that plays beside the witnesses; None: none.

    Raises:
        UserError: no split, no matching level, no usable policy, `out` exists and is not a gallery alone, or it cannot
            be written.
        Failure: the split is damaged.
    """
    prepare_jax()
    manifest, matching = _chosen(split, where, most)
    count = manifest.table.num_rows
    contender = _contender(policy, manifest) if policy else None
    with new_folder(out, replaces=_is_gallery) as folder:
        shutil.copytree(SITE, folder, dirs_exist_ok=True)
        (folder / PALETTE).write_text(palette_css(), encoding="utf-8")
        blocks = shown_blocks(count, BLOCK, "levels")
        written = [_write_block(folder, manifest, first, contender) for first in blocks]
        entities = {name: np.concatenate([counts[name] for counts, _ in written]) for name in ENTITIES}
        numbers = entities | {"seconds": cost.seconds_of(manifest.table)}
        outcomes = {"policy": [outcome for _, some in written for outcome in some]} if contender else {}
        about, values = encode_columns(manifest.table, numbers, outcomes)
        for page in range(math.ceil(count / PAGE)):
            _write(folder, f"columns/{page}", encode_page(values, page))
        _write(folder, "about", _about(manifest, matching, where, about))
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    sample = f"{count:,} of {many(matching, 'level')}, spread evenly over their ids,"
    some = many(count, "level") if count == matching else sample
    print(f"{out / 'index.html'}: {some} of {as_typed(split)}, {size / 1e6:,.1f} MB. Open it in a browser, or:")
    print(f"{Path(sys.executable).name} -m webbrowser {quoted(out / 'index.html')}")


def _is_gallery(folder: Path) -> bool:
    """Return whether a folder is a gallery.

    Raises:
        UserError: it is one, but holds other files, too, as the root of a website may.
    """
    if not (folder / ABOUT).is_file():
        return False
    ours = {"data", PALETTE, *(path.name for path in SITE.iterdir())}
    for name in sorted({path.name for path in folder.iterdir()} - ours):
        raise UserError(
            f"{folder} has {name}, which is not part of a gallery: name a new folder with -o, or remove it."
        )
    return True


def _chosen(split: Path, where: str | None, most: int) -> tuple[Manifest, int]:
    """Read the rows to show; also return the number that match."""
    if most < 1:
        raise UserError(f"--levels is {most}: a gallery needs at least 1.")
    manifest = require_manifest(split, columns_in(where), compact=True)
    ids = select(manifest.table, where).column("level_id").to_numpy()
    if not len(ids):
        raise UserError(f"No level of {split} matches {where}: choose others with --where.")
    chosen = require_manifest(split, level_ids=ids[spread(len(ids), most)])
    return replace(chosen, table=with_known_costs(chosen)), len(ids)


def _contender(policy: Path, manifest: Manifest) -> Contender:
    loaded, size = policy_at(policy), size_of(manifest.table["size"][0].as_py())
    require_size(loaded, size, as_typed(manifest.split), "choose another policy with --policy")
    return Contender(loaded, BLOCK)


def _write_block(
    folder: Path, manifest: Manifest, first: int, contender: Contender | None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Write the worlds of BLOCK levels and a file per level; return their entity counts, and what the policy does."""
    rows = manifest.table.slice(first, BLOCK)
    stored = rows.column("shard").is_valid().to_numpy()
    levels = jax.tree.map(np.asarray, levels_of(manifest, rows))
    worlds = [jax.tree.map(lambda x, lane=lane: x[..., lane], levels) for lane in range(rows.num_rows)]
    _write(folder, f"worlds/{first // BLOCK}", [world_of(level) for level in worlds])
    motion = read_rows(manifest.split, rows.filter(stored), MOTION) if stored.any() else {}
    rules, lane = rules_of(manifest), 0
    between = (rules.frame_skip - 1) * rules.physics.dt
    attempts = contender.attempts(levels, rows["level_id"].to_numpy(), rules) if contender else []
    for number, row in enumerate(rows.to_pylist()):
        value: dict[str, Any] = {"row": _plain(row)}
        if attempts:
            value["policy"] = _attempt(worlds[number], attempts[number], between)
        if stored[number]:
            value |= _witness(worlds[number], {name: x[..., lane] for name, x in motion.items()}, between, row)
            lane += 1
        _write(folder, f"levels/{(first + number) // FOLDER}/{row['level_id']}", value)
    return count_entities(levels), [SOLVES if attempt.solved else FAILS for attempt in attempts]


def _witness(level: Level, motion: Mapping[str, np.ndarray], between: float, row: Mapping[str, Any]) -> dict[str, str]:
    """Encode a record's first episode."""
    done, goal = (motion[f"record/{name}"] for name in ("done", "goal"))
    if not succeeds(done[:, None], goal[:, None])[0]:
        raise Failure(f"The record of level {row['level_id']} does not reach the goal: run `levelproof verify`.")
    states = [motion[f"record/state/{name}"] for name in STATES]
    return _film(level, states, motion["record/action"], int(steps_to_goal(done[:, None])[0]), between)


def _attempt(level: Level, attempt: PolicyAttempt, between: float) -> dict[str, Any]:
    """Encode a policy's episode, and whether it reaches the goal."""
    states = [np.asarray(getattr(attempt.record.state, name)) for name in STATES]
    film = _film(level, states, np.asarray(attempt.record.action), attempt.steps, between)
    return film | {"solved": attempt.solved}


def _film(level: Level, motion: Sequence[np.ndarray], action: np.ndarray, steps: int, between: float) -> dict[str, Any]:
    """Encode an episode: states (STATES) of movable bodies, before each step and at the end, and actions.

    Records keep the state before each env step. Its last physics step finds the contact, `between` seconds later, so
    the state at the end is extrapolated.
    """
    position, rotation, velocity, spin = motion
    bodies, still = drawn_bodies(level)
    follow = lambda x, v: np.concatenate([x[:steps], x[steps - 1 : steps] + between * v[steps - 1 : steps]])
    states = states_of(follow(position, velocity), follow(rotation, spin), bodies[still:])
    return {"states": states, "actions": encode_array(action[:steps].astype(np.uint8))}


def _about(manifest: Manifest, matching: int, where: str | None, columns: list[dict[str, Any]]) -> dict[str, Any]:
    rules = rules_of(manifest)
    return {
        "split": as_typed(manifest.split),
        "quoted": quoted(manifest.split),
        "levels": manifest.table.num_rows,
        "found": matching,
        "where": where,
        "config_hash": manifest.config_hash,
        "step_seconds": rules.frame_skip * rules.physics.dt,
        "page": PAGE,
        "block": BLOCK,
        "folder": FOLDER,
        "columns": columns,
    }


def _plain(value: Any) -> Any:
    """Convert a row to JSON types, with fractions rounded to DIGITS digits and NaN as null."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value


def _write(folder: Path, name: str, value: Any) -> None:
    """Write a value as a script that passes it to the page."""
    path = folder / "data" / f"{name}.js"
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    path.write_text(f"levelproof.arrived({json.dumps(name)},{text});\n", encoding="utf-8")

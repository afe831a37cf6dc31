"""The command `play`: find the level to play, and serve the page."""

import json
import time
import webbrowser
from pathlib import Path

import jax
import numpy as np

from levelproof.configs.numbers import parse_count
from levelproof.experts.config import check_budget
from levelproof.experts.procedure import Procedure
from levelproof.experts.witness.witness import steps_to_goal
from levelproof.levelgen.files.level_file import LevelFile
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.gallery.contender import Contender
from levelproof.pipeline.play.server import HOST, serving
from levelproof.pipeline.play.session import empty_file, require_playable, witness_in
from levelproof.pipeline.read.levels import find_level, is_level_file, level_file, levels_of, rules_of
from levelproof.pipeline.read.policies import policy_at
from levelproof.pipeline.read.rows import read_row
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.manifest import require_manifest


def play(
    source: Path | None, level_id: int | None, size: str | None, budget: str, port: int, browser: bool, policy: Path
) -> None:
    """Serve the page until Ctrl-C, and open it if `browser`; `policy` is the policy that plays on request.

    Raises:
        UserError: no such level, size, budget or policy, the file cannot be read or its env steps take too long, or the
            port is invalid or taken.
        Failure: the split is damaged.
    """
    prepare_jax(threads=2)  # an expert may train while the page plays
    procedure, env_steps = Procedure(), parse_count(budget, "budget")
    try:
        check_budget(env_steps, procedure.expert, procedure.stop)
    except ValueError as error:
        raise UserError(f"{error}.") from None
    file, actions = level_to_play(source, level_id, size)
    contender = Contender(policy_at(policy), 1)
    with serving(file, actions, procedure, env_steps, port, contender) as server:
        address = f"http://{HOST}:{server.socket.getsockname()[1]}/"
        print(f"Play at {address} (Ctrl-C stops the server)", flush=True)
        if browser:
            webbrowser.open(address)
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            print("Done. Files that you saved are in your browser's downloads.")


def level_to_play(source: Path | None, level_id: int | None, size: str | None) -> tuple[LevelFile, np.ndarray | None]:
    """Load the level to play with its rules, and the actions [step, 6] of its witness or None. Errors as `play`."""
    if source is None:
        return empty_file(size or "m"), None
    if size is not None:
        raise UserError(f"--size is for an empty level: leave it out, or {source}.")
    if is_level_file(source):
        file = require_playable(level_file(source, level_id))
        return file, witness_in(json.loads(source.read_bytes()), file)
    if level_id is None:
        raise UserError(f"Which level of {source}? Add its id, such as {require_manifest(source, []).level_ids[0]}.")
    manifest, row = find_level(source, level_id)
    level = jax.tree.map(np.asarray, levels_of(manifest, manifest.table))
    file = require_playable(LevelFile(level, rules_of(manifest)))
    if not row["shard"]:
        return file, None
    stored = read_row(manifest.split, row, ["record/action", "record/done"])
    return file, stored["record/action"][: int(steps_to_goal(stored["record/done"])[0]), :, 0]

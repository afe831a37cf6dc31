"""One level as a picture or a film: its witness or, if it has none, what happens without actions."""

import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import Record, replay, steps_to_goal, succeeds
from levelproof.levelgen.level import ACTIONS, Level, name_of
from levelproof.levelgen.pictures.raster import rasterise, sheet, write_gif, write_png
from levelproof.levelgen.pictures.scene import scene_of
from levelproof.levelgen.pictures.shapes import Scene
from levelproof.levelgen.pictures.svg import svg_of
from levelproof.levelgen.pictures.words import Caption
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import State
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.look.spread import spread
from levelproof.pipeline.read.levels import find_level, is_level_file, level_file, levels_of, rules_of
from levelproof.pipeline.read.rows import read_row
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.created import writing_to
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.files import replacing
from levelproof.pipeline.store.manifest import require_manifest

STEPS_A_PICTURE = 2  # env steps between the pictures of a film: 15 pictures/s
LAST_SECONDS = 1.5  # s that a film rests on its last picture
MAX_FRAME_SKIP = 8  # physics steps per env step, of which level files may have any number; above, no film is played
SHOWN_SECONDS = (0.02, 2.0)  # minimum and maximum of a picture: rules may have any time step
SHEET = (3, 2)  # columns and rows of a .png


def show(source: Path, level_id: int | None, out: Path) -> None:
    """Draw a level of a split, or of a level file, to `out`; print one line about the picture.

    `.gif`, `.mp4` and `.svg` are films of the witness's first episode or, without a witness, of doing nothing.
    `.png` is a sheet of pictures of the witness, or the initial world.

    Raises:
        UserError: no such level, or a file cannot be read or written.
        Failure: the split is damaged.
    """
    suffix = out.suffix.lower()
    write = WRITERS.get(suffix)
    if write is None:
        raise UserError(f"Cannot draw to {out}: its name must end in {', '.join(WRITERS)}.")
    prepare_jax()
    film = film_of(source, level_id, plays=suffix != ".png")
    with writing_to(out), replacing(out) as unfinished:
        write(film, unfinished)
    print(f"{out}: {film.description}")


@dataclass(frozen=True)
class Film:
    """Scenes of one level, their durations, and a description."""

    scenes: Sequence[Scene]
    seconds: Sequence[float]  # how long each is shown
    description: str


def film_of(source: Path, level_id: int | None, plays: bool = True) -> Film:
    """Film of a level's witness; without one, doing nothing if `plays`, else the initial world.

    Raises:
        UserError: no such level, or a file cannot be read.
        Failure: the split is damaged.
    """
    if is_level_file(source):
        file = level_file(source, level_id)
        size = name_of(file.level.size)
        caption = Caption(f"{' '.join(source.stem.split())} · size {size}")
        description = f"{source.name}, a level of size {size}: no witness of a level file is shown"
        return _without_witness(file.level, file.rules, caption, description, plays)
    if level_id is None:
        raise UserError(f"Which level of {source}? Add its id, such as {require_manifest(source, []).level_ids[0]}.")
    manifest, row = find_level(source, level_id)
    if row["shard"]:
        return recorded_film(row, read_row(manifest.split, row), rules_of(manifest))
    caption = Caption(_title(row), outcome=row["label"], good=False)
    description = (
        f"level {level_id} of size {row['size']} is {row['label']} ({row['label_reason']}): there is no witness"
    )
    return _without_witness(levels_of(manifest, manifest.table), rules_of(manifest), caption, description, plays)


def recorded_film(
    row: dict[str, Any], arrays: dict[str, np.ndarray], rules: TaskParams, every: int = STEPS_A_PICTURE
) -> Film:
    """Film of the first episode of a record: a scene every `every` env steps, and one when the goal is reached.

    Raises:
        Failure: the record does not reach the goal.
    """
    level, states = tree_of(Level, arrays, "level/"), tree_of(State, arrays, "record/state/")
    done, goal, action = (arrays[f"record/{name}"][..., 0] for name in ("done", "goal", "action"))
    if not succeeds(done, goal):
        raise Failure("The record of this level does not reach the goal: run `levelproof verify` on its split.")
    steps = int(steps_to_goal(done))
    scenes, seconds = _episode(level, states, action, (steps, GOAL), rules, Caption(_title(row)), every)
    description = f"solved in {steps} step{'s' if steps > 1 else ''} ({_length(steps, rules)})"
    return Film(scenes, seconds, f"level {row['level_id']} of size {row['size']}, {description}")


def _without_witness(level: Level, rules: TaskParams, caption: Caption, description: str, plays: bool) -> Film:
    """Film of doing nothing, or of the initial world."""
    if not plays or rules.frame_skip > MAX_FRAME_SKIP:
        scene = scene_of(level, level.state, caption=replace(caption, clock="0.0 s"))
        return Film([scene], [LAST_SECONDS], f"{description}, so this is its initial world")
    record, end = do_nothing(level, rules)
    action, caption = np.asarray(record.action)[..., 0], replace(caption, clock="doing nothing · ")
    scenes, seconds = _episode(level, record.state, action, end, rules, caption, STEPS_A_PICTURE)
    how = f"{end[1]} after" if end[1] else "the first"
    description = f"{description}, so this is what doing nothing does ({how} {_length(end[0], rules)})"
    return Film(scenes, seconds, description)


End = tuple[int, str]  # length of the first episode in env steps; how it ends, "" if it does not
GOAL, FAIL, LATE, BROKEN = "goal reached", "touched red", "time is up", "world breaks down"


def do_nothing(level: Level, rules: TaskParams) -> tuple[Record, End]:
    """Record doing nothing; return the record and how its first episode ends."""
    record = replay(level, np.zeros((RECORD_STEPS, ACTIONS, 1), np.int32), replace(rules, dense_reward_scale=0.0))
    if not record.done.any():
        return record, (RECORD_STEPS, "")
    steps = int(steps_to_goal(record.done)[0])
    if record.goal[steps - 1, 0]:
        return record, (steps, GOAL)
    failed = record.reward[steps - 1, 0] < 0
    return record, (steps, FAIL if failed else LATE if steps == rules.max_timesteps else BROKEN)


def _episode(
    level: Level, states: State, action: np.ndarray, end: End, rules: TaskParams, caption: Caption, every: int
) -> tuple[list[Scene], list[float]]:
    """Scenes of a record's first episode, every `every` env steps and at its end, and the duration of each."""
    steps, outcome = end
    shown, scenes = [*range(0, steps, every), steps], []
    for step in shown:
        last = min(step, steps - 1)
        state = jax.tree.map(lambda x, last=last: x[last], states)
        now = replace(caption, clock=caption.clock + _length(step, rules))
        if step == steps:
            state = _extrapolated(state, rules)
            now = replace(now, outcome=outcome, good=outcome == GOAL) if outcome else now
        scenes.append(scene_of(level, state, action=action[last], caption=now))
    (shortest, longest), second = SHOWN_SECONDS, rules.frame_skip * rules.physics.dt
    seconds = [min(max(second * (after - step), shortest), longest) for step, after in pairwise(shown)]
    return scenes, [*seconds, LAST_SECONDS]


def _length(steps: int, rules: TaskParams) -> str:
    return f"{steps * rules.frame_skip * rules.physics.dt:.1f} s"


def write_sheet(film: Film, path: Path) -> None:
    """Draw up to six of the film's pictures, including the first and the last."""
    columns, rows = SHEET
    chosen = spread(len(film.scenes), columns * rows)
    write_png(sheet([rasterise(film.scenes[i]) for i in chosen], columns), path)


def write_mp4(film: Film, path: Path) -> None:
    """Encode with the ffmpeg of this machine or, if it has none, of the extra `video`.

    Raises:
        UserError: there is no ffmpeg.
        Failure: ffmpeg fails.
    """
    program = shutil.which("ffmpeg") or packaged_ffmpeg()
    if program is None:
        raise UserError(
            "Cannot draw an MP4, because this machine has no ffmpeg: run `pip install imageio-ffmpeg`, or use a name "
            "ending in .gif."
        )
    rate = 1 / film.seconds[0]
    rest = round(film.seconds[-1] * rate)
    pictures = list(map(rasterise, film.scenes))
    width, height = pictures[0].size
    command = [program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", f"{rate:.6g}", "-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
    raw = b"".join(picture.tobytes() for picture in [*pictures, *pictures[-1:] * (rest - 1)])
    done = subprocess.run([*command, str(path)], input=raw, capture_output=True, check=False)
    if done.returncode:
        raise Failure(f"ffmpeg could not encode the film: {done.stderr.decode(errors='replace').strip()[-200:]}")


def packaged_ffmpeg() -> str | None:
    """Path of the ffmpeg in the package imageio-ffmpeg, if that is installed."""
    try:
        import imageio_ffmpeg
    except ImportError:
        return None
    return imageio_ffmpeg.get_ffmpeg_exe()


WRITERS: dict[str, Callable[[Film, Path], object]] = {
    ".gif": lambda film, path: write_gif(map(rasterise, film.scenes), path, film.seconds),
    ".png": write_sheet,
    ".mp4": write_mp4,
    ".svg": lambda film, path: path.write_text(svg_of(film.scenes, film.seconds), encoding="utf-8"),
}


def _extrapolated(state: State, rules: TaskParams) -> State:
    """Extrapolate the last recorded state to the moment when the goal is touched.

    Records keep the state before each env step. In the last env step, the first physics steps move the bodies, and
    only the final one finds the contact.
    """
    seconds = (rules.frame_skip - 1) * rules.physics.dt
    return replace(
        state,
        position=state.position + seconds * state.velocity,
        rotation=state.rotation + seconds * state.angular_velocity,
    )


def _title(row: dict[str, Any]) -> str:
    return f"level {row['level_id']} · size {row['size']}"

"""One level as a picture or a film: its witness, or what doing nothing does where it has none."""

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
from levelproof.levelgen.pictures.raster import rasterised, sheet, write_gif, write_png
from levelproof.levelgen.pictures.scene import scene_of
from levelproof.levelgen.pictures.shapes import Scene
from levelproof.levelgen.pictures.svg import svg_of
from levelproof.levelgen.pictures.words import Caption
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import State
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.look.spread import spread
from levelproof.pipeline.read.levels import find_level, is_level_file, level_file, levels_of, rules_of, writing_to
from levelproof.pipeline.read.rows import read_row
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import Manifest, require_manifest

STEPS_A_PICTURE = 2  # env steps between the pictures of a film: 15 pictures a second
LAST_SECONDS = 1.5  # how long a film rests on its last picture
MAX_FRAME_SKIP = 8  # with which doing nothing is played: a level file's rules may have any
SHOWN_SECONDS = (0.02, 2.0)  # shortest and longest of a picture; rules may have any time step
SHEET = (3, 2)  # columns and rows of a still


def show(source: Path, level_id: int | None, out: Path) -> None:
    """Draw a level of a split, or that of a level file, to `out`, and tell in one line what was drawn.

    `.gif`, `.mp4` and `.svg` are films: of the witness's first episode, or of doing nothing where there is no witness.
    `.png` is a sheet of pictures of the witness, or the initial world.

    Raises:
        UserError: no such level, or a file that cannot be read or written.
        Failure: the split is damaged.
    """
    suffix = out.suffix.lower()
    write = WRITERS.get(suffix)
    if write is None:
        raise UserError(f"Cannot draw to {out}: its name has to end in {', '.join(WRITERS)}.")
    film = film_of(source, level_id, plays=suffix != ".png")
    with writing_to(out):
        write(film, out)
    print(f"{out}: {film.told}")


@dataclass(frozen=True)
class Film:
    """Scenes of one level, the time of each, and what they show."""

    scenes: Sequence[Scene]
    seconds: Sequence[float]  # how long each is shown
    told: str


def film_of(source: Path, level_id: int | None, plays: bool = True) -> Film:
    """What there is to see of a level; `plays`: doing nothing may be a film.

    Raises:
        UserError: no such level, or a file that cannot be read.
        Failure: the split is damaged.
    """
    if is_level_file(source):
        if level_id is not None:
            raise UserError(f"{source} is a level file, which has one level: leave out the id {level_id}.")
        file = level_file(source)
        size = name_of(file.level.size)
        caption = Caption(f"{' '.join(source.stem.split())} · size {size}")
        told = f"{source.name}, a level of size {size}: a level file has no witness"
        return _without_witness(file.level, file.rules, caption, told, plays)
    if level_id is None:
        raise UserError(f"Which level of {source}? Add its id, such as {require_manifest(source, []).level_ids[0]}.")
    manifest, row = find_level(source, level_id)
    if row["shard"]:
        return witness_film(manifest, row)
    caption = Caption(_title(row), outcome=row["label"], good=False)
    told = f"level {level_id} of size {row['size']} is {row['label']} ({row['label_reason']}): there is no witness"
    return _without_witness(levels_of(manifest, manifest.table), rules_of(manifest), caption, told, plays)


def witness_film(manifest: Manifest, row: dict[str, Any]) -> Film:
    """The first episode of a solved level's record.

    Raises:
        Failure: it does not reach the goal.
    """
    arrays = read_row(manifest.split, row)
    return recorded_film(row, arrays, rules_of(manifest))


def recorded_film(
    row: dict[str, Any], arrays: dict[str, np.ndarray], rules: TaskParams, every: int = STEPS_A_PICTURE
) -> Film:
    """The same of what a shard has of a row: a scene every so many env steps, and one when the goal is reached.

    Raises:
        Failure: it does not reach the goal.
    """
    level, states = tree_of(Level, arrays, "level/"), tree_of(State, arrays, "record/state/")
    done, goal, action = (arrays[f"record/{name}"][..., 0] for name in ("done", "goal", "action"))
    if not succeeds(done, goal):
        raise Failure("The record of this level does not reach the goal: run `levelproof verify` on its split.")
    steps = int(steps_to_goal(done))
    scenes, seconds = _episode(level, states, action, (steps, GOAL), rules, Caption(_title(row)), every)
    told = f"solved in {steps} step{'s' if steps > 1 else ''} ({_length(steps, rules)})"
    return Film(scenes, seconds, f"level {row['level_id']} of size {row['size']}, {told}")


def _without_witness(level: Level, rules: TaskParams, caption: Caption, told: str, plays: bool) -> Film:
    """What doing nothing does, or the initial world."""
    if not plays or rules.frame_skip > MAX_FRAME_SKIP:
        scene = scene_of(level, level.state, caption=replace(caption, clock="0.0 s"))
        return Film([scene], [LAST_SECONDS], f"{told}, so this is its initial world")
    record, end = do_nothing(level, rules)
    action, caption = np.asarray(record.action)[..., 0], replace(caption, clock="doing nothing · ")
    scenes, seconds = _episode(level, record.state, action, end, rules, caption, STEPS_A_PICTURE)
    how = f"{end[1]} after" if end[1] else "the first"
    told = f"{told}, so this is what doing nothing does ({how} {_length(end[0], rules)})"
    return Film(scenes, seconds, told)


End = tuple[int, str]  # length of a first episode, env steps, and what it ends with; "": it goes on
GOAL, FAIL, LATE, BROKEN = "goal reached", "touched red", "time is up", "world breaks down"


def do_nothing(level: Level, rules: TaskParams) -> tuple[Record, End]:
    """The record of doing nothing."""
    prepare_jax()
    record = replay(level, np.zeros((RECORD_STEPS, ACTIONS, 1)), replace(rules, dense_reward_scale=0.0))
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
    """A scene every so many env steps of a record's first episode, and one of its end; and the time of each."""
    steps, outcome = end
    shown, scenes = [*range(0, steps, every), steps], []
    for step in shown:
        last = min(step, steps - 1)
        state = jax.tree.map(lambda x, last=last: x[last], states)
        now = replace(caption, clock=caption.clock + _length(step, rules))
        if step == steps:
            state = _touch(state, rules)
            now = replace(now, outcome=outcome, good=outcome == GOAL) if outcome else now
        scenes.append(scene_of(level, state, action=action[last], caption=now))
    (shortest, longest), second = SHOWN_SECONDS, rules.frame_skip * rules.physics.dt
    seconds = [min(max(second * (after - step), shortest), longest) for step, after in pairwise(shown)]
    return scenes, [*seconds, LAST_SECONDS]


def _length(steps: int, rules: TaskParams) -> str:
    return f"{steps * rules.frame_skip * rules.physics.dt:.1f} s"


def write_sheet(film: Film, path: Path) -> None:
    """A few of the film's pictures, the first and the last among them."""
    columns, rows = SHEET
    chosen = spread(len(film.scenes), columns * rows)
    write_png(sheet([rasterised(film.scenes[i]) for i in chosen], columns), path)


def write_mp4(film: Film, path: Path) -> None:
    """By the program ffmpeg: the machine's, or the one of the extra `video`.

    Raises:
        UserError: there is none.
        Failure: it fails.
    """
    program = shutil.which("ffmpeg") or packaged_ffmpeg()
    if program is None:
        raise UserError(
            f"Cannot draw to {path}: MP4 needs the program ffmpeg. "
            "Run `pip install imageio-ffmpeg`, or use a name ending in .gif."
        )
    rate = 1 / film.seconds[0]
    rest = round(film.seconds[-1] * rate)
    pictures = list(map(rasterised, film.scenes))
    width, height = pictures[0].size
    command = [program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", f"{rate:.6g}", "-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
    raw = b"".join(picture.tobytes() for picture in [*pictures, *pictures[-1:] * (rest - 1)])
    done = subprocess.run([*command, str(path)], input=raw, capture_output=True, check=False)
    if done.returncode:
        raise Failure(f"ffmpeg could not write {path}: {done.stderr.decode(errors='replace').strip()[-200:]}")


def packaged_ffmpeg() -> str | None:
    """The ffmpeg that comes with the package imageio-ffmpeg, where it is installed."""
    try:
        import imageio_ffmpeg
    except ImportError:
        return None
    return imageio_ffmpeg.get_ffmpeg_exe()


WRITERS: dict[str, Callable[[Film, Path], object]] = {
    ".gif": lambda film, path: write_gif(map(rasterised, film.scenes), path, film.seconds),
    ".png": write_sheet,
    ".mp4": write_mp4,
    ".svg": lambda film, path: path.write_text(svg_of(film.scenes, film.seconds), encoding="utf-8"),
}


def _touch(state: State, rules: TaskParams) -> State:
    """The world about when the goal was touched: records keep states before steps, so speeds lead on from the last.

    The last of a step's physics steps looks for contacts after the others have moved the bodies.
    """
    seconds = (rules.frame_skip - 1) * rules.physics.dt
    return replace(
        state,
        position=state.position + seconds * state.velocity,
        rotation=state.rotation + seconds * state.angular_velocity,
    )


def _title(row: dict[str, Any]) -> str:
    return f"level {row['level_id']} · size {row['size']}"

"""One level as a picture or a film: its witness, or the initial world where it has none."""

import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from PIL import Image

from configs.convert import typed
from levelgen.level import Level, name_of
from levelgen.render import Caption, draw, sheet, write_gif, write_png
from levelgen.task import TaskParams
from physics.types import State
from pipeline.errors import Failure, UserError
from pipeline.fields import tree_of
from pipeline.levels import find_row, is_level_file, level_file, level_of
from pipeline.manifest import Manifest, require_manifest
from pipeline.shard import Shard

STEPS_A_PICTURE = 2  # env steps between the pictures of a film: 15 pictures a second
LAST_SECONDS = 1.5  # how long a film rests on its last picture
MOST_LETTERS = 40  # of a file's name in a picture
SHEET = (3, 2)  # columns and rows of a still


def show(source: Path, level_id: int | None, out: Path) -> None:
    """Draw a level of a split, or that of a level file, to `out`, and tell in one line what was drawn.

    `.gif` and `.mp4` are films of the witness's first episode, `.png` is a sheet of pictures of it.

    Raises:
        UserError: no such level, or a file that cannot be read or written.
        Failure: the split is damaged.
    """
    write = WRITERS.get(out.suffix.lower())
    if write is None:
        raise UserError(f"Cannot draw to {out}: its name has to end in {', '.join(WRITERS)}.")
    film = film_of(source, level_id)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write(film, out)
    except OSError as error:
        raise UserError(f"Cannot write {out} ({error.strerror or error}): choose another file with -o.") from None
    print(f"{out}: {film.told}")


@dataclass(frozen=True)
class Film:
    """Pictures, the time of each, and what they show."""

    pictures: Sequence[Image.Image]
    seconds: Sequence[float]  # how long each is shown
    told: str


def film_of(source: Path, level_id: int | None) -> Film:
    """What there is to see of a level.

    Raises:
        UserError: no such level, or a file that cannot be read.
        Failure: the split is damaged.
    """
    if is_level_file(source):
        if level_id is not None:
            raise UserError(f"{source} is a level file, which has one level: leave out the id {level_id}.")
        return file_still(source)
    manifest = require_manifest(source)
    if level_id is None:
        raise UserError(f"Which level of {source}? Add its id, such as {manifest.level_ids[0]}.")
    row = find_row(manifest, level_id)
    return witness_film(manifest, row) if row["shard"] else still(manifest, row)


def witness_film(manifest: Manifest, row: dict[str, Any]) -> Film:
    """The first successful episode of a solved level's record."""
    arrays = Shard(manifest.split / row["shard"]).read([row["row"]])
    level = tree_of(Level, _below(arrays, "level/"))
    states = tree_of(State, _below(arrays, "record/state/"))
    done, goal, action = (arrays[f"record/{name}"][..., 0] for name in ("done", "goal", "action"))
    first, last = first_success(done, goal)
    rules = typed(TaskParams, (manifest.config or {})["task"])
    second = rules.frame_skip * rules.physics.dt  # of an env step
    shown = [*range(first, last + 1, STEPS_A_PICTURE), last + 1]
    pictures = []
    for step in shown:
        state = _at(states, step) if step <= last else _touch(_at(states, last), rules)
        caption = Caption(_title(row), f"{(step - first) * second:.1f} s", "goal reached" if step > last else "")
        pictures.append(draw(level, state, action=action[min(step, last)], caption=caption))
    seconds = [second * (after - step) for step, after in pairwise(shown)] + [LAST_SECONDS]
    steps = last - first + 1
    told = f"solved in {steps} step{'s' if steps > 1 else ''} ({steps * second:.1f} s)"
    return Film(pictures, seconds, f"level {row['level_id']} of size {row['size']}, {told}")


def still(manifest: Manifest, row: dict[str, Any]) -> Film:
    """The initial world of a level without a witness."""
    level = level_of(manifest, row)
    caption = Caption(_title(row), "0.0 s", row["label"], good=False)
    told = (
        f"level {row['level_id']} of size {row['size']} is {row['label']} ({row['label_reason']}): "
        "there is no witness, so this is its initial world"
    )
    return Film([draw(level, level.state, caption=caption)], [LAST_SECONDS], told)


def file_still(path: Path) -> Film:
    """The initial world of a level file."""
    level = level_file(path).level
    size = name_of(level.size)
    title = " ".join(path.stem.split())[:MOST_LETTERS]
    told = f"{path.name}, a level of size {size}: a level file has no witness, so this is its initial world"
    return Film([draw(level, level.state, caption=Caption(f"{title} · size {size}", "0.0 s"))], [LAST_SECONDS], told)


def first_success(done: Bool[np.ndarray, " time"], goal: Bool[np.ndarray, " time"]) -> tuple[int, int]:
    """First and last step of the first episode that ends in the goal.

    Raises:
        Failure: none does.
    """
    ends = np.flatnonzero(goal)
    if not len(ends):
        raise Failure("The record of this level never reaches the goal: run `levelproof verify` on its split.")
    last = int(ends[0])
    before = np.flatnonzero(done[:last])
    return (int(before[-1]) + 1 if len(before) else 0), last


def write_film(film: Film, path: Path) -> None:
    write_gif(film.pictures, path, film.seconds)


def write_sheet(film: Film, path: Path) -> None:
    """A few of the film's pictures, the first and the last among them."""
    columns, rows = SHEET
    chosen = np.unique(np.linspace(0, len(film.pictures) - 1, columns * rows).round().astype(int))
    write_png(sheet([film.pictures[i] for i in chosen], columns), path)


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
    width, height = film.pictures[0].size
    command = [program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", f"{rate:.6g}", "-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
    pictures = [*film.pictures, *[film.pictures[-1]] * (rest - 1)]
    raw = b"".join(picture.tobytes() for picture in pictures)
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


WRITERS: dict[str, Callable[[Film, Path], None]] = {".gif": write_film, ".png": write_sheet, ".mp4": write_mp4}


def _below(arrays: dict[str, np.ndarray], path: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(path): values for name, values in arrays.items() if name.startswith(path)}


def _at(states: State, step: int) -> State:
    return State(**{name: values[step] for name, values in vars(states).items()})


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

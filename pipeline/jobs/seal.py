"""The jobs that seal: `levelproof seal`, and `levelproof generate` while its workers run."""

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from rich.console import Console

from levelproof.configs.schema import KEY_EVERY, KEYS_EVERY, Density, stored_as
from levelproof.pipeline.errors import LevelproofError, UserError
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store import seal as store
from levelproof.pipeline.store.bounds import MAX_ROWS
from levelproof.pipeline.store.disk import explaining_writes
from levelproof.pipeline.store.fragment import Fragment
from levelproof.pipeline.store.job_note import note_density
from levelproof.pipeline.store.layout import fragment_path, unit_name
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.progress_bar import ProgressBar, say
from levelproof.pipeline.store.scratch import written_disk
from levelproof.pipeline.store.seal import Piece, seal
from levelproof.pipeline.store.split import taken
from levelproof.pipeline.urls import as_typed, quoted
from levelproof.pipeline.words import many

SHOWN_EVERY = 1.0  # s


@stoppable()
def seal_split(
    split: Path, rows: int | None, console: Console, density: Density | None = None, key_every: int = KEY_EVERY
) -> None:
    """Seal all unsealed fragments of a split, then write the manifest's index.

    Args:
        split: folder or URL.
        rows: approximate number of rows in a sealed fragment; None: `store.seal.ROWS`.
        console: receives progress and messages.
        density: convert all records stored otherwise to this density, sealed or not; None: keep densities.
        key_every: env steps between key frames of density "witness".

    Raises:
        UserError: there is no split, it cannot be written, or another command is writing to it.
        Failure: the split is damaged, or a write failed; nothing is lost, and sealed fragments stay sealed.
        KeyboardInterrupt: stopped by Ctrl-C or SIGTERM; again nothing is lost.
    """
    if rows is not None and not 1 <= rows <= MAX_ROWS:
        raise UserError(f"A sealed fragment cannot have {rows} rows: give --rows a number from 1 to {MAX_ROWS}.")
    if key_every not in KEYS_EVERY:
        raise UserError(f"--key-every is {key_every}: choose one of {', '.join(map(str, KEYS_EVERY))}.")
    require_manifest(split, [])
    if density:
        prepare_jax()
    wanted = (density, key_every) if density else None
    with taken(split, partial(say, console), indexed=True) as manifest:
        pieces = list(map(Piece.of, manifest.counting))
        groups = store.plan(pieces, rows or store.ROWS)
        if wanted:
            others = {fragment.path for fragment in manifest.counting if fragment.densities != {stored_as(*wanted)}}
            planned = {piece for group in groups for piece in group}
            groups += [[piece] for piece in pieces if piece.path in others and piece not in planned]
        total, end = sum(piece.rows for group in groups for piece in group), 0
        with ProgressBar("levels sealed", total, console) as bar:
            for group in groups:
                end += sum(piece.rows for piece in group)
                seal(split, group, density=wanted, converted=bar.advance)
                bar.advance(end - bar.completed)  # those that had nothing to convert
            if density:
                note_density(split, density, key_every)
    merged = sum(map(len, groups))
    levels, fragments = sum(piece.rows for piece in pieces), len(pieces) - merged + len(groups)
    verb, into = ("rewrote", "as") if density else ("merged", "into")
    done = f"{verb} {many(merged, 'fragment')} {into} {len(groups):,}" if groups else "there was nothing to seal"
    print(f"{as_typed(split)}: {done}; it has {many(levels, 'level')} in {many(fragments, 'fragment')} now.")
    print(f"Next:  levelproof inspect {quoted(split)}")


class _Stopped(Exception):
    """The job ends while a fragment is being sealed."""


@contextmanager
def sealing(split: Path, fragments: Iterable[Fragment], tell: Callable[[str], None]) -> Iterator["Sealer"]:
    """Run a `Sealer` during the `with` block. At its end, seal every full group; if the block fails, stop at once."""
    sealer = Sealer(split, fragments, tell)
    try:
        yield sealer
        sealer.finish()
    finally:
        sealer.stop()


class Sealer:
    """Seals committed fragments in a thread, while the job's workers run.

    An error is reported once and ends the sealing, never the job.
    """

    def __init__(self, split: Path, fragments: Iterable[Fragment], tell: Callable[[str], None]) -> None:
        """`fragments` are those of the split so far; `tell` receives a message for the user."""
        self._split, self._tell = split, tell
        self._pieces = {fragment.path: Piece.of(fragment) for fragment in fragments}
        self._thread, self._stop = ThreadPoolExecutor(1), threading.Event()
        self._running: tuple[list[Piece], Future[Piece]] | None = None
        self._left = 0  # groups to seal when the last seal began, including its own
        self._broken = False

    def committed(self, unit: str, levels: int) -> None:
        """Add the new fragment, of `levels` rows, of the unit of this name; a unit without levels writes none."""
        if levels:
            path = fragment_path(self._split, unit)
            self._pieces[path] = Piece(path, levels, False)

    def advance(self, first: int | None) -> None:
        """Account for a finished seal, and start the next if enough fragments lie below level id `first`.

        No unit below `first` still waits for its first attempt (failed ones may yet commit); None: no unit at all.
        """
        if self._running and not self._running[1].done():
            return
        self._account()
        if self._broken:
            return
        end = None if first is None else fragment_path(self._split, unit_name(first, first))
        groups = store.due((piece for piece in self._pieces.values() if end is None or piece.path < end), store.ROWS)
        self._left = len(groups)
        if groups:
            self._running = groups[0], self._thread.submit(self._seal, groups[0])

    def finish(self, show: Callable[[int], object] = lambda _: None) -> None:
        """Seal every full group; no unit will be committed any more. `show` receives the number of groups left, every
        SHOWN_EVERY seconds."""
        self.advance(None)
        while self._running:
            show(self._left)
            wait([self._running[1]], SHOWN_EVERY)
            self.advance(None)
        show(0)

    def stop(self) -> None:
        """Stop at once and delete a half-written sealed fragment."""
        self._stop.set()
        self._thread.shutdown()

    def _seal(self, group: list[Piece]) -> Piece:
        with explaining_writes(written_disk(self._split)):
            return seal(self._split, group, self._check_stop)

    def _check_stop(self, _: int) -> None:
        if self._stop.is_set():
            raise _Stopped

    def _account(self) -> None:
        if self._running is None:
            return
        (group, future), self._running = self._running, None
        error = future.exception()
        if error is None:
            for piece in group:
                del self._pieces[piece.path]
            self._pieces[future.result().path] = future.result()
            return
        self._broken = True
        reason = str(error) if isinstance(error, LevelproofError) else f"{type(error).__name__}: {error}"
        split = quoted(self._split)
        self._tell(f"Not sealed ({reason.rstrip('.')}): run `levelproof seal {split}` when this job has ended.")

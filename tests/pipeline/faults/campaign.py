"""Running fault schedules: the command with its fault, then the same command again, then a check that the files equal
those of an undisturbed run."""

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from levelproof.configs import compose
from tests.pace import patience
from tests.pipeline.faults.content import Rows, Tree, content_of, differences, require_sound, rows_of
from tests.pipeline.faults.effects import lose_power
from tests.pipeline.faults.process import DRIVER, DRIVER_PID, HAPPENED, ROLES, WORKER, WORKER_PID, Command, Happening
from tests.pipeline.faults.schedules import GENERATE, OPERATIONS, Schedule
from tests.pipeline.servers import Server

SEAL = ("seal", "OUT/128k/s")
ENDS = (0, 1, 2, 3, -signal.SIGKILL, -signal.SIGXFSZ)
NOTHING = Happening()
PAGE = 4096  # bytes
PLENTY = 2**28  # bytes
FULL, ORPHAN, SECOND = "a disk that is really full", "a kill of the driver, the worker goes on", "a second command"


class Undisturbed(NamedTuple):
    """An operation's results and counts without a fault."""

    tree: Tree  # files afterwards
    rows: dict[str, Rows]
    counts: tuple[int, int]  # effects of the driver, of its worker
    requests: int  # to the store
    before: int  # bytes on the disk
    after: int
    largest: int  # bytes of the largest file


class World:
    """The folder or the bucket in which one schedule runs."""

    def __init__(self, top: Path, files: Path, operation: str, server: Server | None = None) -> None:
        """Commands write to `files`, directly or through the store's `server`; `top` has all else."""
        self.top, self.files, self.operation, self.server = top, files, OPERATIONS[operation], server
        self._out = f"s3://bucket/{files.name}" if server else str(files)
        self.commands: list[Command] = []
        top.mkdir(parents=True)

    def start(self, words: tuple[str, ...] = (), happening: Happening = NOTHING, log: Path | None = None) -> Command:
        arguments = [word.replace("OUT", self._out) for word in words or self.operation.words]
        beside = self.operation.beside and not words
        self.commands.append(
            Command(arguments, self.files, self.top / f"output {len(self.commands)}", happening, log, beside)
        )
        return self.commands[-1]

    def whole(self, words: tuple[str, ...] = ()) -> Command:
        """Run a command that must succeed."""
        command = self.start(words)
        assert command.wait() == 0, command.output()
        command.ended()
        return command

    def require_clean_end(self, command: Command) -> None:
        """Check that a command was killed, succeeded, or failed with exactly one sentence."""
        code, output = command.wait(), command.output()
        assert code in ENDS, f"exit code {code}: {output}"
        assert "Traceback" not in output, output
        assert len([line for line in output.splitlines() if line.startswith("Error: ")]) == (code in (1, 2)), output
        assert "--debug" not in output, output


class Campaign:
    """Runs schedules one after another."""

    def __init__(self, folder: Path, server: Server) -> None:
        """`folder` is empty; `server` serves the object store in its subfolder `s3`."""
        self._folder, self._server = folder, server
        self._before: dict[str, Path] = {}
        self._undisturbed: dict[tuple[str, str], Undisturbed] = {}
        (folder / "s3/bucket").mkdir(parents=True)
        for out in (folder / "world/data", "s3://bucket/world"):
            compose.compose_job([*GENERATE[1:], f"out={out}"])  # fills the cache before the process forks
        self._mounts = _can_mount(folder / "probe")

    def run(self, schedule: Schedule) -> bool:
        """Run a schedule; return whether its fault happened before the command ended.

        Raises:
            AssertionError: the fault changed the final files, or the command failed without one sentence.
        """
        whole = self.undisturbed(schedule.operation, schedule.place)
        with self._world(schedule, whole.after if schedule.fault == FULL else 0) as world:
            disturb = _in_its_store if world.server else _in_its_folder
            command = disturb(world, schedule, whole)
            world.require_clean_end(command)
            require_sound(world.files, whole.rows)
            _repeat(world, command, int(schedule.again * whole.counts[DRIVER]))
            content = content_of(world.files)
            assert content == whole.tree, differences(content, whole.tree)
        return bool(command.shared[HAPPENED])

    def undisturbed(self, operation: str, place: str) -> Undisturbed:
        key = operation, place
        if key not in self._undisturbed:
            with self._world(Schedule(0, operation, place, "", "", 0.0, 0.0)) as world:
                before, requests = _size(world.files), self._server.count
                command = world.whole()
                requests = self._server.count - requests
                after = _size(world.files)
                largest = max(path.stat().st_size for path in world.files.rglob("*") if path.is_file())
                if world.operation.beside:
                    world.whole(SEAL)
                counts = command.shared[DRIVER], command.shared[WORKER]
                tree, rows = content_of(world.files), rows_of(world.files)
                self._undisturbed[key] = Undisturbed(tree, rows, counts, requests, before, after, largest)
        return self._undisturbed[key]

    @contextmanager
    def _world(self, schedule: Schedule, room: int = 0) -> Iterator[World]:
        """Yield the world before a schedule; with `room`, bytes, its files are on a small file system of their own."""
        top = self._folder / "world"  # always the same path, because notes contain commands
        stored = schedule.place == "store"
        files = self._folder / "s3/bucket/world" if stored else top / "data"
        world = World(top, files, schedule.operation, self._server if stored else None)
        files.mkdir()
        mounted = room and self._mounts
        try:
            if mounted:
                _mount(files, PLENTY)
            if stored:
                for words in world.operation.before:
                    world.whole(words)
            else:
                shutil.copytree(self._initial_files(schedule.operation), files, dirs_exist_ok=True)
            yield world
        finally:
            _restore(self._server)
            for command in world.commands:
                command.end()
            if mounted:
                subprocess.run(["umount", "--lazy", str(files)], check=True, timeout=patience(1800))
            shutil.rmtree(top)
            if stored:
                shutil.rmtree(files)

    def _initial_files(self, operation: str) -> Path:
        """Return the files that an operation starts from; made once."""
        if operation not in self._before:
            top = self._folder / f"before {len(self._before)}"
            world = World(top, top / "data", operation)
            world.files.mkdir()
            for words in world.operation.before:
                world.whole(words)
            if world.operation.left:
                _leave(world)
            self._before[operation] = world.files
        return self._before[operation]


def _leave(world: World) -> None:
    """Leave the files of processes that died between a shard and its fragment, between a sealed fragment and the
    deletion of those that it replaces, and while writing small files."""
    four = tuple("levels=4" if word.startswith("levels=") else word for word in (*GENERATE, "out=OUT"))
    split, saved = world.files / "128k/s", world.top / "saved"
    world.whole(four)
    shutil.copytree(split, saved)
    dies = Happening("a kill", "worker", when=lambda kind, path: kind == "rename" and path.endswith(".begun"))
    _kill(world, (*GENERATE, "out=OUT"), dies._replace(fault="a kill of all"))
    shutil.copytree(split, world.top / "left")
    shutil.rmtree(split)
    saved.rename(split)
    parquet = lambda kind, path: kind == "unlink" and path.endswith("000000000003.parquet")
    _kill(world, SEAL, Happening("a kill", "driver", when=parquet))
    for path in (world.top / "left").rglob("*"):
        there = split / path.relative_to(world.top / "left")
        if path.is_file() and "000000000004-" in str(there):
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, there)
    for name in (".job.json.123", "manifest/.index.txt.123", "checkpoints/.000000000004-000000000005.npz.123"):
        (split / name).parent.mkdir(exist_ok=True)
        (split / name).write_bytes(b"half")


def _kill(world: World, words: tuple[str, ...], happening: Happening) -> None:
    command = world.start(words, happening)
    command.wait()
    command.ended()
    assert command.shared[HAPPENED], "it was not killed"


def _in_its_folder(world: World, schedule: Schedule, whole: Undisturbed) -> Command:
    fault, whose = schedule.fault, schedule.whose
    at = int(schedule.when * (whole.counts[ROLES[whose]] if whose in ROLES else whole.largest))
    if fault == FULL and world.files.is_mount():
        _resize(world.files, whole.before + PAGE + int(schedule.when * whole.after))
    elif fault == FULL:
        fault, whose, at = "no space from then on", "driver", int(schedule.when * whole.counts[DRIVER])
    log = world.top / "log" if fault == "loss of power" else None
    command = world.start((), Happening(fault, whose, at), log)
    while not command.over():
        if fault == SECOND and command.asks():
            second = world.start()
            world.require_clean_end(second)
            second.ended()
            command.control.send(b"!")
        elif fault == "slow writes":
            require_sound(world.files, whole.rows)
        time.sleep(0.002)
    if fault != ORPHAN:
        command.ended()
    if log and (log.exists() or (at and command.shared[HAPPENED])):  # at 0 nothing has happened yet
        lose_power(log, schedule.seed)
    if fault == FULL:
        command.shared[HAPPENED] = bool(command.wait())
        _resize(world.files, PLENTY)
    return command


def _in_its_store(world: World, schedule: Schedule, whole: Undisturbed) -> Command:
    fault, server = schedule.fault, world.server
    assert server
    begun, at = server.count, 1 + int(schedule.when * (whole.requests - 1))
    asked, answered = threading.Event(), threading.Event()
    every = {"lost answers": "lost", "a busy store": "busy"}.get(fault)
    if every:
        server.spoil(3 + int(3 * schedule.when), every)
    command = world.start()
    command.shared[HAPPENED] = bool(every)

    def meanwhile(count: int) -> None:
        if fault == "a store that is gone from then on" and count - begun >= at:
            server.spoil(1, "gone")
        if count - begun != at:
            return
        command.shared[HAPPENED] = 1
        if fault == "a kill of all":
            command.kill()
        elif "a kill" in fault:
            whose = WORKER_PID if fault == "a kill" and schedule.whose == "worker" else DRIVER_PID
            with suppress(ProcessLookupError):
                os.kill(command.shared[whose] or command.pid, signal.SIGKILL)
        elif fault == SECOND:
            asked.set()
            answered.wait(patience(20))

    server.meanwhile = meanwhile
    while not command.over():
        if asked.is_set() and not answered.is_set():
            second = world.start()
            world.require_clean_end(second)
            second.ended()
            answered.set()
        time.sleep(0.002)
    if fault != ORPHAN:
        command.ended()
    if every:
        assert command.wait() == 0, command.output()
    _restore(server)
    return command


def _repeat(world: World, before: Command, at: int) -> None:
    """Run the same command again; a worker that has outlived its driver continues during effect `at`."""
    command = world.start((), Happening("go on", "driver", at))
    while not command.over():
        if command.asks():
            with suppress(OSError):
                before.control.send(b"!")
        time.sleep(0.002)
    assert command.wait() == 0, f"the second run failed: {command.output()}"
    command.ended()
    before.ended()
    if world.operation.beside:
        world.whole(SEAL)


def _restore(server: Server) -> None:
    server.meanwhile = lambda _: None
    server.spoil(0)


def _size(folder: Path) -> int:
    """Return the bytes that a folder's files take on the disk."""
    return sum(-(-path.stat().st_size // PAGE) * PAGE for path in folder.rglob("*") if path.is_file())


def _can_mount(probe: Path) -> bool:
    probe.mkdir()
    try:
        _mount(probe, PLENTY)
    except (OSError, subprocess.CalledProcessError):
        return False
    subprocess.run(["umount", str(probe)], check=True, timeout=patience(1800))
    return True


def _mount(folder: Path, room: int) -> None:
    options = ["mount", "-t", "tmpfs", "-o", f"size={room}", "tmpfs", str(folder)]
    subprocess.run(options, check=True, capture_output=True, timeout=patience(1800))


def _resize(folder: Path, room: int) -> None:
    subprocess.run(
        ["mount", "-o", f"remount,size={room}", str(folder)], check=True, capture_output=True, timeout=patience(1800)
    )

"""Temporary folders of killed processes are removed, and those of live ones stay."""

import errno
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from levelproof.pipeline.errors import UserError
from levelproof.pipeline.store import machine
from levelproof.pipeline.store import scratch as module
from levelproof.pipeline.store.created import new_folder
from levelproof.pipeline.store.scratch import FILES, LOCK, PREFIX, scratch
from tests.pace import patience
from tests.pipeline.command import COMMAND_SECONDS, ROOT, line_of

PUBLISH = """
from pathlib import Path
from levelproof.pipeline.store.publish import publishing
with publishing(Path("s3://bucket/data/128k/s")) as folder:
    (folder / "shard").write_bytes(bytes(1000))
    print(folder, flush=True)
    input()
"""
EXPORT = """
import sys
from pathlib import Path
from levelproof.pipeline.store.created import new_folder
with new_folder(Path(sys.argv[1])) as folder:
    (folder / "part").write_bytes(bytes(1000))
    print(folder, flush=True)
    input()
"""
CROWD = """
import sys
from pathlib import Path
from levelproof.pipeline.store.scratch import _sweep_once, scratch
for i in range(int(sys.argv[1])):
    _sweep_once.cache_clear()
    with scratch() as folder:
        (folder / "file").write_text(str(i))
        _sweep_once.cache_clear()
        _sweep_once(folder.parent.parent, "levelproof-scratch-")
        assert (folder / "file").read_text() == str(i)
"""


@contextmanager
def process(program: str, temporary: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """Start a process that runs this program until it is killed, and return the folder that it made."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(temporary)}
    command = [sys.executable, "-c", program, *arguments]
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        try:
            made = Path(line_of(running, running.stdout).strip())
            assert made.is_dir()
            yield running, made
        finally:
            running.kill()


@pytest.fixture
def parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder for temporary files that this process has not swept yet."""
    monkeypatch.setattr(module, "gettempdir", lambda: str(tmp_path))
    module._sweep_once.cache_clear()
    return tmp_path


def test_scratch_removes_only_folders_of_killed_processes(parent: Path) -> None:
    with process(PUBLISH, parent) as (killed, gone), process(PUBLISH, parent) as (_, alive):
        killed.kill()
        killed.wait(patience(COMMAND_SECONDS))
        assert (gone / "shard").exists()
        with scratch() as folder:
            assert not gone.parent.exists()
            assert (alive / "shard").exists()
            assert {*parent.iterdir()} == {alive.parent, folder.parent}
        assert [*parent.iterdir()] == [alive.parent]


def test_new_folder_removes_what_a_killed_export_left(parent: Path) -> None:
    out = parent / "levels"
    with process(EXPORT, parent, str(out)) as (killed, gone):
        killed.kill()
        killed.wait(patience(COMMAND_SECONDS))
        assert (gone / "part").exists()
    with new_folder(out) as folder:
        (folder / "part").touch()
    assert [*parent.iterdir()] == [out]
    assert [*out.iterdir()] == [out / "part"]


def left(folder: Path, machine: dict[str, str] | None = None) -> Path:
    """Make a folder as a killed process leaves it."""
    (folder / FILES).mkdir(parents=True)
    (folder / FILES / "file").touch()
    (folder / LOCK).write_text(json.dumps(module._machine() if machine is None else machine))
    return folder


def test_sweep_keeps_folders_that_no_dead_local_process_left(
    parent: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    target = left(elsewhere / "target")
    (parent / f"{PREFIX}link").symlink_to(target)
    lock = left(parent / f"{PREFIX}lock") / LOCK
    lock.unlink()
    lock.symlink_to(target / LOCK)
    pipe = left(parent / f"{PREFIX}pipe") / LOCK
    pipe.unlink()
    os.mkfifo(pipe)
    left(parent / f"{PREFIX}other", {"host": "another", "boot": "another"})
    left(parent / f"{PREFIX}nameless", {"host": "", "boot": ""})
    left(parent / f"{PREFIX}namesake", {"host": socket.gethostname(), "boot": "another"})
    (left(parent / f"{PREFIX}lockless") / LOCK).unlink()
    left(parent / "levelproof-data")
    before = {path: path.is_symlink() or [*path.rglob("*")] for path in parent.iterdir()}
    with scratch():
        pass
    assert {path: path.is_symlink() or [*path.rglob("*")] for path in parent.iterdir()} == before
    assert (target / FILES / "file").exists()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
def test_sweep_keeps_folders_of_other_users(parent: Path) -> None:
    folder = left(parent / f"{PREFIX}theirs")
    os.chown(folder, 12345, 12345)
    with scratch():
        pass
    assert (folder / FILES / "file").exists()


def test_sweep_compares_host_names_if_there_are_no_boot_ids(parent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "BOOT_ID", parent / "none")
    other = left(parent / f"{PREFIX}other", {"host": "another", "boot": ""})
    left(parent / f"{PREFIX}own")
    with scratch() as folder:
        assert {*parent.iterdir()} == {other, folder.parent}


def test_sweep_removes_half_made_folders(parent: Path) -> None:
    (parent / f"{PREFIX}empty").mkdir()
    (parent / f"{PREFIX}unlocked").mkdir()
    (parent / f"{PREFIX}unlocked" / LOCK).touch()
    with scratch() as folder:
        assert [*parent.iterdir()] == [folder.parent]


def test_concurrent_processes_keep_their_own_folders(parent: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(parent)}

    def crowd(_: int) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", CROWD, "200"]
        return subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False, timeout=patience(1800)
        )

    with ThreadPoolExecutor(4) as threads:
        for done in threads.map(crowd, range(4)):
            assert done.returncode == 0, done.stderr
    assert not [*parent.iterdir()]


def test_new_folder_restores_what_it_could_not_replace(parent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = parent / "out"
    (out / "old").mkdir(parents=True)
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.name == "files":
            raise OSError(errno.EIO, "broken")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(UserError, match="Cannot write"), new_folder(out, lambda _: True) as folder:
        (folder / "new").mkdir()
    assert [*parent.iterdir()] == [out]
    assert (out / "old").is_dir()

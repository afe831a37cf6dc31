"""What a worker checks before it begins: that it runs the driver's program, so that its levels equal those of any
other worker, and that it sees the driver's split.
"""

import hashlib
import socket
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.store.leases import is_written_by
from levelproof.pipeline.store.provenance import learned_with, versions
from levelproof.pipeline.store.remote import absolute
from levelproof.pipeline.urls import as_typed, is_remote

Versions = dict[str, str]  # and hashes, by name
COMPARED = ("levelproof", "jax", "jaxlib", "sampler")  # names in `provenance.versions`
UNSEEN = 60  # s until a machine that does not see the split is left out
FOLDERS = ("physics", "levelgen", "experts", "configs", "pipeline")
ROOT = Path(__file__).parents[2]


def versions_of(job: JobConfig) -> Versions:
    """Return the versions and hashes that must be equal in all processes that make a job's levels."""
    known = {name: str(versions()[name]) for name in COMPARED}
    return known | learned_with() | {"source": _source(), "configuration": job.hash}


def mismatch(theirs: Versions, job: JobConfig) -> str:
    """Return a sentence on what differs between this worker's versions and the driver's (`theirs`); empty: nothing."""
    here = versions_of(job)
    for name, there in theirs.items():
        if here.get(name) != there:
            return (
                f"The worker on {socket.gethostname()} has {name} {here.get(name, 'unknown')}, and this command {name} "
                f"{there}: install the same levelproof and libraries there (it imports {ROOT}), restart its Ray, and "
                "run the same command."
            )
    return ""


def unseen(split: Path, writer: str) -> str:
    """Return a sentence if this machine does not see the folder in which the driver is the writer; empty: it does."""
    if not writer or is_remote(split):
        return ""
    until = time.monotonic() + UNSEEN
    while not _sees(split, writer):  # a network's file system may remember for a while that there was no such folder
        if time.monotonic() > until:
            return (
                f"The worker on {socket.gethostname()} does not see this command's {split}: use a folder that all "
                "machines share, or the URL of an object store, as out."
            )
        time.sleep(0.5)
    return ""


def _sees(split: Path, writer: str) -> bool:
    try:
        return is_written_by(split, writer)
    except OSError:  # permissions, or a file in place of a folder
        return False


def with_absolute_paths(job: JobConfig) -> JobConfig:
    """Make a job's paths absolute, because workers run in another folder."""
    resolve = lambda path: path and as_typed(absolute(Path(path)))
    return replace(job, out=resolve(job.out), continue_from=resolve(job.continue_from))


@cache
def _source() -> str:
    """Return a digest of this program's source files, because two checkouts may have the same version."""
    digest = hashlib.sha256()
    for path in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")):
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:8]

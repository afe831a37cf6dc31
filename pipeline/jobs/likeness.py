"""Whether a worker's program is the driver's: only then are its levels those of any other worker."""

import hashlib
import socket
from dataclasses import replace
from functools import cache
from pathlib import Path

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.store.provenance import versions
from levelproof.pipeline.store.remote import absolute, as_typed

Program = dict[str, str]  # versions by name
SAME = ("levelproof", "jax", "jaxlib", "sampler")  # of `provenance.versions`
FOLDERS = ("physics", "levelgen", "experts", "configs", "pipeline")


def program_of(job: JobConfig) -> Program:
    """What has to be the same where a job's levels are made."""
    known = {name: str(versions()[name]) for name in SAME}
    return known | {"source": _source(), "configuration": job.hash}


def unlike(program: Program, job: JobConfig) -> str:
    """What differs between this program, of a worker, and the driver's, in a sentence; empty: nothing."""
    here = program_of(job)
    for name, there in program.items():
        if here.get(name) != there:
            return (
                f"The worker on {socket.gethostname()} has {name} {here.get(name, 'unknown')}, and this command {name} "
                f"{there}: install the same levelproof there, start its Ray again, and run the same command."
            )
    return ""


def seen_from_elsewhere(job: JobConfig) -> JobConfig:
    """The job as a worker in another folder has to read it: no path is relative."""
    known = lambda path: path and as_typed(absolute(Path(path)))
    return replace(job, out=known(job.out), continue_from=known(job.continue_from))


@cache
def _source() -> str:
    """A digest of this program's files: two checkouts may have one version."""
    digest, root = hashlib.sha256(), Path(__file__).parents[2]
    for path in sorted(path for folder in FOLDERS for path in (root / folder).rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:8]

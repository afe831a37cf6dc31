"""Compiling a job's programs before its first level: one worker of a machine compiles each, the slow ones first."""

import hashlib
import time
from contextlib import suppress
from pathlib import Path

from levelproof.configs.schema import JobConfig
from levelproof.experts.pool.pool import Pool
from levelproof.experts.pool.programs import Program, ids_of, programs_of
from levelproof.levelgen.level import size_of
from levelproof.levelgen.programs import SOURCES, machine
from levelproof.levelgen.sampling.sampler import CHUNK, sample_chunk
from levelproof.physics.codegen.kept import key_by_sources
from levelproof.pipeline.claims import try_claim
from levelproof.pipeline.jobs.likeness import versions_of
from levelproof.pipeline.runtime import cache_folder
from levelproof.pipeline.store.provenance import device

DONE = b"compiled"  # content of the claim of a compiled program


class Ahead:
    """The programs of a job, of which this process compiles those that no other process of this machine does.

    Threads may share it: XLA compiles their programs side by side. A caller that needs a program which another process
    is compiling waits for it (`claims.share_compiling`).
    """

    def __init__(self, job: JobConfig, pool: Pool) -> None:
        folder, programs = cache_folder() / "jax", [*programs_of(pool, size_of(job.size)), *_sampling(job)]
        search = job.search.scaled(size_of(job.size).bodies)
        of_code = [entry for entry in versions_of(job).items() if entry[0] != "configuration"]
        settings = job.size, job.expert, search.endless, search.robustness, job.task, of_code, device()
        request = f"{settings} {machine()}"
        key = key_by_sources(request, SOURCES) or request
        self._seconds: list[float] = []  # time of each program that this process has compiled
        self._programs = {_claim(folder, program, key): program for program in programs}

    def compile_next(self) -> tuple[int, int] | None:
        """Compile the first program that no process has compiled or compiles now; return `compiled` then.

        Returns None if there was no such program.
        """
        for path, program in self._programs.items():
            with suppress(OSError):  # a folder that cannot be written to, or has no locks: compile when needed
                if not _is_done(path) and (file := try_claim(path)):
                    with file:
                        if not _is_done(path):  # another process may have compiled it by now
                            self._compile(program)
                            file.truncate(0)
                            file.write(DONE)
                    return self.compiled
        return None

    def _compile(self, program: Program) -> None:
        begun = time.perf_counter()
        program.prepare()
        self._seconds.append(time.perf_counter() - begun)

    @property
    def compiling(self) -> float:
        """Seconds that this process has compiled, in all its threads."""
        return sum(self._seconds)

    @property
    def left(self) -> bool:
        """Whether a program is not compiled yet."""
        done, programs = self.compiled
        return done < programs

    @property
    def compiled(self) -> tuple[int, int]:
        """Number of compiled programs, and of all."""
        return sum(map(_is_done, self._programs)), len(self._programs)


def _sampling(job: JobConfig) -> list[Program]:
    """Return the program that samples levels, unless they come from files."""
    settings = size_of(job.size), job.distribution
    program = Program(sample_chunk, lambda: ((ids_of(CHUNK), *settings), {}), f"of {job.distribution}")
    return [] if job.level_files else [program]


def _claim(folder: Path, program: Program, key: str) -> Path:
    return folder / f"{hashlib.sha256(f'{program.name} {key}'.encode()).hexdigest()}.ahead"


def _is_done(path: Path) -> bool:
    return path.exists() and path.stat().st_size == len(DONE)

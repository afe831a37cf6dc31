"""The choice of a job's executor: small jobs run in the command's own process, large ones on Ray's workers."""

from dataclasses import replace

from levelproof.configs.numbers import parse_count
from levelproof.configs.schema import GrowConfig, JobConfig
from levelproof.pipeline.jobs.address import ray_address
from levelproof.pipeline.runtime import own_cores

MANY = 16  # levels; a job of fewer may compile programs that it does not use, and leave slots of its programs empty
MAX_THREADS = 6  # workers in one process: Python, unlike compiled code, runs in one thread at a time
PARTS = 2  # maximum workers per untimed work unit; with more, most slots would be empty and units tiny
SMALL = 2  # untimed work units; a process makes them in the time in which Ray and its workers start
DEFAULT_BUDGET = parse_count(JobConfig.budget, "budget")  # env steps; the search, which it does not limit, takes longer


def runs_here(job: JobConfig, levels: int) -> bool:
    """Return whether the command's own process makes the job's levels.

    Args:
        job: its executor decides, unless that is "auto". Then the job runs here if RAY_ADDRESS is unset, the job asks
            for no GPU and no second worker, and the product of levels and budget is small.
        levels: number of levels to make.
    """
    if job.executor != "auto":
        return job.executor == "inline"
    if ray_address() or job.device == "gpu" or job.workers > 1:
        return False
    unit = replace(job, unit=None).levels_per_unit
    # To grow a level costs the same whatever its expert's budget was
    budget = DEFAULT_BUDGET if isinstance(job, GrowConfig) else max(job.env_steps, DEFAULT_BUDGET)
    return levels * budget <= SMALL * unit * DEFAULT_BUDGET


def most_workers(job: JobConfig, levels: int) -> int:
    """Return the number of Ray workers that a job can use: `job.workers`, or fewer if it has few levels.

    Each needs the levels of a work unit or, if units are timed, of half an untimed one (cut into smaller units).
    """
    parts = 1 if job.unit or isinstance(job, GrowConfig) else PARTS  # records grow within milliseconds
    each = max(1, job.levels_per_unit // parts)
    occupied = -(-levels // each)
    return max(1, min(job.workers or occupied, occupied))


def workers_here(job: JobConfig, levels: int) -> int:
    """Return the number of workers of a job that runs in the command's own process, each in a thread of its own.

    Args:
        job: a job for which `runs_here` is True.
        levels: number of levels to make.
    """
    if job.device == "gpu":
        return 1
    most = min(job.workers or MAX_THREADS, len(own_cores()), MAX_THREADS)
    return max(1, min(most, levels // MANY))

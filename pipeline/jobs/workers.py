"""Choice of a job's worker, so that executors need not know the kind of job."""

from pathlib import Path

from levelproof.configs.schema import GrowConfig, JobConfig
from levelproof.pipeline.jobs.grower import Grower
from levelproof.pipeline.jobs.worker import Worker


def worker_for(job: JobConfig, split: Path) -> Worker | Grower:
    """Return a worker of this process for a job."""
    return Grower(job, split) if isinstance(job, GrowConfig) else Worker(job, split)

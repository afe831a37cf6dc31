"""Provenance of a row: the stack that made it, its versions and device.

Sampling and replaying give the same bits on every CPU; training repeats on the same stack only.
"""

import functools
import platform
from importlib.metadata import version
from pathlib import Path

from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.pipeline.version import __version__


@functools.cache
def versions() -> dict[str, str | int]:
    """Return the manifest's `versions`."""
    return {
        "levelproof": __version__,
        "python": platform.python_version(),
        "jax": version("jax"),
        "jaxlib": version("jaxlib"),
        "sampler": SAMPLER_VERSION,
    }


@functools.cache
def learned_with() -> dict[str, str]:
    """Return the versions of further libraries that decide the bits of training; the manifest leaves them out."""
    return {name: version(name) for name in ("numpy", "flax", "optax")}


@functools.cache
def device() -> str:
    """Name the kind of device that JAX uses here, such as `cpu: AMD EPYC 7B13`."""
    import jax  # starts JAX's backend, so only on a worker

    first = jax.devices()[0]
    return f"{first.platform}: {_processor() if first.platform == 'cpu' else first.device_kind}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()

"""Other processors, as far as this one can play them: LLVM and XLA are told to use no newer instructions than theirs.

A test runs a module in a process of its own, `python -m MODULE PROCESSOR ...`, whose main part calls `become` before
it computes, and compares what it prints.
"""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from llvmlite import binding

from tests.pace import patience

ROOT = Path(__file__).parents[1]
OWN = "own"
# {name: (LLVM's processor, XLA's newest instruction set)}; fused operations begin with AVX2's generation
X86 = {
    "baseline": ("x86-64", "SSE4_2"),
    "sse4.2": ("nehalem", "SSE4_2"),
    "avx": ("sandybridge", "AVX"),
    "avx2": ("haswell", "AVX2"),
    OWN: ("", ""),
}
PROCESSORS = X86 if platform.machine() in ("x86_64", "AMD64") else {OWN: ("", "")}
MORE = pytest.mark.campaign
OLD = [pytest.param(name, marks=() if name == "sse4.2" else MORE) for name in PROCESSORS if name != OWN]


class NoFeatures:
    """What a processor has beyond its model: nothing."""

    def flatten(self) -> str:
        return ""


def become(name: str) -> None:
    """Make LLVM compile for another processor in this process."""
    model, _ = PROCESSORS[name]
    if model:
        binding.get_host_cpu_name = lambda: model
        binding.get_host_cpu_features = NoFeatures


def run_on(name: str, module: str, *arguments: str, python: str | Path = sys.executable) -> str:
    """Run a module in a process that poses as this processor, without a cache of programs; return what it prints."""
    _, newest = PROCESSORS[name]
    flags = [os.environ.get("XLA_FLAGS", ""), *([f"--xla_cpu_max_isa={newest}"] if newest else [])]
    environment = os.environ | {"XLA_FLAGS": " ".join(flags).strip(), "JAX_ENABLE_COMPILATION_CACHE": "false"}
    command = [python, "-m", module, name, *arguments]
    ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=patience(1800))
    assert not ran.returncode, ran.stderr
    return ran.stdout.strip()

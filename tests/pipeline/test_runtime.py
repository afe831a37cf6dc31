"""JAX in a worker: one thread, no deadlock, cached programs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from levelproof.pipeline import runtime
from levelproof.pipeline.runtime import CACHE_VARIABLE, XLA_FLAGS, cache_folder, own_cores
from tests.pace import patience
from tests.pipeline.command import ROOT, line_of

# Orthogonal weights of several layers for several experts: batched QR factorisations in one program
FACTORISE = """
from levelproof.pipeline.runtime import prepare_jax
prepare_jax()
import jax
layer = jax.nn.initializers.orthogonal()
layers = jax.jit(jax.vmap(lambda key: [layer(k, (n, 64)) for k, n in zip(jax.random.split(key, 6), (140, 64, 64) * 2)]))
for i in range(300):
    jax.block_until_ready(layers(jax.random.split(jax.random.key(i), 4)))
"""

COUNT = """
from levelproof.pipeline.runtime import prepare_jax
prepare_jax()
import jax, os
jax.block_until_ready(jax.jit(lambda x: x @ x)(jax.numpy.ones((512, 512))))
print(sum(open(f"/proc/self/task/{t}/comm").read().startswith("tf_XLAEigen") for t in os.listdir("/proc/self/task")))
"""


def python(program: str, folder: Path, **environment: str) -> str:
    ours = {CACHE_VARIABLE: str(folder), "PYTHONPATH": str(ROOT)} | environment
    inherited = {k: v for k, v in os.environ.items() if k not in ("NPROC", "PJRT_NPROC", "XLA_FLAGS")}
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, env=inherited | ours, capture_output=True, text=True, timeout=patience(120), check=True
    )
    return done.stdout


@pytest.mark.slow
def test_batched_factorisations_do_not_deadlock(tmp_path: Path) -> None:
    python(FACTORISE, tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_xla_computes_on_one_thread(tmp_path: Path) -> None:
    assert int(python(COUNT, tmp_path)) <= 1


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no affinity")
def test_pin_skips_threads_that_have_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    pinned: list[int] = []

    def pin(thread: int, cores: set[int]) -> None:
        if thread == 1:
            raise ProcessLookupError
        pinned.append(thread)

    monkeypatch.setattr(os, "listdir", lambda _: ["1", "2"])
    monkeypatch.setattr(os, "sched_setaffinity", pin)
    runtime._pin(0)
    assert pinned == [2]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux" or len(own_cores()) < 2, reason="reads /proc; needs a second core")
def test_own_core_pins_no_worker_if_cores_are_left_over(tmp_path: Path) -> None:
    program = (
        "from levelproof.pipeline.runtime import own_core, prepare_jax; prepare_jax(own_core(1)); "
        "import os; print(*os.sched_getaffinity(0))"
    )
    one, two = (set(python(program, tmp_path).split()) for _ in range(2))
    assert len(one | two) > 1


def test_prepare_jax_keeps_the_users_flags(tmp_path: Path) -> None:
    program = (
        "from levelproof.pipeline.runtime import prepare_jax as prepare; prepare(); prepare(); "
        "import os; print(os.environ['XLA_FLAGS'])"
    )
    flags = python(program, tmp_path, XLA_FLAGS="--xla_dump_to=/nowhere").split()
    assert flags == ["--xla_dump_to=/nowhere", *XLA_FLAGS]


def test_prepare_jax_caches_programs_in_the_chosen_folder(tmp_path: Path) -> None:
    """Small ones, too, which take longer to compile than to load."""
    program = "from levelproof.pipeline.runtime import prepare_jax; prepare_jax(); import jax; "
    python(program + "jax.jit(lambda x: x + 1)(1.0)", tmp_path)
    assert list((tmp_path / "jax").glob("*-cache"))


def test_cache_folder_is_the_users_unless_it_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CACHE_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    if sys.platform == "linux":
        assert cache_folder() == Path("/somewhere/levelproof")
    monkeypatch.setenv(CACHE_VARIABLE, "~/here")
    assert cache_folder() == Path.home() / "here"


@pytest.mark.parametrize("quota", [64, 4, 1])
def test_own_cores_respect_a_containers_quota(monkeypatch: pytest.MonkeyPatch, quota: int) -> None:
    monkeypatch.setattr(runtime, "_allowed_cores", lambda: list(range(64)))
    monkeypatch.setattr(runtime, "cpu_count", lambda: quota)
    assert len(own_cores()) == quota
    pinned = quota == 64  # under a quota, other containers would use the same cores
    assert (runtime.own_core(64) is not None) == pinned
    assert runtime.own_core(63) is None
    while runtime.CLAIMS:
        runtime.CLAIMS.pop().close()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's CPU affinity")
def test_own_core_gives_each_worker_another_core(tmp_path: Path) -> None:
    """The affinity mask omits some cores; a worker's core is free again when it has died."""
    program = (
        "import sys; from levelproof.pipeline import runtime; runtime._allowed_cores = lambda: [5, 7]; "
        "runtime.cpu_count = lambda: 64; print(runtime.own_core(2), flush=True); sys.stdin.read()"
    )
    start = lambda: subprocess.Popen(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with start() as one, start() as two, start() as three:
        cores = sorted(line_of(each, each.stdout).strip() for each in (one, two, three))
        assert cores == ["5", "7", "None"]
        one.kill()
        two.kill()
        three.kill()
    with start() as again:
        assert line_of(again, again.stdout).strip() == "5"
        again.kill()


def test_prepare_jax_overrides_settings_that_change_results(tmp_path: Path) -> None:
    program = (
        "from levelproof.pipeline.runtime import prepare_jax, JAX_SETTINGS; prepare_jax(); import jax; "
        "print(all(jax.config.values[name] == value for name, value in JAX_SETTINGS.items()))"
    )
    theirs = {
        "JAX_ENABLE_X64": "1",
        "JAX_DEFAULT_MATMUL_PRECISION": "BF16_BF16_F32",
        "JAX_NUMPY_DTYPE_PROMOTION": "strict",
        "JAX_NUMPY_RANK_PROMOTION": "raise",
        "JAX_DISABLE_JIT": "1",
        "JAX_DEBUG_NANS": "1",
        "JAX_CPU_ENABLE_ASYNC_DISPATCH": "1",
    }
    assert python(program, tmp_path, **theirs).strip() == "True"


@pytest.mark.parametrize("device", ["'cpu'", "None", "'gpu'"])
def test_prepare_jax_ignores_gpus_unless_they_are_asked_for(tmp_path: Path, device: str) -> None:
    program = (
        "from levelproof.pipeline.runtime import prepare_jax; import jax; "
        f"prepare_jax(); prepare_jax(device={device}); "
        "print(jax.config.jax_platforms); jax.config.jax_platforms and print(jax.default_backend())"
    )
    unset = python(program, tmp_path, JAX_PLATFORMS="").split()
    assert unset == ([] if device == "'gpu'" else ["cpu", "cpu"])
    if device == "'cpu'":
        assert python(program, tmp_path, JAX_PLATFORMS="cuda,cpu").split() == ["cpu", "cpu"]

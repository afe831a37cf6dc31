"""A level is its id, bit for bit: on other processors, among any number of others, and in later versions."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.configs.compose import distributions
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.draws import stream_key, uniform
from levelproof.levelgen.sampling.sampler import CHUNK, as_level, kernel_of, sample_levels, sampler
from tests import arm
from tests.golden.make_levels import FILE
from tests.levelgen.sampling.bits import COUNT, digest, digests
from tests.processors import OLD, OWN, run_on

GOLDEN: dict[str, list[str]] = json.loads(FILE.read_text())
DEFAULTS = [f"{size}/kinetix" for size in SIZES]


@pytest.mark.parametrize("name", DEFAULTS)
def test_levels_have_their_golden_bits(name: str) -> None:
    """If they change, increment SAMPLER_VERSION."""
    assert digests(*name.split("/"), CHUNK) == GOLDEN[name][:1]


@pytest.mark.campaign
@pytest.mark.parametrize("processor", [*(old.values[0] for old in OLD), OWN])
def test_levels_of_all_presets_have_their_golden_bits(processor: str) -> None:
    assert json.loads(run_on(processor, "tests.levelgen.sampling.bits", str(COUNT), *GOLDEN)) == GOLDEN


@arm.needs_emulator
@pytest.mark.campaign
@pytest.mark.parametrize("cpu", arm.EMULATED)
@pytest.mark.parametrize("name", [name for name in GOLDEN if name in DEFAULTS or name.startswith("s/")])
def test_levels_have_their_golden_bits_on_an_emulated_arm_processor(name: str, cpu: str, tmp_path: Path) -> None:
    size, preset = name.split("/")
    emulated = arm.Emulated(kernel_of(SIZES[size], distributions()[preset]), cpu, tmp_path)
    level = as_level(emulated(np.arange(CHUNK, dtype=np.int32)), SIZES[size], CHUNK)
    assert digest(level) == GOLDEN[name][0]


@pytest.mark.slow
@pytest.mark.parametrize("triple", arm.TARGETS)
def test_arm_code_of_the_sampler_fuses_nothing(triple: str) -> None:
    arm.assert_portable(kernel_of(SIZES["s"], Distribution()), triple)


@pytest.mark.slow
def test_level_depends_on_its_id_alone() -> None:
    """Bit for bit, whatever other levels are sampled, in any order, number and position, inside jax.jit or not."""
    ids = np.array([5, 3, 5, CHUNK + 2, 0])
    many = sample_levels(np.arange(CHUNK + 3), "s")
    few = sample_levels(ids, "s")
    sample = sampler("s")
    mapped = jax.jit(jax.vmap(sample))(jnp.asarray(ids))
    nested = jax.jit(jax.vmap(jax.vmap(sample)))(jnp.asarray(ids[:4]).reshape(2, 2))
    alone = jax.jit(sample)(ids[3])
    for x, y, m, n, a in zip(*map(jax.tree.leaves, (many, few, mapped, nested, alone)), strict=True):
        assert x.dtype == y.dtype == m.dtype
        np.testing.assert_array_equal(x[..., ids], y)
        np.testing.assert_array_equal(y, np.moveaxis(m, 0, -1))
        np.testing.assert_array_equal(np.asarray(m)[:4], n.reshape(4, *n.shape[2:]))
        np.testing.assert_array_equal(y[..., 3], a)


def test_keys_and_numbers_are_those_of_jax() -> None:
    ids = jnp.array([0, 1, 7, 2**31 - 1], jnp.int32)
    keys = jax.vmap(lambda level_id: key_for(level_id, Stream.LEVEL))(ids)
    ours = stream_key(ids, Stream.LEVEL)
    np.testing.assert_array_equal(np.stack(ours, -1).view(np.uint32), jax.random.key_data(keys))
    index = jnp.arange(50, dtype=jnp.int32)[:, None] + jnp.zeros_like(ids)
    theirs = jax.vmap(lambda key: jax.random.uniform(key, (50,)), out_axes=1)(keys)
    np.testing.assert_array_equal(uniform(ours, index), theirs)


@pytest.mark.campaign
@pytest.mark.parametrize("size", ["s", "m"])
def test_xla_makes_the_same_levels_except_for_the_last_digits(size: str) -> None:
    """A GPU runs XLA instead of our machine code: levels have the same parts, and their numbers are nearly equal."""
    ids = jnp.arange(32, dtype=jnp.int32)
    rows, collides = jax.jit(lambda ids: kernel_of(SIZES[size], Distribution()).on_all_lanes(ids, len(ids)))(ids)
    level = sample_levels(ids, size)
    np.testing.assert_array_equal(collides, level.model.collides)
    for name, theirs in rows._asdict().items():
        part = next(x for x in (level, level.model, level.state) if hasattr(x, name))
        close = 1e-4 if theirs.dtype == np.float32 else 0  # inertia grows with the fourth power of sizes
        np.testing.assert_allclose(theirs, getattr(part, name), rtol=close, atol=1e-5 if close else 0, err_msg=name)


def test_keys_draw_ids_below_those_kept_for_evaluation() -> None:
    sample = sampler("s")
    ids = jax.vmap(sample.draw_id)(jax.random.split(jax.random.key(0), 1000))
    assert 0 <= ids.min() < 2**26
    assert 2**30 - 2**26 < ids.max() < 2**30
    level = jax.jit(sample)(jax.random.key(5))
    theirs = jax.jit(sample)(sample.draw_id(jax.random.key(5)))
    assert all(map(np.array_equal, jax.tree.leaves(level), jax.tree.leaves(theirs)))


def test_sampler_refuses_sizes_without_a_goal() -> None:
    with pytest.raises(ValueError, match="leave no room for"):
        sampler("4-1-1-1")
    with pytest.raises(ValueError, match="size is 'tiny'"):
        sampler("tiny")

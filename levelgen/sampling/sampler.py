"""Random levels from level ids: by the thousand outside of `jax.jit`, and within it as a function of ids or keys.

The sampler is a kernel like the physics step (`physics.lanes`): machine code that computes the same bits on every
processor, or XLA operations on devices without it. `sampling.block` has the order of its moves.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key
from numpy.typing import ArrayLike

from levelproof.levelgen.identity.keys import FRESH_BITS, Stream, level_id_array
from levelproof.levelgen.level import KERNEL_SOURCES, Level, name_of, size_of
from levelproof.levelgen.programs import jit_sooner
from levelproof.levelgen.sampling.block import GOAL_BODIES, Results, Workspace, layout_of, sample_block, scratch_of
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.draft import SCENERY, SceneryTable, clear
from levelproof.levelgen.sampling.draws import draw, stream_key
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.vmapped import single
from levelproof.physics.bounds import require_32_bits
from levelproof.physics.buffers import buffers_of
from levelproof.physics.codegen.buffers import Buffer
from levelproof.physics.codegen.call import Compiled, Kernel, by_platform, compiled_once
from levelproof.physics.lanes import Ref
from levelproof.physics.types import FIXED_POLYGONS, Size

CHUNK = 256  # levels per call of the compiled program, which is padded to this
FRESH_IDS = 1 << FRESH_BITS  # fresh levels have lower ids; the levels that policies are measured on have higher ones
DEFAULT = Distribution()


def sample_levels(level_ids: ArrayLike, size: Size | str, distribution: Distribution = DEFAULT) -> Level:
    """Sample the levels with these ids: float32 and int32 arrays in SI units, level axis last.

    A level depends only on its id, the size, `SAMPLER_VERSION` and the distribution: one compiled program samples any
    number of ids in chunks of CHUNK. So call this outside `jax.jit`.

    Args:
        level_ids: integers from 0 to MAX_LEVEL_ID, in any order.
        size: capacity of a level: the name of one of SIZES such as "s", four numbers as in "8-8-8-4", or a Size.
        distribution: the distribution of random levels.

    Raises:
        ValueError: the size's name is unknown, or it has no room for the scenery, a green and a blue body; the ids are
            not a list of integers, or one is not 0 .. MAX_LEVEL_ID; the distribution is a name; or `jax_enable_x64` is
            on.
    """
    size = _checked(size, distribution)
    ids = level_id_array(level_ids)
    padded = np.resize(ids, (max(1, -(-len(ids) // CHUNK)), CHUNK))
    chunks = [sample_chunk(chunk, size, distribution) for chunk in padded]
    return jax.device_put(jax.tree.map(lambda *parts: np.concatenate(parts, -1)[..., : len(ids)], *chunks))


def _is_key(level: Array) -> bool:
    """Whether this is a random key, with its own dtype or as `jax.random.PRNGKey` makes them, not a level id."""
    return jnp.issubdtype(level.dtype, jax.dtypes.prng_key) or (level.shape, level.dtype) == ((2,), jnp.uint32)


def check_size(size: Size) -> None:
    """Raise ValueError if no level of this size can have a goal."""
    if size.polygons < FIXED_POLYGONS or size.bodies < FIXED_POLYGONS + GOAL_BODIES or min(size) < 0:
        raise ValueError(
            f"size is {name_of(size)}: {size.polygons} polygons and {size.circles} circles leave no room for the "
            f"{FIXED_POLYGONS} polygons of the scenery, a green and a blue body"
        )


def sampler(size: Size | str, distribution: Distribution = DEFAULT) -> "Sampler":
    """Return the sampler of a size as a function of one level id or key, for use within `jax.jit` and `jax.vmap`.

    Raises:
        ValueError: as in `sample_levels`, except for ids.
    """
    return Sampler(_checked(size, distribution), distribution)


def _checked(size: Size | str, distribution: Distribution) -> Size:
    """Return the size. Raise ValueError as `sample_levels`, except for ids."""
    require_32_bits()
    if not isinstance(distribution, Distribution):
        raise ValueError(
            f"distribution is {distribution!r}, but must be a Distribution; levelproof.make takes names of presets"
        )
    size = size_of(size)
    check_size(size)
    return size


@jax.tree_util.register_static
@dataclass(frozen=True)
class Sampler:
    """Random levels of a size and a distribution, as a function that JAX traces.

    `sampler(level_id)` is the level with this id, without a level axis; `sampler(key)` is that of an id drawn from the
    key. `jax.vmap` maps both, as fast as `lanes`, which samples many ids, level axis last. An id, which must be
    0 .. MAX_LEVEL_ID, gives the same bits here and in `sample_levels`, however many others are sampled with it.

    To JAX, a sampler is a constant without arrays.
    """

    size: Size
    distribution: Distribution

    def __call__(self, level: Key[Array, ""] | Int[Array, ""] | int) -> Level:
        """Sample one level."""
        if isinstance(level, jax.Array) and _is_key(level):
            level = self.draw_id(level)
        return self._one((), level, ())

    def lanes(self, level_ids: Int[Array, " lane"]) -> Level:
        """Sample the levels with these ids; level axis last."""
        return sample(jnp.asarray(level_ids, jnp.int32), self.size, self.distribution)

    def draw_id(self, key: Key[Array, ""]) -> Int[Array, ""]:
        """Draw a level id below FRESH_IDS, so that it is never one of those that policies are measured on."""
        return self.draw_ids(key, ())

    def draw_ids(self, key: Key[Array, ""], shape: tuple[int, ...]) -> Int[Array, "..."]:
        """Draw many level ids as `draw_id` does one."""
        return (jax.random.bits(key, shape) >> (32 - FRESH_BITS)).astype(jnp.int32)

    @property
    def _one(self) -> Callable[..., Level]:
        return single(lambda _, level_ids, __: self.lanes(level_ids))


@jit_sooner(static_argnames=("size", "distribution"))
def sample_chunk(level_ids: Int[Array, " lane"], size: Size, distribution: Distribution) -> Level:
    """Sample one chunk of levels."""
    return sample(level_ids, size, distribution)


def sample(level_ids: Int[Array, " lane"], size: Size, distribution: Distribution) -> Level:
    """Sample the levels with these ids, 0 .. MAX_LEVEL_ID, within `jax.jit`."""
    require_32_bits()
    results = by_platform(
        lambda ids: _as_machine_code(ids, size, distribution),
        lambda ids: _on_all_lanes(ids, size, distribution),
        level_ids,
    )
    return as_level(results, size, level_ids.shape[-1])


def _as_machine_code(level_ids: Int[Array, " lane"], size: Size, distribution: Distribution) -> Results:
    return _compiled(size, distribution)(level_ids, level_ids.shape[-1])


def _on_all_lanes(level_ids: Int[Array, " lane"], size: Size, distribution: Distribution) -> Results:
    return kernel_of(size, distribution).on_all_lanes(level_ids, level_ids.shape[-1])


@compiled_once
def _compiled(size: Size, distribution: Distribution) -> Compiled:
    return kernel_of(size, distribution).compiled(repr(distribution), KERNEL_SOURCES)


def as_level(results: Results, size: Size, lanes: int) -> Level:
    """Return levels with the kernel's arrays; their other fields are blank."""
    level, made = empty_level(size, lanes), results.rows._asdict() | {"collides": results.collides}
    mine = lambda part: {name: x for name, x in made.items() if hasattr(part, name)}
    model, state = (replace(part, **mine(part)) for part in (level.model, level.state))
    return replace(level, model=model, state=state, **mine(level))


def kernel_of(size: Size, dist: Distribution) -> Kernel:
    """Return the sampler of a block of levels."""
    layout = layout_of(size, dist)

    def body(level_id: Ref, scenery: SceneryTable, results: Results, scratch: Workspace) -> None:
        draw(stream_key(level_id[...], Stream.LEVEL), scratch.numbers)
        clear(scratch.draft, scenery)
        sample_block(results, scratch, layout, dist)

    return Kernel(body, Buffer((), "int32"), SCENERY, buffers_of(Results, size), scratch_of(size, layout))


def on_cpu() -> AbstractContextManager[Any]:
    """Let this thread compute on the CPU if JAX has one: levels have the same bits on every CPU, but not on a GPU."""
    if jax.default_backend() == "cpu":
        return nullcontext()  # another setting of JAX would make other stored programs
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # JAX_PLATFORMS=cuda
        return nullcontext()

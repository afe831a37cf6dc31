"""A level's keys: the same everywhere, one for each id and stream."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.identity.keys import MAX_LEVEL_ID, Stream, key_for, level_id_array


def data(level_id: int, stream: Stream) -> tuple[int, ...]:
    return tuple(np.asarray(jax.random.key_data(key_for(level_id, stream))).tolist())


@pytest.mark.parametrize(
    ("level_id", "stream", "expected"),
    [
        (0, Stream.LEVEL, (2067023257, 4011464742)),
        (2, Stream.LEVEL, (4146040655, 930402587)),
        (MAX_LEVEL_ID, Stream.EXPERT, (221172097, 3166419195)),
    ],
)
def test_keys_are_those_of_version_1(level_id: int, stream: Stream, expected: tuple[int, int]) -> None:
    """Keys are made by integer arithmetic alone: they are equal on every machine, and must never change."""
    assert data(level_id, stream) == expected


@pytest.mark.parametrize("wrong", [[[0, 1], [2, 3]], [0.7], 5, [-1], [2**31], [True]])
def test_level_id_array_refuses_other_types(wrong: object) -> None:
    with pytest.raises(ValueError, match="level ids"):
        level_id_array(wrong)  # pyright: ignore[reportArgumentType]


def test_no_key_is_used_twice() -> None:
    ids = [0, 1, 2, 63, 64, 2**16, 2**31 - 2, MAX_LEVEL_ID]
    keys = {data(level_id, stream) for level_id in ids for stream in Stream}
    assert len(keys) == len(ids) * len(Stream)


def test_keys_do_not_depend_on_the_batch() -> None:
    ids = jnp.array([7, 0, MAX_LEVEL_ID])
    keys = jax.jit(jax.vmap(lambda level_id: key_for(level_id, Stream.EVALUATION)))(ids)
    for key, level_id in zip(jax.random.key_data(keys), ids.tolist(), strict=True):
        assert tuple(np.asarray(key).tolist()) == data(level_id, Stream.EVALUATION)


def test_keys_carry_the_named_generator() -> None:
    """Whatever JAX's default generator is."""
    assert "fry" in str(key_for(0, Stream.LEVEL).dtype)

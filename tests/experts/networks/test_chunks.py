"""Lanes cut into chunks: nothing is lost, mixed up or weighed twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.experts.networks import chunks
from levelproof.experts.networks.chunks import chunk_by_chunk, lanes_at_once
from levelproof.levelgen.level import SIZES

ENTITIES = {"s": 6, "m": 10, "l": 21}  # of a lane


@pytest.mark.parametrize("size", SIZES)
def test_chunk_fits_and_divides_the_lanes(size: str) -> None:
    for lanes in (1, 2, 48, 64, 256, 1000, 1024, 2048):
        few = lanes_at_once(SIZES[size], lanes)
        assert lanes % few == 0
        assert few * ENTITIES[size] <= chunks.ENTITIES
    assert lanes_at_once(SIZES[size], 2048) * ENTITIES[size] > chunks.ENTITIES / 2
    assert lanes_at_once(SIZES[size], 1021) == 1021, "no divisor is near to what fits"


def test_chunks_are_joined_in_order() -> None:
    lanes, seen = 12, list[int]()
    tree = {"a": jnp.arange(3.0 * lanes).reshape(3, lanes), "b": jnp.arange(lanes), "none": jnp.zeros((0, 2, lanes))}

    def twice(chunk: dict[str, jax.Array]) -> dict[str, jax.Array]:
        seen.append(chunk["b"].shape[-1])
        return jax.tree.map(lambda x: 2 * x, chunk)

    done = chunk_by_chunk(twice, tree, 4)
    assert set(seen) == {4}
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x, 2 * y), done, tree)

"""What an entity sees of the nearest body of a role."""

from dataclasses import replace

import jax
import numpy as np

from levelproof.experts.networks.relations import _nearest
from levelproof.levelgen.level import Role
from levelproof.levelgen.sampling.sampler import sample_levels


def test_nearest_candidate_is_found_where_there_is_one() -> None:
    levels = jax.device_get(sample_levels(np.arange(64), "m"))
    state, rng = levels.state, np.random.default_rng(0)
    velocity = rng.normal(size=state.velocity.shape).astype(np.float32)
    candidate = levels.model.active & ((levels.role == Role.PLAIN) | (levels.role == Role.RED))
    candidate[:, ::8] = False
    at = rng.uniform(0, 5, (3, 2, 64)).astype(np.float32)
    to, moves = map(np.asarray, jax.jit(_nearest)(replace(state, velocity=velocity), candidate, at))
    assert candidate.sum(0).max() > 1
    for lane in range(64):
        bodies = np.flatnonzero(candidate[:, lane])
        for point in range(3):
            if not len(bodies):
                assert not to[point, :, lane].any()
                assert not moves[point, :, lane].any()
                continue
            offset = state.position[bodies, :, lane] - at[point, :, lane]
            nearest = np.square(offset).sum(1).argmin()
            np.testing.assert_array_equal(to[point, :, lane], offset[nearest])
            np.testing.assert_array_equal(moves[point, :, lane], velocity[bodies[nearest], :, lane])

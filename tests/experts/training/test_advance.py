"""How the lanes of slots act and start, in training and in evaluations."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.noise import PERTURBATION, STICKINESS
from levelproof.experts.training import advance, rollout
from levelproof.experts.training.slots import Slot, Training
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import ACTIONS, concatenate_levels
from tests.experts.search.worlds import BALL, valley
from tests.experts.small import CONFIG
from tests.quick import jit_once

LANES = CONFIG.environments
STICKY, PERTURBED, GUIDES = slice(4, 8), slice(8, 12), slice(14, 16)  # lanes of CONFIG; the first four are plain


def test_lanes_act_as_the_mode_of_their_slot_says() -> None:
    """Evaluations: one greedy attempt, some sticky ones, no rehearsal. Training: rehearsals, or persistent lanes."""
    evaluating, known = np.array([True, True, False, False]), np.array([True, False, True, False])
    action = np.random.default_rng(0).integers(0, 2, (4, RECORD_STEPS, ACTIONS)).astype(np.int8)
    nothing: Any = None
    success: Any = Success(action, known.astype(np.int32))  # type: ignore[arg-type]
    training = Training(nothing, nothing, nothing, success, nothing)
    slot = Slot(nothing, nothing, training, nothing)
    manner = jax.device_get(jit_once(lambda: advance._manner(slot, evaluating, CONFIG))())  # type: ignore[arg-type]

    greedy, rehearsing, stickiness = np.zeros((3, 4, LANES))
    greedy[:2, 0] = rehearsing[2, GUIDES] = 1
    stickiness[:2, STICKY], stickiness[3, GUIDES] = STICKINESS, CONFIG.persistence
    np.testing.assert_array_equal(manner.greedy.reshape(4, LANES), greedy)
    np.testing.assert_array_equal(manner.rehearsing.reshape(4, LANES), rehearsing)
    np.testing.assert_allclose(manner.stickiness.reshape(4, LANES), stickiness)
    np.testing.assert_array_equal(np.moveaxis(manner.rehearsal, -1, 0), action)


def test_perturbed_attempts_start_with_slightly_other_velocities() -> None:
    """Each with its own, of bodies that can move alone; all other lanes start as the level does."""
    levels, keys = concatenate_levels([valley(), valley()]), jax.random.split(jax.random.key(0), 2)

    @jit_once
    def starts() -> tuple:
        lanes = repeat(levels, LANES)
        return advance._perturbed_start(lanes, keys, CONFIG), rollout.start(lanes)

    perturbed, plain = jax.device_get(starts())
    ours, theirs = perturbed.world.state, plain.world.state
    by_slot = lambda x: x.reshape(*x.shape[:-1], 2, LANES)
    for now, was in ((ours.velocity, theirs.velocity), (ours.angular_velocity[:, None], theirs.angular_velocity)):
        change = by_slot(now) - by_slot(was.reshape(now.shape))
        drawn = change[BALL][..., PERTURBED]
        assert len(np.unique(drawn)) == drawn.size
        assert PERTURBATION / 2 < np.abs(drawn).max() <= PERTURBATION
        change[BALL, ..., PERTURBED] = 0
        assert not change.any()
    without = lambda start: jax.tree.leaves(replace(start.world.state, velocity=(), angular_velocity=()))
    jax.tree.map(np.testing.assert_array_equal, without(perturbed), without(plain))

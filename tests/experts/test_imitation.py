"""The loss of cloning: averaged over live entries, then over transitions."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from levelproof.experts.imitation import (
    Imitation,
    ImitationConfig,
    Likeness,
    Transitions,
    begin_imitation,
    compare,
    from_motion,
    imitate,
    to_motion,
)
from levelproof.experts.networks import chunks
from levelproof.experts.networks.chunks import lanes_at_once
from levelproof.experts.networks.over_levels import NetworkConfig, PolicyKind, initial_policy, policy_logits
from levelproof.experts.policy import most_probable
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import CHOICES, action_mask
from tests.experts.networks.weights import random_weights
from tests.quick import jit_once

COUNT = 16
NETWORK = NetworkConfig(PolicyKind.FLAT, width=8, depth=1)


def test_loss_and_accuracy_are_means_over_live_entries_then_over_transitions() -> None:
    levels = jax.tree.map(np.asarray, sample_levels(np.arange(COUNT), "s"))
    params = random_weights(lambda: initial_policy(jax.random.key(0), NETWORK, SIZES["s"]), 0.2)
    action = np.random.default_rng(0).integers(0, CHOICES, (COUNT, len(CHOICES))).astype(np.int32)
    motion = np.asarray(to_motion(levels.state, contacts=False))
    likeness = compare(params, Transitions(levels, motion, action), NETWORK)

    state = from_motion(motion, levels.size)
    logits = np.asarray(jit_once(policy_logits, static_argnums=1)(params, NETWORK, levels, state))
    chosen, live = np.asarray(most_probable(logits)).T, np.asarray(action_mask(levels)).T
    losses, hits = [], []
    for lane in range(COUNT):
        entries, mine = np.split(logits[:, lane], np.cumsum(CHOICES)[:-1]), np.flatnonzero(live[lane])
        if not len(mine):
            losses.append(0.0)
            hits.append(0.0)
            continue
        nats = [np.log(np.exp(entries[i]).sum()) - entries[i][action[lane, i]] for i in mine]
        losses.append(np.mean(nats))
        hits.append(np.mean(chosen[lane, mine] == action[lane, mine]))
    assert len({int(row.sum()) for row in live}) > 1, "levels with several numbers of live entries"
    assert float(likeness.loss) == pytest.approx(np.mean(losses), rel=1e-4)
    assert float(likeness.accuracy) == pytest.approx(np.mean(hits), abs=1e-6)

    idle = np.where(live, action, (action + 1) % CHOICES)
    other = compare(params, Transitions(levels, motion, idle), NETWORK)
    assert (float(other.loss), float(other.accuracy)) == (float(likeness.loss), float(likeness.accuracy))


@pytest.mark.slow
def test_update_is_the_same_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    levels = jax.tree.map(np.asarray, sample_levels(np.arange(COUNT), "s"))
    action = np.random.default_rng(0).integers(0, CHOICES, (COUNT, len(CHOICES))).astype(np.int32)
    motion = np.asarray(to_motion(levels.state, contacts=False))
    transitions = Transitions(replace(levels, state=None), motion, action)  # pyright: ignore
    config = ImitationConfig(updates=10, batch=COUNT)

    def updated() -> tuple[Imitation, Likeness]:
        begun = begin_imitation(np.int32(0), NETWORK, levels.size, config)
        update = jax.jit(imitate.__wrapped__, static_argnums=(2, 3))  # without what was compiled before
        for _ in range(2):
            begun, likeness = update(begun, transitions, NETWORK, config)
        return begun, likeness

    assert lanes_at_once(levels.size, COUNT) == COUNT
    whole = updated()
    monkeypatch.setattr(chunks, "ENTITIES", 24)
    assert lanes_at_once(levels.size, COUNT) == 4
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-5), updated(), whole)

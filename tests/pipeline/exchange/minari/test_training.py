"""An offline RL library learns from an exported split: conservative Q-learning of TorchRL, then played here."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import levelproof
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.exchange.minari.episodes import ActionKind
from levelproof.pipeline.exchange.minari.export import export_minari
from tests.pipeline.made import played_split

pytestmark = pytest.mark.campaign
UPDATES, BATCH, WIDTH = 600, 256, 256
STEPS = 256  # env steps that a policy has


def test_a_trained_policy_solves_the_levels_as_their_witnesses_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each level has one action for all its steps, which the policy has to know by the level's looks."""
    torch, minari, _ = (pytest.importorskip(name) for name in ("torch", "minari", "torchrl"))
    split = played_split(tmp_path / "data", held=STEPS)
    export_minari(split, None, tmp_path / "minari", ActionKind.COMBINED)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    torch.manual_seed(0)
    data = minari.load_dataset("levelproof/128k/s-combined-v0")
    network, losses = trained(torch, data)
    assert np.mean(losses[-50:]) < 0.1 * losses[0]
    first: dict[int, int] = {}  # steps of each level's first episode
    for episode in data.iterate_episodes():
        first.setdefault(int(episode.infos["level_id"][0]), len(episode))
    levels, steps = levelproof.sample_levels(list(first), levelproof.SIZES["s"]), list(first.values())
    rng = np.random.default_rng(0)
    greedy = lambda seen: network(torch.from_numpy(np.array(seen))).argmax(-1).numpy()
    chance = lambda seen: rng.integers(0, np.prod(CHOICES), len(seen))
    assert np.mean(steps_to_goal(levels, greedy) == steps) >= 0.9
    assert np.mean(steps_to_goal(levels, chance) == steps) <= 0.3


def trained(torch: Any, data: Any) -> tuple[Any, list[float]]:
    """The Q network after UPDATES of TorchRL's loss, and what the loss was."""
    from tensordict import TensorDict
    from torchrl.data import LazyTensorStorage, ReplayBuffer
    from torchrl.modules import MLP, QValueActor
    from torchrl.objectives import DiscreteCQLLoss, SoftUpdate

    def of(values: np.ndarray) -> Any:
        return torch.from_numpy(values)

    buffer = ReplayBuffer(storage=LazyTensorStorage(data.total_steps), batch_size=BATCH)
    for episode in data.iterate_episodes():
        done = episode.terminations | episode.truncations
        after = {"observation": of(episode.observations[1:])}
        after |= {"reward": of(episode.rewards)[:, None], "terminated": of(episode.terminations)[:, None]}
        after |= {"done": of(done)[:, None]}
        steps = {"observation": of(episode.observations[:-1]), "action": of(episode.actions), "next": after}
        buffer.extend(TensorDict(steps, [len(episode)]))
    network = MLP(data.observation_space.shape[0], int(data.action_space.n), num_cells=[WIDTH, WIDTH])
    actor = QValueActor(network, in_keys=["observation"], action_space="categorical")
    loss = DiscreteCQLLoss(actor, action_space="categorical")
    loss.make_value_estimator(gamma=0.99)
    target, optimiser, losses = SoftUpdate(loss, tau=0.01), torch.optim.Adam(loss.parameters(), 1e-3), []
    for _ in range(UPDATES):
        parts = loss(buffer.sample())
        total = parts["loss_qvalue"] + parts["loss_cql"]
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        target.step()
        losses.append(float(total))
    return network, losses


def steps_to_goal(levels: levelproof.Level, policy: Any) -> np.ndarray:
    """Env steps of a policy's first episode on each level; 0 where it does not reach the goal."""
    env, params = levelproof.make(levels)
    own = levelproof.starts(levels)
    keys = jax.random.split(jax.random.PRNGKey(0), len(own.timestep))
    seen, state = jax.vmap(env.reset, in_axes=(0, None, 0))(keys, params, own)
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None, 0)))
    over, steps = np.zeros(len(keys), bool), np.zeros(len(keys), int)
    for now in range(1, STEPS + 1):
        action = np.stack(np.unravel_index(policy(seen), CHOICES), -1)
        seen, state, _, done, info = step(keys, state, jnp.asarray(action), params, own)
        steps[~over & np.asarray(info["GoalR"])] = now
        over |= np.asarray(done)
    return steps

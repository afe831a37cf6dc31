"""Offline RL on an exported split: TorchRL's conservative Q-learning, evaluated in our environment."""

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
STEPS = 256  # env steps of a policy's evaluation


def test_policy_trained_on_an_export_solves_its_levels_as_the_witnesses_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each witness repeats one action, which the policy must infer from the observation of the level."""
    torch, minari, _ = (pytest.importorskip(name) for name in ("torch", "minari", "torchrl"))
    split = played_split(tmp_path / "data", held=STEPS)
    export_minari(split, None, tmp_path / "minari", ActionKind.COMBINED)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    torch.manual_seed(0)
    data = minari.load_dataset("levelproof/128k/s-combined-v0")
    network, losses = train(torch, data)
    assert np.mean(losses[-50:]) < 0.1 * losses[0]
    first: dict[int, int] = {}  # steps of each level's first episode
    for episode in data.iterate_episodes():
        first.setdefault(int(episode.infos["level_id"][0]), len(episode))
    levels, steps = levelproof.sample_levels(list(first), levelproof.SIZES["s"]), list(first.values())
    rng = np.random.default_rng(0)
    greedy = lambda observation: network(torch.from_numpy(np.array(observation))).argmax(-1).numpy()
    uniform = lambda observation: rng.integers(0, np.prod(CHOICES), len(observation))
    assert np.mean(steps_to_goal(levels, greedy) == steps) >= 0.9
    assert np.mean(steps_to_goal(levels, uniform) == steps) <= 0.3


def train(torch: Any, data: Any) -> tuple[Any, list[float]]:
    """Train a Q network for UPDATES with TorchRL's loss; return it and the losses."""
    from tensordict import TensorDict
    from torchrl.data import LazyTensorStorage, ReplayBuffer
    from torchrl.modules import MLP, QValueActor
    from torchrl.objectives import DiscreteCQLLoss, SoftUpdate

    def tensor(values: np.ndarray) -> Any:
        return torch.from_numpy(values)

    buffer = ReplayBuffer(storage=LazyTensorStorage(data.total_steps), batch_size=BATCH)
    for episode in data.iterate_episodes():
        done = episode.terminations | episode.truncations
        after = {"observation": tensor(episode.observations[1:])}
        after |= {"reward": tensor(episode.rewards)[:, None], "terminated": tensor(episode.terminations)[:, None]}
        after |= {"done": tensor(done)[:, None]}
        steps = {"observation": tensor(episode.observations[:-1]), "action": tensor(episode.actions), "next": after}
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
    """Return the env steps of a policy's first episode on each level; 0 if it does not reach the goal."""
    env, params = levelproof.make(levels)
    starts = levelproof.starts(levels)
    keys = jax.random.split(jax.random.PRNGKey(0), len(starts.timestep))
    observation, state = jax.vmap(env.reset, in_axes=(0, None, 0))(keys, params, starts)
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None, 0)))
    over, steps = np.zeros(len(keys), bool), np.zeros(len(keys), int)
    for now in range(1, STEPS + 1):
        action = np.stack(np.unravel_index(policy(observation), CHOICES), -1)
        observation, state, _, done, info = step(keys, state, jnp.asarray(action), params, starts)
        steps[~over & np.asarray(info["GoalR"])] = now
        over |= np.asarray(done)
    return steps

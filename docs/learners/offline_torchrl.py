"""Offline reinforcement learning with TorchRL on a split that `levelproof export` wrote as a Minari dataset.

python offline_torchrl.py cloning|cql|iql DATASET [UPDATES] [SEED]

trains a network and writes it to offline.pt beside this file, which is an agent, too: `levelproof evaluate
offline_torchrl.py` plays levels with that network. Copy the file to a folder of its own first. The dataset's actions
must be combined into one number (`--actions combined`): TorchRL's losses know a single choice.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import MLP, ProbabilisticActor, QValueActor
from torchrl.objectives import DiscreteCQLLoss, DiscreteIQLLoss, SoftUpdate

CHOICES = 3, 3, 3, 3, 2, 2  # of the action's entries: motors, then thrusters
COMBINED = int(np.prod(CHOICES))
CELLS, BATCH, RATE, DISCOUNT = [256, 256], 1024, 3e-4, 0.995
SAVED = Path(__file__).with_name("offline.pt")


def network_of(features: int, outputs: int = COMBINED) -> torch.nn.Module:
    return MLP(features, outputs, num_cells=CELLS, activation_class=torch.nn.ReLU)


def first_episodes(name: str) -> TensorDict:
    """Return the steps of each level's first episode; later episodes of a record often repeat it."""
    import minari

    first, parts = set(), []
    for episode in minari.load_dataset(name).iterate_episodes():
        level = int(episode.infos["level_id"][0])
        if level in first:
            continue
        first.add(level)
        column = lambda values: torch.from_numpy(np.asarray(values))[:, None]
        after = {"observation": torch.from_numpy(episode.observations[1:]), "reward": column(episode.rewards)}
        after |= {"terminated": column(episode.terminations)}
        after |= {"done": column(episode.terminations | episode.truncations)}
        steps = {"observation": torch.from_numpy(episode.observations[:-1])}
        steps |= {"action": torch.from_numpy(episode.actions), "next": after}
        parts.append(TensorDict(steps, [len(episode)]))
    return torch.cat(parts)


class Cloning(torch.nn.Module):
    """The negative log-likelihood of the actions: the baseline that uses no reward."""

    def __init__(self, network: torch.nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, steps: TensorDict) -> dict[str, torch.Tensor]:
        return {"loss": torch.nn.functional.cross_entropy(self.network(steps["observation"]), steps["action"])}


def loss_of(method: str, network: torch.nn.Module, features: int) -> torch.nn.Module:
    """Return the method's loss, which trains `network`: logits of actions, of `cql` their values."""
    if method == "cloning":
        return Cloning(network)
    if method == "cql":
        value = QValueActor(network, in_keys=["observation"], action_space="categorical")
        loss = DiscreteCQLLoss(value, action_space="categorical")
    else:
        logits = TensorDictModule(network, ["observation"], ["logits"])
        actor = ProbabilisticActor(logits, ["logits"], distribution_class=torch.distributions.Categorical)
        quality = TensorDictModule(network_of(features), ["observation"], ["state_action_value"])
        value = TensorDictModule(network_of(features, 1), ["observation"], ["state_value"])
        loss = DiscreteIQLLoss(actor, quality, value_network=value, action_space="categorical", expectile=0.8)
    loss.make_value_estimator(gamma=DISCOUNT)
    return loss


def train(method: str, dataset: str, updates: int, seed: int) -> None:
    torch.manual_seed(seed)
    data = first_episodes(dataset)
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)), batch_size=BATCH)
    buffer.extend(data)
    features = data["observation"].shape[-1]
    network = network_of(features)
    loss = loss_of(method, network, features)
    optimiser = torch.optim.Adam(loss.parameters(), RATE)
    target = None if method == "cloning" else SoftUpdate(loss, tau=0.005)
    for update in range(1, updates + 1):
        parts = loss(buffer.sample())
        total = sum(value for name, value in parts.items() if name.startswith("loss"))
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        if target:
            target.step()
        if update % 500 == 0 or update == updates:
            print(f"{update:,}/{updates:,} updates · loss {total.item():.3f}", flush=True)
    torch.save({"method": method, "features": features, "weights": network.state_dict()}, SAVED)
    print(f"The network is in {SAVED}. Next: levelproof evaluate {__file__}")


LOADED: dict[str, torch.nn.Module | str] = {}
EACH = np.stack(np.unravel_index(np.arange(COMBINED), CHOICES), -1)  # [combination, entry]


def act(observation: np.ndarray, live: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Choose actions for `levelproof evaluate`: the best by value, else drawn from the policy."""
    if not LOADED:
        saved = torch.load(SAVED, weights_only=True)
        network = network_of(saved["features"])
        network.load_state_dict(saved["weights"])
        LOADED.update(network=network, method=saved["method"])
    with torch.no_grad():
        logits = LOADED["network"](torch.from_numpy(observation)).numpy()
    logits = np.where((live[:, None] | (EACH == 0)).all(-1), logits, -np.inf)  # entries without effect stay at 0
    if LOADED["method"] == "cql":
        return EACH[logits.argmax(-1)]
    weight = np.exp(logits - logits.max(-1, keepdims=True)).cumsum(-1)
    return EACH[(weight > uniform[:, :1] * weight[:, -1:]).argmax(-1)]


if __name__ == "__main__":
    method, dataset, updates, seed = (*sys.argv[1:], *("3000", "0")[len(sys.argv) - 3 :])
    train(method, dataset, int(updates), int(seed))

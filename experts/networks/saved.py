"""A policy for all levels, and the folder that keeps it: safetensors, and a JSON file that describes them."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from operator import index
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import VariableDict
from jaxtyping import Array, Float, Int, Key
from safetensors import SafetensorError
from safetensors.numpy import load, save

from levelproof.experts.networks.over_levels import NetworkConfig, PolicyKind, initial_policy, policy_logits
from levelproof.experts.policy import most_probable, sample
from levelproof.levelgen.files.entries import abbreviate
from levelproof.levelgen.identity.keys import key_of_seed
from levelproof.levelgen.level import ACTIONS, Level, name_of, size_of
from levelproof.levelgen.pictures.words import printable
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.levelgen.task.rules import TaskState
from levelproof.physics.types import Size, State

WEIGHTS, CONFIG = "policy.safetensors", "config.json"
BUILTIN = "builtin:"  # before the name of a policy that comes with levelproof
BUILTIN_AT = Path(__file__).parent / "builtin"
FORMAT = 1  # of config.json
MAX_CONFIG = 1_000_000  # bytes of it; that of a policy trained in many steps has 8,100
MAX_HEADER = 1_000_000  # bytes of the weights' file besides the weights
MAX_REASON = 300  # characters of a library's message in ours


class PolicyError(ValueError):
    """A folder that holds no usable policy, or a level that the policy cannot play; the message is one sentence."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy for all levels; its methods are pure functions, to be called under `jax.jit` or not. Lanes are last.

    Attributes:
        network: the network's shape.
        params: the network's parameters.
        size: size of the levels that it can play; None: any size.
        origin: how it was made, as JSON: what `save_policy` was given.
    """

    network: NetworkConfig
    params: VariableDict
    size: Size | None
    origin: Mapping[str, Any]

    @property
    def observation_type(self) -> ObservationType:
        """What the network reads of a state, as an observation of the environment."""
        return self.network.observation_type

    def can_play(self, size: Size) -> bool:
        """Return whether it plays levels of this size."""
        return self.size in (None, size)

    def logits(self, level: Level, state: State | TaskState) -> Float[Array, "16 lane"]:
        """Return logits: three for each of four motor entries, then two for each of two thruster entries.

        `experts.policy.log_probability` and `entropy` take them, with `levelgen.task.actions.action_mask`.

        Args:
            level: each lane's level; of its `state`, only the scenery is read, which never moves.
            state: each lane's world, or its episode.

        Raises:
            PolicyError: the policy was trained for another size.
        """
        if self.size is not None and not self.can_play(level.size):
            raise PolicyError(
                f"The policy plays levels of size {name_of(self.size)} only, not {name_of(level.size)}: "
                "policies with network.kind=attention play any."
            )
        world = state.state if isinstance(state, TaskState) else state
        lanes = world.rotation.shape[-1]
        level = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], lanes)), level)
        return policy_logits(self.params, self.network, level, world)

    def sample(self, key: Key[Array, ""], level: Level, state: State | TaskState) -> Int[Array, "6 lane"]:
        """Sample actions; entries that have no effect in a lane's level are 0."""
        logits = self.logits(level, state)
        action = sample(logits, jax.random.uniform(key, (ACTIONS, logits.shape[-1])))
        return jnp.where(action_mask(level), action, 0)

    def most_probable(self, level: Level, state: State | TaskState) -> Int[Array, "6 lane"]:
        """Return the most probable actions; entries that have no effect in a lane's level are 0."""
        return jnp.where(action_mask(level), most_probable(self.logits(level, state)), 0)


def save_policy(folder: str | os.PathLike[str], policy: Policy) -> None:
    """Write a policy to `folder`, which is created, each file whole or not at all."""
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    size = policy.size and name_of(policy.size)
    config = {"format": FORMAT, "network": asdict(policy.network), "size": size, "origin": dict(policy.origin)}
    arrays = {name: np.ascontiguousarray(x) for name, x in named(policy.params).items()}
    for name, content in (WEIGHTS, save(arrays)), (CONFIG, (json.dumps(config, indent=2) + "\n").encode()):
        temporary = path / f"{name}.tmp"
        temporary.unlink(missing_ok=True)  # what a killed process left, or a link to someone's file
        with temporary.open("xb") as file:
            file.write(content)
        temporary.replace(path / name)


def load_policy(folder: str | os.PathLike[str]) -> Policy:
    """Load a policy that `save_policy`, or `levelproof clone`, `train` or `distill`, wrote.

    Args:
        folder: the policy's folder; `builtin:s` and `builtin:m` name those that come with levelproof.

    Raises:
        PolicyError: the folder has no policy, or it is damaged or of a later version.
    """
    path = policy_folder(folder)
    try:
        if not all((path / name).is_file() for name in (CONFIG, WEIGHTS)):  # reading a pipe would block
            raise FileNotFoundError
        config = json.loads(_read(path / CONFIG, MAX_CONFIG))
        if index(config["format"]) != FORMAT:
            raise PolicyError(
                f"The policy {path} has format {abbreviate(config['format'])}, but this levelproof reads format "
                f"{FORMAT}: update levelproof."
            )
        shape, origin = dict(config["network"]), dict(config["origin"])
        kind = PolicyKind(shape.pop("kind"))
        try:
            network = NetworkConfig(kind, **{name: index(x) for name, x in shape.items()})
        except ValueError as error:
            raise PolicyError(f"The policy {path} has a network that cannot be made here: its {error}.") from None
        size = None if config["size"] is None else size_of(config["size"])
        wanted = jax.eval_shape(lambda: initial_policy(key_of_seed(0), network, size or size_of("m")))
        room = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(wanted))
        params = unnamed(wanted, load(_read(path / WEIGHTS, room + MAX_HEADER)))
    except FileNotFoundError:
        raise PolicyError(f"There is no policy in {path}: `levelproof clone SPLIT -o policy` makes one.") from None
    except PolicyError:
        raise
    except (OSError, LookupError, TypeError, ValueError, OverflowError, RecursionError, SafetensorError) as error:
        reason = printable(str(error))[:MAX_REASON]
        raise PolicyError(f"The policy in {path} is damaged ({reason}): make or copy it again.") from None
    return Policy(network, params, size, origin)


def _read(file: Path, most: int) -> bytes:
    """Read a file. Raise ValueError if it has more than `most` bytes."""
    with file.open("rb") as opened:
        if os.fstat(opened.fileno()).st_size > most:
            raise ValueError(f"{file.name} has more than {most:,} bytes")
        return opened.read()


def policy_folder(name: str | os.PathLike[str]) -> Path:
    """Return the folder of a policy, also of one that comes with levelproof.

    Raises:
        PolicyError: no policy of this name comes with levelproof.
    """
    text = os.fspath(name)
    if not text.startswith(BUILTIN):
        return Path(text)
    builtin = sorted(each.parent.name for each in BUILTIN_AT.glob(f"*/{WEIGHTS}"))
    if text.removeprefix(BUILTIN) not in builtin:
        names = ", ".join(f"{BUILTIN}{each}" for each in builtin) or "none"
        raise PolicyError(f"There is no policy {text}: levelproof comes with {names}.")
    return BUILTIN_AT / text.removeprefix(BUILTIN)


def named(tree: Any) -> dict[str, np.ndarray]:
    """Return a pytree's arrays by the path of each."""
    return {jax.tree_util.keystr(path): np.asarray(x) for path, x in jax.tree_util.tree_leaves_with_path(tree)}


def unnamed(like: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return a pytree with the structure of `like`, and the arrays that `named` gave.

    Raises:
        ValueError: an array is missing, or has another shape or type.
    """

    def find(path: Any, x: Any) -> Array:
        array = arrays.get(name := jax.tree_util.keystr(path))
        if array is None or array.shape != x.shape or array.dtype != x.dtype:
            raise ValueError(f"the array {name} is missing or has another shape")
        return jnp.asarray(array)

    return jax.tree_util.tree_map_with_path(find, like)

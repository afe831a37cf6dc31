"""Reads golden states (see make_golden.py) into our types, lanes last."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from levelproof.levelgen.files.kinetix import level_from_kinetix, state_from_kinetix
from levelproof.levelgen.level import Level
from levelproof.physics.types import State

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Golden:
    """States before an action, the action, and what the reference made of it."""

    level: Level  # its `state` is `state`: resume from it
    state: State  # before the action
    timestep: Int[np.ndarray, "lane"]
    last_distance: Float[np.ndarray, "lane"]  # m; -1 on an episode's first step
    action: Int[np.ndarray, "6 lane"]
    action_mask: Bool[np.ndarray, "6 lane"]
    motor: Float[np.ndarray, "joint lane"]  # the action as the engine's controls
    thrust: Float[np.ndarray, "thruster lane"]
    after: State  # one PHYSICS step later
    env_after: State  # one environment step later, before an automatic reset
    env_timestep: Int[np.ndarray, "lane"]
    env_last_distance: Float[np.ndarray, "lane"]
    reward: Float[np.ndarray, "lane"]  # with dense shaping of about["dense_reward_scale"]
    done: Bool[np.ndarray, "lane"]
    goal: Bool[np.ndarray, "lane"]
    obs: Float[np.ndarray, "feature obs_lane"]  # symbolic-flat of `state`, the first lanes only
    next_obs: Float[np.ndarray, "feature obs_lane"]  # of `env_after`
    scene: list[str]  # how the lane's level was made
    about: dict  # size, seed, versions, counts of what the states show


@cache
def golden(size: str) -> Golden:
    """The golden states of a size, read once per process; arrays are read-only."""
    with np.load(HERE / f"{size}.npz") as file:
        fields = {name: _widen(file[name]) for name in file.files}
    about = json.loads(str(fields.pop("about")))
    before, after, env_after = (_part(fields, prefix) for prefix in ("before/", "after/", "env_after/"))
    level, joints = level_from_kinetix(before), before["joint/active"].shape[1]
    last_axis = ("action", "action_mask", "reward", "done", "goal", "obs", "next_obs")
    states = Golden(
        level=level,
        state=level.state,
        timestep=before["timestep"],
        last_distance=before["last_distance"],
        motor=_last(fields["control"][:, :joints]),
        thrust=_last(fields["control"][:, joints:]),
        after=state_from_kinetix(after),
        env_after=state_from_kinetix(env_after),
        env_timestep=env_after["timestep"],
        env_last_distance=env_after["last_distance"],
        scene=[about["scenes"][number] for number in fields["scene"]],
        about=about,
        **{name: _last(fields[name]) for name in last_axis},
    )
    for leaf in jax.tree.leaves(vars(states)):
        if isinstance(leaf, np.ndarray):
            leaf.flags.writeable = False
    return states


def _part(fields: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): values for name, values in fields.items() if name.startswith(prefix)}


def _widen(values: np.ndarray) -> np.ndarray:
    return values.astype(np.int32) if values.dtype.kind in "iu" else values


def _last(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))

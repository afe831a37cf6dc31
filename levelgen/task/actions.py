"""Actions and what they do: one entry per binding, obeyed by every actuator bound to it.

An action is multi-discrete: MOTOR_BINDINGS entries for motors (0 off, 1 forward, 2 backward), then
THRUSTER_BINDINGS entries for thrusters (0 off, 1 on). Environments also accept two other kinds: discrete (one
binding at a time) and continuous. Facts: `kinetix.environment.utils` 3.0.2.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import ACTIONS, MOTOR_BINDINGS, THRUSTER_BINDINGS, Level

MOTOR_CHOICES = 3
THRUSTER_CHOICES = 2
CHOICES = (MOTOR_CHOICES,) * MOTOR_BINDINGS + (THRUSTER_CHOICES,) * THRUSTER_BINDINGS  # by entry
NOTHING = 2 * MOTOR_BINDINGS  # code of the discrete action that uses no actuator
DISCRETE_ACTIONS = NOTHING + 1 + THRUSTER_BINDINGS

Controls = tuple[Float[Array, "joint lane"], Float[Array, "thruster lane"]]  # motors in [-1, 1], thrusters in [0, 1]


def controls(level: Level, action: Int[Array, "6 lane"]) -> Controls:
    """Convert a multi-discrete action to controls: -1, 0 or 1 for motors, 0 or 1 for thrusters.

    A joint with `motor_auto` runs forward whatever the action says.

    Raises:
        ValueError: the action has another shape.
        TypeError: it has floats.
    """
    _require_fit(action, False, ACTIONS)
    forward, backward = action[:MOTOR_BINDINGS] == 1, action[:MOTOR_BINDINGS] >= 2
    motor = forward.astype(jnp.float32) - backward.astype(jnp.float32)
    return _obeyed(level, motor, (action[MOTOR_BINDINGS:] != 0).astype(jnp.float32))


def discrete_controls(level: Level, action: Int[Array, " lane"]) -> Controls:
    """Convert a discrete action, a code below DISCRETE_ACTIONS, to controls.

    Codes 2k and 2k + 1 run the motors of entry k backward and forward, NOTHING does nothing, and NOTHING + 1 + k fires
    the thrusters of entry k. Raises as `controls`.
    """
    _require_fit(action, False)
    is_code = lambda code: (action == code).astype(jnp.float32)
    motor = jnp.stack([is_code(2 * k + 1) - is_code(2 * k) for k in range(MOTOR_BINDINGS)])
    return _obeyed(level, motor, jnp.stack([is_code(NOTHING + 1 + k) for k in range(THRUSTER_BINDINGS)]))


def continuous_controls(level: Level, action: Float[Array, "6 lane"]) -> Controls:
    """Convert a continuous action to controls: clip to [-1, 1] for motors, to [0, 1] for thrusters.

    Raises:
        ValueError: the action has another shape.
        TypeError: it has no floats.
    """
    _require_fit(action, True, ACTIONS)
    return _obeyed(level, jnp.clip(action[:MOTOR_BINDINGS], -1.0, 1.0), jnp.clip(action[MOTOR_BINDINGS:], 0.0, 1.0))


def _require_fit(action: Array, floats: bool, *entries: int) -> None:
    """Check that an action has these axes before its lanes, and floats or not: others would mean other controls.

    Raises:
        ValueError: it has other axes.
        TypeError: it has another type.
    """
    if action.shape[:-1] != entries or not action.ndim:
        wanted = ", ".join([*map(str, entries), "lanes"])
        raise ValueError(f"actions have shape {action.shape}, but must have ({wanted}) for this action_type")
    if jnp.issubdtype(action.dtype, jnp.floating) != floats:
        wanted = "floats" if floats else "integers"
        raise TypeError(f"actions are {action.dtype}, but must be {wanted} for this action_type: convert them")


def _obeyed(level: Level, motor: Float[Array, "4 lane"], thrust: Float[Array, "2 lane"]) -> Controls:
    motor = jnp.where(level.motor_auto, 1.0, _bound(level.motor_binding, motor))
    return motor, _bound(level.thruster_binding, thrust)


def _bound(
    binding: Int[Array, "actuator lane"], entries: Float[Array, "binding lane"]
) -> Float[Array, "actuator lane"]:
    """Return the entry that each actuator is bound to; by comparison, since a gather per lane is slower."""
    return sum((jnp.where(binding == k, entry, 0.0) for k, entry in enumerate(entries)), jnp.float32(0.0))


def action_mask(level: Level) -> Bool[Array, "6 lane"]:
    """Find the live entries of an action: those bound to an active, non-fixed joint or an active thruster.

    As in the reference, a joint makes its entry live even if its motor is off or runs by itself.
    """
    model = level.model
    free = model.joint_active & ~model.joint_fixed
    live = [(free & (level.motor_binding == k)).any(0) for k in range(MOTOR_BINDINGS)]
    live += [(model.thruster_active & (level.thruster_binding == k)).any(0) for k in range(THRUSTER_BINDINGS)]
    stack: Any = np.stack if isinstance(free, np.ndarray) else jnp.stack  # of numpy arrays JAX would compile each shape
    return stack(live)

"""Networks on a level as sets of things: its polygons, circles, joints and thrusters.

Each kind has one encoder, a layer that all its things share. What it makes of the active ones is averaged, and the
averages of all kinds go on through ordinary layers. So things may be numbered in any way, and the number of parameters
does not grow with the size. A thing's rows are those of the symbolic-flat view, then those of the bodies that it is
fixed to (but for their shape, and in place of one-hot numbers), then gravity.

What is constant within a level is folded into the encoders' biases, one for each thing, as in the flat network.
"""

from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.experts.networks.layers import HIDDEN_GAIN, LOGITS, POLICY_GAIN, VALUE_GAIN, Dense, orthogonal
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.observe.flat import (
    BODY_ROWS,
    CIRCLE_ROWS,
    DYNAMIC_ROWS,
    JOINT_ROWS,
    LIMIT,
    POLYGON_ROWS,
    THRUSTER_ROWS,
    body_rows,
    level_features,
    tables_of,
)
from levelproof.physics.types import FIXED_POLYGONS, Size
from levelproof.physics.vector import rows


class Kind(NamedTuple):
    """What an encoder must know of its kind."""

    name: str
    own_rows: int
    ends: int  # bodies that a thing is fixed to; their rows follow its own

    @property
    def moving_rows(self) -> tuple[int, ...]:
        """Those that change within a level."""
        firsts = [self.own_rows + BODY_ROWS * end for end in range(self.ends)] or [0]
        return tuple(first + row for first in firsts for row in DYNAMIC_ROWS)


KINDS = (  # in the order of the flat view
    Kind("polygons", POLYGON_ROWS, 0),
    Kind("circles", CIRCLE_ROWS, 0),
    Kind("joints", JOINT_ROWS, 2),
    Kind("thrusters", THRUSTER_ROWS, 1),
)


class Entities(NamedTuple):
    """All things of a kind, and what is constant about them."""

    rows: Float[Array, "row thing level"]  # 0 where it moves
    weight: Float[Array, "thing level"]  # in the average; 0 where a thing is not active
    ends: Float[Array, "end thing movable level"]  # one-hot: the movable bodies that each is fixed to


Constant = tuple[Entities, ...]  # of all KINDS; without the level axis where there is one level


class Encoder(nn.Module):
    """A layer on every thing of a kind, then the average over those that are active."""

    units: int
    kind: Kind

    @nn.compact
    def __call__(self, things: Entities, moving: Float[Array, "moving thing lane"]) -> Float[Array, "unit lane"]:
        """`moving` lacks the floor, the first of the polygons, which never moves."""
        kernel = self.param("kernel", orthogonal(HIDDEN_GAIN), (self.units, len(things.rows)))
        bias = self.param("bias", nn.initializers.zeros, (self.units,))
        constant = kernel @ things.rows + bias[:, None]
        still = constant.shape[1] - moving.shape[1]
        change = jnp.tensordot(rows(kernel.T, self.kind.moving_rows), moving, (0, 0))
        encoded = nn.tanh(constant[:, still:, None] + change)
        average = (encoded * things.weight[still:, None]).sum(1)
        return average + (nn.tanh(constant[:, :still]) @ things.weight[:still])[:, None]


class EntityTrunk(nn.Module):
    width: int
    depth: int
    encoding: int
    outputs: int
    gain: float

    @nn.compact
    def __call__(self, constant: Constant, moving: list[Float[Array, "moving thing lane"]]) -> Array:
        averages = [
            Encoder(self.encoding, kind, name=kind.name)(things, of_kind)
            for kind, things, of_kind in zip(KINDS, constant, moving, strict=True)
            if things.weight.size
        ]
        x = jnp.concatenate(averages)
        for _ in range(self.depth - 1):
            x = nn.tanh(Dense(self.width, HIDDEN_GAIN)(x))
        return Dense(self.outputs, self.gain)(x)


class EntityNetwork(nn.Module):
    """Separate networks for policy and value of one level."""

    size: Size
    width: int
    depth: int  # hidden layers; the encoders are the first
    encoding: int  # units of an encoder

    @staticmethod
    def constant(levels: Level) -> Constant:
        """What is constant within each level."""
        size, features, bodies = levels.size, level_features(levels), resting_bodies(levels)
        things, seen, lanes = [], 0, features.shape[-1]
        for kind, active, (count, width) in zip(KINDS, active_things(levels), tables_of(size), strict=True):
            block = features[seen : seen + count * width].reshape(count, width, lanes)
            one_hot = block[:, kind.own_rows :].reshape(count, kind.ends, size.bodies, lanes)
            at_ends = jnp.einsum("brl,tebl->ertl", bodies, one_hot).reshape(kind.ends * BODY_ROWS, count, lanes)
            gravity = jnp.broadcast_to(features[-1], (1, count, lanes))
            rows = jnp.concatenate([block[:, : kind.own_rows].swapaxes(0, 1), at_ends, gravity])
            weight = active / jnp.maximum(active.sum(0), 1)
            things.append(Entities(rows, weight, one_hot[:, :, FIXED_POLYGONS:].swapaxes(0, 1)))
            seen += count * width
        return tuple(things)

    @nn.compact
    def __call__(
        self, constant: Constant, moving: Float[Array, "dynamic lane"]
    ) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
        of_kinds = moving_things(self.size, constant, moving)
        trunk = lambda outputs, gain, name: EntityTrunk(self.width, self.depth, self.encoding, outputs, gain, name=name)
        logits = trunk(LOGITS, POLICY_GAIN, "policy")(constant, of_kinds)
        return logits, trunk(1, VALUE_GAIN, "value")(constant, of_kinds)[0]


def active_things(levels: Level) -> list[Float[Array, "thing level"]]:
    """1 where active, by kind; the floor stands for all scenery."""
    model, size = levels.model, levels.size
    polygons = jnp.concatenate([model.active[:1], model.active[FIXED_POLYGONS : size.polygons]])
    kinds = (polygons, model.active[size.polygons :], model.joint_active, model.thruster_active)
    return [active.astype(jnp.float32) for active in kinds]


def resting_bodies(levels: Level) -> Float[Array, "body row level"]:
    """The rows of all bodies, scenery too, that bodies of any shape have; 0 where they move."""
    scenery, movable = slice(0, FIXED_POLYGONS), slice(FIXED_POLYGONS, None)
    parts = [body_rows(levels, scenery), body_rows(levels, movable, constant=True)]
    stacks = [jnp.stack([row.astype(jnp.float32) for row in jnp.broadcast_arrays(*part)], 1) for part in parts]
    return jnp.clip(jnp.nan_to_num(jnp.concatenate(stacks)), -LIMIT, LIMIT)


def moving_things(
    size: Size, constant: Constant, moving: Float[Array, "dynamic lane"]
) -> list[Float[Array, "moving thing lane"]]:
    """What moves of all things but the floor, by kind."""
    bodies = moving.reshape(size.bodies - FIXED_POLYGONS, len(DYNAMIC_ROWS), moving.shape[-1])
    polygons = size.polygons - FIXED_POLYGONS
    at_ends = [jnp.tensordot(things.ends, bodies, 1) for things in constant[2:]]
    of_kinds = [bodies[None, :polygons], bodies[None, polygons:], *at_ends]
    return [x.swapaxes(1, 2).reshape(x.shape[0] * x.shape[2], x.shape[1], x.shape[3]) for x in of_kinds]

"""Networks on a level as sets of entities: polygons, circles, joints and thrusters.

Each kind has one encoder, a layer that all its entities share. The encodings of active entities are averaged, and the
averages of all kinds pass through dense layers. So the order of entities does not matter, and the number of parameters
does not grow with the size. An entity's rows are those of the symbolic-flat view, then those of the bodies that it is
fixed to (without their shape, and in place of one-hot indices), then gravity.

Constant features are folded into the encoders' biases, one per entity, as in the flat network.
"""

from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from levelproof.experts.networks.layers import HIDDEN_GAIN, LOGITS, POLICY_GAIN, SUMMARY, VALUE_GAIN, Dense, orthogonal
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
    """Row layout of one kind of entity."""

    name: str
    own_rows: int
    ends: int  # bodies that an entity is fixed to; their rows follow its own

    @property
    def moving_rows(self) -> tuple[int, ...]:
        """Rows of the observation that change during an episode."""
        firsts = [self.own_rows + BODY_ROWS * end for end in range(self.ends)] or [0]
        return tuple(first + row for first in firsts for row in DYNAMIC_ROWS)


KINDS = (  # in the order of the flat view
    Kind("polygons", POLYGON_ROWS, 0),
    Kind("circles", CIRCLE_ROWS, 0),
    Kind("joints", JOINT_ROWS, 2),
    Kind("thrusters", THRUSTER_ROWS, 1),
)


class Entities(NamedTuple):
    """All entities of a kind: their constant rows, weights and bodies."""

    rows: Float[Array, "row entity level"]  # 0 in moving rows
    weight: Float[Array, "entity level"]  # in the average; 0 for inactive entities
    ends: Float[Array, "end entity movable level"]  # one-hot: the movable bodies that each entity is fixed to


Constant = tuple[Entities, ...]  # one of each of KINDS; without the level axis for one level


class Encoder(nn.Module):
    """A layer on every entity of a kind, then the average over active ones."""

    units: int
    kind: Kind

    @nn.compact
    def __call__(self, entities: Entities, moving: Float[Array, "moving entity lane"]) -> Float[Array, "unit lane"]:
        """`moving` lacks the floor, the first of the polygons, which never moves."""
        kernel = self.param("kernel", orthogonal(HIDDEN_GAIN), (self.units, len(entities.rows)))
        bias = self.param("bias", nn.initializers.zeros, (self.units,))
        constant = kernel @ entities.rows + bias[:, None]
        still = constant.shape[1] - moving.shape[1]
        change = jnp.tensordot(rows(kernel.T, self.kind.moving_rows), moving, (0, 0))
        encoded = nn.tanh(constant[:, still:, None] + change)
        average = (encoded * entities.weight[still:, None]).sum(1)
        return average + (nn.tanh(constant[:, :still]) @ entities.weight[:still])[:, None]


class EntityTrunk(nn.Module):
    width: int
    depth: int
    encoding: int
    outputs: int
    gain: float
    any_size: bool = False  # whether to have parameters for kinds that the size has no entities of, too

    @nn.compact
    def __call__(self, constant: Constant, moving: list[Float[Array, "moving entity lane"]]) -> Array:
        averages = [
            Encoder(self.encoding, kind, name=kind.name)(entities, of_kind)
            for kind, entities, of_kind in zip(KINDS, constant, moving, strict=True)
            if entities.weight.size or self.any_size
        ]
        x = jnp.concatenate(averages)
        for _ in range(self.depth - 1):
            x = nn.tanh(Dense(self.width, HIDDEN_GAIN)(x))
        self.sow(*SUMMARY, x)
        return Dense(self.outputs, self.gain)(x)


class EntityNetwork(nn.Module):
    """Separate networks for policy and value of one level."""

    size: Size
    width: int
    depth: int  # hidden layers; the encoders are the first
    encoding: int  # units of an encoder

    @staticmethod
    def constant(levels: Level) -> Constant:
        """Compute the constants of each level."""
        size, features, bodies = levels.size, level_features(levels), resting_bodies(levels)
        entities, offset, lanes = [], 0, features.shape[-1]
        for kind, active, (count, width) in zip(KINDS, active_entities(levels), tables_of(size), strict=True):
            block = features[offset : offset + count * width].reshape(count, width, lanes)
            one_hot = block[:, kind.own_rows :].reshape(count, kind.ends, size.bodies, lanes)
            at_ends = jnp.einsum("brl,tebl->ertl", bodies, one_hot).reshape(kind.ends * BODY_ROWS, count, lanes)
            gravity = jnp.broadcast_to(features[-1], (1, count, lanes))
            rows = jnp.concatenate([block[:, : kind.own_rows].swapaxes(0, 1), at_ends, gravity])
            weight = active / jnp.maximum(active.sum(0), 1)
            entities.append(Entities(rows, weight, one_hot[:, :, FIXED_POLYGONS:].swapaxes(0, 1)))
            offset += count * width
        return tuple(entities)

    @nn.compact
    def __call__(
        self, constant: Constant, moving: Float[Array, "dynamic lane"]
    ) -> tuple[Float[Array, "logit lane"], Float[Array, " lane"]]:
        of_kinds = moving_things(self.size, constant, moving)
        trunk = lambda outputs, gain, name: EntityTrunk(self.width, self.depth, self.encoding, outputs, gain, name=name)
        logits = trunk(LOGITS, POLICY_GAIN, "policy")(constant, of_kinds)
        return logits, trunk(1, VALUE_GAIN, "value")(constant, of_kinds)[0]


def active_entities(levels: Level) -> list[Float[Array, "entity level"]]:
    """Return 1 for active entities, by kind; the floor represents all scenery."""
    model, size = levels.model, levels.size
    polygons = jnp.concatenate([model.active[:1], model.active[FIXED_POLYGONS : size.polygons]])
    kinds = (polygons, model.active[size.polygons :], model.joint_active, model.thruster_active)
    return [active.astype(jnp.float32) for active in kinds]


def resting_bodies(levels: Level) -> Float[Array, "body row level"]:
    """Return the rows common to bodies of any shape, scenery included; 0 in moving rows."""
    scenery, movable = slice(0, FIXED_POLYGONS), slice(FIXED_POLYGONS, None)
    parts = [body_rows(levels, scenery), body_rows(levels, movable, constant=True)]
    stacks = [jnp.stack([row.astype(jnp.float32) for row in jnp.broadcast_arrays(*part)], 1) for part in parts]
    return jnp.clip(jnp.nan_to_num(jnp.concatenate(stacks)), -LIMIT, LIMIT)


def moving_things(
    size: Size, constant: Constant, moving: Float[Array, "dynamic lane"]
) -> list[Float[Array, "moving entity lane"]]:
    """Return the moving rows of all entities except the floor, by kind."""
    bodies = moving.reshape(size.bodies - FIXED_POLYGONS, len(DYNAMIC_ROWS), moving.shape[-1])
    polygons = size.polygons - FIXED_POLYGONS
    at_ends = [jnp.tensordot(entities.ends, bodies, 1) for entities in constant[2:]]
    of_kinds = [bodies[None, :polygons], bodies[None, polygons:], *at_ends]
    return [x.swapaxes(1, 2).reshape(x.shape[0] * x.shape[2], x.shape[1], x.shape[3]) for x in of_kinds]

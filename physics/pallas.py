"""The step as one Pallas kernel, for accelerators: each program of the grid steps a block of lanes.

From the same source as the machine code of `physics.step`. Tested in Pallas's interpreter only: no accelerator has
compiled or timed it yet (docs/physics.md).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl

from physics.engine import Block, Given, step_block
from physics.lanes import LANES
from physics.pairs import table_of
from physics.rooms import Room, is_room, manifold_rooms, scratch_rooms
from physics.types import Params, State


def as_pallas(given: Given, params: Params, seen: bool, interpret: bool = False) -> tuple[State, Any]:
    """Advance every lane by `params.dt`; the number of lanes is a multiple of LANES.

    Returns:
        As `physics.step`.
    """
    size, lanes = given.model.size, given.before.rotation.shape[-1]
    table = jax.tree.map(jnp.asarray, table_of(size, params.faithful_padding))
    results, scratch = (given.before, manifold_rooms(size) if seen else None), scratch_rooms(size)
    shapes = jax.tree.map(partial(_shape, lanes=lanes), (results, scratch), is_leaf=is_room)

    def kernel(given, table, results, scratch):
        after, contacts = results
        step_block(Block(table, given, after, contacts, scratch), params)

    filled = pl.pallas_call(
        kernel,
        out_shape=shapes,
        grid=(lanes // LANES,),
        in_specs=(jax.tree.map(_lanes_of, given), jax.tree.map(_whole, table)),
        out_specs=jax.tree.map(lambda x: _lanes_of(x) if x.shape[-1:] == (lanes,) else _whole(x), shapes),
        interpret=interpret,
    )(given, table)
    return filled[0]


def _shape(room: Room | jax.Array, lanes: int) -> jax.ShapeDtypeStruct:
    if isinstance(room, Room):
        return jax.ShapeDtypeStruct((*room.shape, lanes) if room.lanes else room.shape, room.dtype)
    return jax.ShapeDtypeStruct(room.shape, room.dtype)


def _lanes_of(x: Any) -> pl.BlockSpec:
    """The program's block of lanes."""
    return pl.BlockSpec((*x.shape[:-1], LANES), lambda block: (*[0] * (x.ndim - 1), block))


def _whole(x: Any) -> pl.BlockSpec:
    return pl.BlockSpec(x.shape, lambda _: (0,) * x.ndim)

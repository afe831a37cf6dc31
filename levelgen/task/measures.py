"""Distances and points that a record stores besides physics, computed by kernels, so that every bit is portable.

XLA would fuse products and sums on processors that can, and so round differently there.
"""

from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from levelproof.levelgen.level import KERNEL_SOURCES, Level, Role
from levelproof.physics.buffers import buffers_of
from levelproof.physics.codegen.buffers import Buffer
from levelproof.physics.codegen.call import Compiled, Kernel, by_platform, compiled_once
from levelproof.physics.lanes import Ref, anywhere, each, gather, when
from levelproof.physics.trigonometry import cos_sin
from levelproof.physics.types import FIXED_POLYGONS, Size, State
from levelproof.physics.vector import Vec, unvec


class RoleBodies(NamedTuple):
    """The bodies of a world."""

    position: Float[Ref, "body 2 lane"]
    role: Int[Ref, "body lane"]  # plain if the body is not active


class Anchors(NamedTuple):
    """Points that are fixed to bodies."""

    position: Float[Ref, "body 2 lane"]
    rotation: Float[Ref, "body lane"]
    body: Int[Ref, "point lane"]  # to which the point belongs
    point: Float[Ref, "point 2 lane"]  # in the body's frame


def goal_distance(level: Level, state: State) -> Float[Array, " lane"]:
    """Return the distance between centres, m, summed over all pairs of green and blue that are not both scenery."""
    lanes = state.rotation.shape[-1]
    role = jnp.where(level.model.active, level.role, Role.PLAIN)
    goals = RoleBodies(state.position, jnp.broadcast_to(role, (len(role), lanes)))
    return _run(_distance_kernel(level.size), goals, lanes)


def world_points(
    state: State, body: Int[Array, "point lane"], point: Float[Array, "point 2 lane"]
) -> Float[Array, "point 2 lane"]:
    """Transform points from the frames of bodies to the world, m."""
    if not len(body):
        return jnp.zeros_like(point)
    lanes = state.rotation.shape[-1]
    widen = lambda x: jnp.broadcast_to(x, (*x.shape[:-1], lanes))
    anchors = Anchors(state.position, state.rotation, widen(body), widen(point))
    return _run(_points_kernel(len(state.rotation), len(body)), anchors, lanes)


def _run(kernel: Kernel, arguments: Any, lanes: int) -> Any:
    return by_platform(
        lambda given: _compiled(kernel)(given, lanes),
        lambda given: kernel.on_all_lanes(given, lanes, arguments.position.dtype),
        arguments,
    )


@cache
def _distance_kernel(size: Size) -> Kernel:
    return Kernel(_sum_distances, buffers_of(RoleBodies, size), (), Buffer(()), ())


def _sum_distances(goals: RoleBodies, _: tuple, total: Ref, __: tuple) -> None:
    total[...] = jnp.zeros_like(total[...])

    def pair(i, j):
        a, b = goals.role[i], goals.role[j]
        both = ((a == Role.GREEN) & (b == Role.BLUE)) | ((a == Role.BLUE) & (b == Role.GREEN))

        def add():
            between = Vec(*(goals.position[i, axis] - goals.position[j, axis] for axis in range(2)))
            total[...] += jnp.where(both, between.norm(), 0.0)

        when(anywhere(both), add)

    each(goals.role.shape[0], lambda j: each(j, lambda i: pair(i, j)), first=FIXED_POLYGONS)


@cache
def _points_kernel(bodies: int, points: int) -> Kernel:
    shapes = {"position": (bodies, 2), "rotation": (bodies,), "body": (points,), "point": (points, 2)}
    anchors: dict[str, Any] = {name: Buffer(shape) for name, shape in shapes.items()}
    anchors["body"] = Buffer(shapes["body"], "int32")
    return Kernel(_place_points, Anchors(**anchors), (), anchors["point"], ())


def _place_points(anchors: Anchors, _: tuple, placed: Ref, __: tuple) -> None:
    def place(k):
        pose = lambda i: (anchors.position[i, 0], anchors.position[i, 1], anchors.rotation[i])
        x, y, rotation = gather(anchors.rotation.shape[0], pose, anchors.body[k])
        local = Vec(anchors.point[k, 0], anchors.point[k, 1])
        placed[k] = unvec(local.rotate(*cos_sin(rotation)) + Vec(x, y))

    each(placed.shape[0], place)


@compiled_once
def _compiled(kernel: Kernel) -> Compiled:
    return kernel.compiled(f"{kernel.body.__module__} {kernel.body.__qualname__}", KERNEL_SOURCES)

"""The order in which the sampler makes a block of levels.

It is that of `kinetix.environment.ued.distributions.sample_kinetix_level` 3.0.2: the floor's role; a green and a blue
body, not both fixed; a third body, joined if a motor must act; a thruster if one must act; more bodies and thrusters
while there is room; green and blue swapped at random; the rows of every kind shuffled. moves.py has the draws of each
step, distribution.py every number.

Three things are arranged differently, without effect on the distribution. All random numbers of a level are drawn at
once (draws.py). The reference branches on what to add; here every body's turn computes a free and a connected proposal
and selects one (`Plan`). The forced thruster is added after all bodies, but to one that existed when the reference
adds it. Distributions other than the default may also turn the floor green or leave out kinds of actuators.
"""

import functools
from enum import IntEnum
from math import prod
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from levelproof.levelgen.level import Role
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.draft import Draft, LevelRows, Notes, Used
from levelproof.levelgen.sampling.draws import AT_ONCE, pick
from levelproof.levelgen.sampling.moves import (
    ThrusterDraws,
    add_thruster,
    propose_connected,
    propose_free,
    weigh_targets,
)
from levelproof.levelgen.sampling.proposal import BodyDraws, Flag, Lane, Proposal, count_contacts, insert
from levelproof.levelgen.sampling.shuffle import NewOrder, shuffle, shuffled_rows
from levelproof.physics.buffers import buffers_of
from levelproof.physics.codegen.buffers import Buffer
from levelproof.physics.lanes import Ref, Scalar, each
from levelproof.physics.types import FIXED_POLYGONS, Size

GOAL_BODIES = 2  # green and blue come first


class Filling(IntEnum):
    """What to add at each turn after the first three bodies (green, blue and another)."""

    CONNECTED = 0
    FREE = 1
    NOTHING = 2


class LevelDraws(NamedTuple):
    """Random numbers drawn once per level, each [lane]."""

    floor: Lane
    first_moves: Lane
    control: Lane
    swap: Lane


class FillingDraws(NamedTuple):
    """Random number of one body's turn, [lane]."""

    kind: Lane


class OrderDraws(NamedTuple):
    """Random number for a random order: one for each row of every kind, [lane]."""

    order: Lane


class Plan(NamedTuple):
    """What to add at a body's turn, each [lane]."""

    add: Flag
    connect: Flag
    revolute: Flag  # the joint must be revolute
    may_be_fixed: Flag


class Layout(NamedTuple):
    """The index of the first random number of each kind; `total` is their count."""

    once: int
    fillings: int
    bodies: int
    thrusters: int
    order: int
    total: int


class Results(NamedTuple):
    """What the kernel returns."""

    rows: LevelRows
    collides: Bool[Ref, "body body lane"]


class Workspace(NamedTuple):
    """Scratch memory of the kernel."""

    draft: Draft
    order: NewOrder
    numbers: Float[Ref, "number lane"]  # all random numbers of a level, by `Layout`
    chosen: Float[Ref, "draw lane"]  # random numbers of the proposal with the fewest contacts so far
    contacts: Float[Ref, " lane"]  # contacts of that proposal


def scratch_of(size: Size, layout: Layout) -> Workspace:
    """Return the buffers of scratch memory."""
    rows = lambda *shape: cast(Ref, Buffer(shape))
    return Workspace(
        draft=Draft(buffers_of(LevelRows, size), buffers_of(Used, size), buffers_of(Notes, size)),
        order=buffers_of(NewOrder, size),
        numbers=rows(-(-layout.total // AT_ONCE) * AT_ONCE),
        chosen=rows(len(BodyDraws._fields)),
        contacts=rows(),
    )


def layout_of(size: Size, dist: Distribution) -> Layout:
    """Return the index at which each kind of random number begins: kinds follow one another, in each its fields."""
    kinds: list[tuple[Any, tuple[int, ...]]] = [
        (LevelDraws, ()),
        (FillingDraws, (turns(size),)),
        (BodyDraws, (turns(size), proposals(size, dist))),
        (ThrusterDraws, (size.thrusters,)),
        (OrderDraws, (sum(shuffled_rows(size)),)),
    ]
    counts = [len(kind._fields) * prod(shape) for kind, shape in kinds]
    return Layout(*np.cumsum([0, *counts]).tolist())


def turns(size: Size) -> int:
    """Return the number of bodies that the sampler tries to add: one for every row."""
    return size.bodies - FIXED_POLYGONS


def proposals(size: Size, dist: Distribution) -> int:
    """Return the number of proposals for each body."""
    return 1 if size.bodies <= dist.small_world else dist.proposals


def sample_block(results: Results, scratch: Workspace, layout: Layout, dist: Distribution) -> None:
    """Sample a block of levels from the random numbers in `scratch`, whose draft contains only the scenery."""
    draft, numbers = scratch.draft, scratch.numbers
    size = draft.size
    once = LevelDraws(*(numbers[layout.once + i] for i in range(len(LevelDraws._fields))))
    set_floor(draft, once.floor, dist)
    motor, thruster = draw_control(once.control, size, dist)

    def add(turn):
        plan = plan_body(turn, draft.rows.role[0], once, numbers[layout.fillings + turn], motor, size, dist)
        add_body(scratch, layout.bodies, plan, turn, dist)

    each(turns(size), add)

    def push(index):
        fields = range(len(ThrusterDraws._fields))
        d = ThrusterDraws(*(numbers[layout.thrusters + size.thrusters * i + index] for i in fields))
        wanted = jnp.where(index == 0, thruster, d.wanted < dist.extra_thruster_chance)
        add_thruster(draft, d, wanted, jnp.where(index == 0, GOAL_BODIES, size.bodies), dist)

    each(size.thrusters, push)
    swap_roles(draft, once.swap < dist.swap_chance)
    shuffle(draft, scratch.order, numbers, layout.order, results.rows, results.collides)


def set_floor(draft: Draft, u: Lane, dist: Distribution) -> None:
    """Draw the floor's role."""
    chances = [0.0, dist.floor_green_chance, dist.floor_blue_chance, dist.floor_red_chance]
    chances[Role.PLAIN] = 1 - sum(chances)
    draft.rows.role[0] = floor = pick(chances, u)
    for role in Role:
        draft.used.roles[role] = floor == role


def add_body(scratch: Workspace, first: int, plan: Plan, turn: Scalar, dist: Distribution) -> None:
    """Add the planned body: of its proposals, the one with the fewest contacts; the first one if several tie.

    If there are several proposals, an extra round repeats the chosen one and inserts it. `first` is the index of the
    first body's random numbers.
    """
    draft, numbers, chosen, contacts = scratch.draft, scratch.numbers, scratch.chosen, scratch.contacts
    count = proposals(draft.size, dist)
    fields, stride = range(len(BodyDraws._fields)), turns(draft.size) * count
    weigh_targets(draft, dist)
    if count > 1:
        contacts[...] = jnp.full_like(contacts[...], jnp.inf)

    def compare(p: Proposal, d: BodyDraws) -> None:
        score = count_contacts(draft, p) + jnp.where(p.hidden, dist.hidden_penalty, 0.0)
        better = score < contacts[...]
        contacts[...] = jnp.where(better, score, contacts[...])
        for i in fields:
            chosen[i] = jnp.where(better, d[i], chosen[i])

    def one(index):
        last = index == count
        read = lambda i: numbers[first + i * stride + turn * count + jnp.where(last, 0, index)]
        d = (
            BodyDraws(*(jnp.where(last, chosen[i], read(i)) for i in fields))
            if count > 1
            else BodyDraws(*map(read, fields))
        )
        p = propose(draft, d, plan, dist)
        if count > 1:
            jax.lax.cond(last, lambda: insert(draft, p, turn), lambda: compare(p, d))
        else:
            insert(draft, p, turn)

    each(count + (count > 1), one)


def propose(draft: Draft, d: BodyDraws, plan: Plan, dist: Distribution) -> Proposal:
    """Propose a body as planned."""
    connected = propose_connected(draft, d, plan.revolute, dist)
    free = propose_free(draft, d, plan.may_be_fixed, connected.joint, dist)
    p: Proposal = jax.tree.map(lambda a, b: jnp.where(plan.connect, a, b), connected, free)
    return p._replace(possible=p.possible & plan.add, joined=p.joined & plan.connect & plan.add)


def swap_roles(draft: Draft, wanted: Flag) -> None:
    """Swap green and blue where wanted, unless the floor has a role."""
    role = draft.rows.role
    swaps = wanted & (role[0] == Role.PLAIN)

    def one(i):
        swapped = jnp.where(role[i] == Role.GREEN, Role.BLUE, jnp.where(role[i] == Role.BLUE, Role.GREEN, role[i]))
        role[i] = jnp.where(swaps, swapped, role[i])

    each(role.shape[0], one)


def control_weights(size: Size, dist: Distribution) -> dict[tuple[bool, bool], float]:
    """Return the weights of (motor required, thruster required); leave out those that the size has no room for."""
    weights = {
        (False, True): dist.thruster_only_weight,
        (True, False): dist.motor_only_weight,
        (True, True): dist.motor_and_thruster_weight,
    }
    room = (size.joints > 0 and turns(size) > GOAL_BODIES, size.thrusters > 0)
    return {kind: weight for kind, weight in weights.items() if weight and np.all(np.array(room) >= kind)}


def draw_control(u: Lane, size: Size, dist: Distribution) -> tuple[Flag, Flag]:
    """Draw whether a motor and a thruster are required; neither if the size has no room for what the weights allow."""
    kinds = control_weights(size, dist) or {(False, False): 1.0}
    upper = np.cumsum(list(kinds.values()), dtype=np.float32).tolist()
    chosen = sum(((u * upper[-1] >= bound).astype(jnp.int32) for bound in upper[:-1]), jnp.zeros_like(u, jnp.int32))
    required = lambda part: functools.reduce(
        jnp.logical_or, [chosen == i for i, kind in enumerate(kinds) if kind[part]], jnp.zeros_like(u, bool)
    )
    return required(0), required(1)


def plan_body(
    turn: Scalar,
    floor: Int[Array, " lane"],
    once: LevelDraws,
    filling: Lane,
    motor: Flag,
    size: Size,
    dist: Distribution,
) -> Plan:
    """Plan two free bodies, one of them movable; a third, joined if a motor is required; then random ones."""
    kind = pick([dist.connected_weight, dist.free_weight, dist.empty_weight], filling)
    later = turn > GOAL_BODIES
    # If the floor is green or blue, the first body becomes the other goal and must move, since the floor cannot
    first = (once.first_moves < 0.5) | (floor == Role.GREEN) | (floor == Role.BLUE)
    must_move = jnp.where(turn == 0, first, (turn == 1) & ~first) | (size.bodies <= dist.small_world)
    return Plan(
        add=~later | (kind != Filling.NOTHING),
        connect=jnp.where(later, kind == Filling.CONNECTED, (turn == GOAL_BODIES) & motor),
        revolute=(turn == GOAL_BODIES) & jnp.ones_like(motor),
        may_be_fixed=~must_move,
    )

"""The programs of a pool, from its settings alone: workers can divide and compile them before levels arrive."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np

from levelproof.experts.batcher import Rows, blank, entered
from levelproof.experts.config import RECORD_STEPS, Rule
from levelproof.experts.pool import rework, strengthen
from levelproof.experts.pool.pool import GROUP, Pool, slot_count
from levelproof.experts.search import explore, vary
from levelproof.experts.search.play import most_steps
from levelproof.experts.search.search import ALONE, explored, side_by_side, varied
from levelproof.experts.search.shorten import shorten
from levelproof.experts.training.advance import advance
from levelproof.experts.training.slots import Pending, begin, slots_of
from levelproof.experts.verdict import afresh, portability
from levelproof.experts.witness.success import no_success
from levelproof.experts.witness.witness import replay_block
from levelproof.levelgen.batching import LANES, at_once
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.programs import TRACING, StoredProgram
from levelproof.levelgen.proofs import examine
from levelproof.physics.buffers import buffers_of
from levelproof.physics.types import Size


class Program(NamedTuple):
    """A stored function, and the shapes and settings of a call; once compiled for these, the call compiles nothing."""

    function: StoredProgram
    call: Callable[[], tuple[tuple[Any, ...], dict[str, Any]]]  # makes the positional and named arguments
    stage: str = ""  # what distinguishes programs of one function, such as the stage whose slots it serves

    @property
    def name(self) -> str:
        return f"{self.function.__module__}.{self.function.__name__} {self.stage}".rstrip()

    def prepare(self) -> None:
        """Load or compile it, for this process and others with the same cache folder."""
        with TRACING:
            arguments, settings = self.call()
        self.function.prepare(*arguments, **settings)


def programs_of(pool: Pool, size: Size) -> list[Program]:
    """Return the programs that most jobs of this size use, roughly those that take longest to compile first."""
    trains = pool.procedure.stop.rule != Rule.NONE
    programs = searching(pool, size) + (training(pool, size) if trains else []) + judging(pool, size, trains)
    rank = {function: number for number, function in enumerate(LONGEST)}
    return sorted(programs, key=lambda program: rank.get(program.function, len(rank)))


def searching(pool: Pool, size: Size) -> list[Program]:
    """Return programs of the search before training."""
    config, rules = pool.procedure.search.scaled(size.bodies), pool.rules
    if not config.env_steps:
        return []
    width, ends, endless = side_by_side(config), {"ends": config.ends}, config.endless
    some = levels_of(size, width), ids_of(width)
    first = cache(lambda: explore.begin.eval_shape(*some, endless, rules))
    nearest = cache(lambda: vary.nearest_of.eval_shape(first().archive))
    again = cache(lambda: vary.begin.eval_shape(*some, nearest(), endless))
    alone = at_once(config.lanes, ALONE)
    always = [
        Program(explore.begin, lambda: ((*some, endless, rules), {})),
        Program(explored, lambda: ((first(),), ends)),
        entering(first, width, "search"),
        Program(explore.explore_rounds, lambda: ((first(), config.ends, endless, rules), {})),
        Program(shorten, lambda: ((levels_of(size, alone), ids_of(alone), no_success(alone), endless, rules), {})),
    ]
    variations = [
        Program(vary.nearest_of, lambda: ((first().archive,), {})),
        Program(vary.begin, lambda: ((*some, nearest(), endless), {})),
        entering(again, width, "variations"),
        Program(vary.vary_rounds, lambda: ((again(), config.ends, endless, rules), {})),
        Program(varied, lambda: ((again(),), ends)),
    ]
    return always + variations if config.variations else always


def training(pool: Pool, size: Size) -> list[Program]:
    """Return programs of the slots."""
    config, no, width = pool.config, np.zeros(GROUP, bool), slot_count(pool.config)
    group, pending = (levels_of(size, GROUP), ids_of(GROUP)), Pending(no, no, np.zeros(GROUP, np.int32))
    experts = cache(lambda: begin.eval_shape(*group, no_success(GROUP), config))
    fresh = cache(lambda: slots_of.eval_shape(*group, experts(), pending, config))
    return [
        Program(begin, lambda: ((*group, no_success(GROUP), config), {})),
        Program(slots_of, lambda: ((*group, experts(), pending, config), {})),
        entering(fresh, width, "training"),
        Program(advance, lambda: ((blank(fresh(), width), config, pool.stopping, pool.shaped), {})),
    ]


def entering(fresh: Callable[[], Rows], width: int, stage: str) -> Program:
    """Return the program by which levels enter slots; `fresh` returns the shapes of a group's state."""
    group = lambda: np.zeros(len(fresh().level_ids), int)
    return Program(entered, lambda: ((blank(fresh(), width), fresh(), group(), group()), {}), stage)


def judging(pool: Pool, size: Size, trains: bool) -> list[Program]:
    """Return programs that decide levels before and after training."""
    config, rules, rounds = pool.config, pool.rules, pool.procedure.search.robustness
    some = lambda count: (levels_of(size, count), ids_of(count))
    acted = lambda count, dtype: jax.ShapeDtypeStruct((RECORD_STEPS, ACTIONS, count), dtype)
    programs = [
        Program(examine, lambda: ((levels_of(size, LANES), rules, most_steps(rules)), {})),
        Program(replay_block, lambda: ((levels_of(size, LANES), acted(LANES, np.int32), rules), {})),
    ]
    if config.replays:
        one = at_once(config.replays, portability.IN_CACHE)
        given = *some(one), acted(one, np.int8), ids_of(one), config.replays, rules
        programs.append(Program(portability.survival_block, lambda: (given, {})))
    if config.replays and rounds:
        few = at_once(strengthen.KEPT * strengthen.STARTS, rework.IN_CACHE)
        programs.append(Program(strengthen.strengthen, lambda: ((*some(few), no_success(few), rounds, rules), {})))
    if trains:
        count = at_once(config.attempts, afresh.IN_CACHE)
        params = lambda: begin.eval_shape(*some(count), no_success(count), config).training.train_state.params
        programs.append(Program(afresh.attempt_block, lambda: ((*some(count), params(), config, rules), {})))
    return programs


def levels_of(size: Size, count: int) -> Level:
    """Return the shapes of levels."""
    return jax.tree.map(lambda buffer: buffer.array(count), buffers_of(Level, size))


def ids_of(count: int) -> jax.ShapeDtypeStruct:
    """Return the shape of level ids."""
    return jax.ShapeDtypeStruct((count,), np.int32)


# By seconds of compiling, measured for levels of size s; all others take less. But one thread traces at a time, and to
# trace `advance` takes two seconds, in which XLA can compile what was traced before.
LONGEST = (
    explore.explore_rounds,
    advance,
    strengthen.strengthen,
    afresh.attempt_block,
    vary.vary_rounds,
    begin,
    replay_block,
    portability.survival_block,
    shorten,
    explore.begin,
    examine,
    entered,
)

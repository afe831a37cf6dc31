"""Cost of a physics step, stage by stage, against the floor of its arithmetic.

Times: the machine code of the first 1, 2, ... stages (physics/engine.py) over sampled levels in mid-episode, one core;
a stage costs what it adds. Work: an interpreter of the kernel's jaxpr runs the same blocks and counts vector
operations, loads and stores of rows. Floor: vector operations at VECTORS_PER_CYCLE and the core's measured clock.
"""

import argparse
import time
from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from benchmarks.report import Report, Table
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES, controls
from levelproof.physics.block import Block, Inputs, Scratch
from levelproof.physics.buffers import buffers_of
from levelproof.physics.codegen.buffers import LANES
from levelproof.physics.codegen.primitives import ELEMENTWISE
from levelproof.physics.engine import STAGES, step_block
from levelproof.physics.pairs import table_of
from levelproof.physics.step import as_machine_code
from levelproof.physics.types import DEFAULT_PARAMS
from levelproof.pipeline.runtime import own_cores, prepare_jax

LEVELS, COUNTED = 1024, 64  # lanes timed, lanes counted
STEPS = 32  # env steps under random actions before the measurement
VECTORS_PER_CYCLE = 2  # 512-bit arithmetic of this generation of cores
REPEATS = 40
CUTS = (*((stage,) for stage in STAGES[:-2]), STAGES[-2:])  # the last stage is too short to time by itself


def worlds(size: str) -> Inputs:
    """Sample levels, play them into mid-episode, and return their states with controls."""
    level = sample_levels(np.arange(LEVELS), SIZES[size])
    choices = jnp.array(CHOICES)[:, None]

    def act(now, key):
        action = jax.random.randint(key, (6, LEVELS), 0, choices)
        return task.step(level, now, action)[0], action

    now, actions = jax.jit(lambda now: jax.lax.scan(act, now, jax.random.split(jax.random.key(0), STEPS)))(
        task.reset(level)
    )
    return Inputs(level.model, now.state, *controls(level, actions[-1]))


def seconds(inputs: Inputs, stages: tuple) -> float:
    """Time the stages on one block of lanes, s; the best of REPEATS."""
    compiled = jax.jit(lambda inputs: as_machine_code(inputs, DEFAULT_PARAMS, False, stages))
    jax.block_until_ready(compiled(inputs))
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(compiled(inputs))
        best = min(best, time.perf_counter() - start)
    return best / (LEVELS / LANES)


def count(inputs: Inputs, stages: tuple) -> Counter:
    """Count vector operations, loads and stores of one block of lanes, on average."""
    size, total = inputs.model.size, Counter()

    def kernel(inputs, table, after, scratch):
        table, inputs, after, scratch = jax.tree.map(jax.new_ref, (table, inputs, after, scratch))
        block = Block(table, inputs, after, None, scratch)
        step_block(block, DEFAULT_PARAMS, stages)

    table = table_of(size, True)
    scratch = jax.tree.map(lambda buffer: np.zeros(buffer.array().shape, buffer.dtype), buffers_of(Scratch, size))
    for first in range(0, COUNTED, LANES):
        block_inputs = jax.tree.map(lambda x, at=first: np.array(x[..., at : at + LANES]), inputs)
        arguments = block_inputs, table, jax.tree.map(np.zeros_like, block_inputs.before), scratch
        closed = jax.make_jaxpr(kernel)(*arguments)
        interpret(closed.jaxpr, [np.array(x) for x in (*closed.consts, *jax.tree.leaves(arguments))], total)
    return Counter({what: n * LANES // COUNTED for what, n in total.items()})


def rows(shape: tuple[int, ...]) -> int:
    return int(np.prod(shape[:-1])) if shape and shape[-1] == LANES else 0


def interpret(jaxpr: core.Jaxpr, arguments: list, total: Counter) -> list:
    """Interpret a kernel whose references are NumPy arrays; add its work to `total`."""
    known = dict(zip(jaxpr.invars, arguments, strict=True))
    read = lambda x: x.val if isinstance(x, core.Literal) else known[x]
    for equation in jaxpr.eqns:
        results = one(equation, [read(x) for x in equation.invars], total)
        known.update(zip(equation.outvars, results, strict=True))
    return [read(x) for x in jaxpr.outvars]


def one(equation, operands: list, total: Counter) -> list:
    name, params = equation.primitive.name, equation.params
    if name == "new_ref":
        return operands
    if name in ("get", "swap", "addupdate"):
        return access(name, params, operands, total)
    if name == "while":
        n, m = params["cond_nconsts"], params["body_nconsts"]
        of_test, of_body, values = operands[:n], operands[n : n + m], operands[n + m :]
        while interpret(params["cond_jaxpr"].jaxpr, [*of_test, *values], total)[0]:
            values = interpret(params["body_jaxpr"].jaxpr, [*of_body, *values], total)
        return values
    if name == "scan":
        constants, values = operands[: params["num_consts"]], operands[params["num_consts"] :]
        for _ in range(params["length"]):
            values = interpret(params["jaxpr"].jaxpr, [*constants, *values], total)
        return values
    if name == "cond":
        return interpret(params["branches"][int(operands[0])].jaxpr, operands[1:], total)
    if name == "jit":
        return interpret(params["jaxpr"].jaxpr, operands, total)
    results = equation.primitive.bind(*map(jnp.asarray, operands), **params)
    results = results if equation.primitive.multiple_results else [results]
    if name in ELEMENTWISE or name in ("integer_pow", "convert_element_type"):
        total["operations"] += rows(results[0].shape)
    elif name.startswith("reduce_"):
        total["operations"] += max(rows(operands[0].shape) - rows(results[0].shape), 1)
    return [np.asarray(x) for x in results]


def access(name: str, params: dict, operands: list, total: Counter) -> list:
    """Read or write rows of a reference; add them to `total`."""
    written = name != "get"
    transforms = jax.tree.unflatten(params["tree"], operands[1 + written :])
    index = tuple(
        slice(int(i.start), int(i.start) + i.size) if hasattr(i, "stride") else int(i)
        for i in (transforms[0].indices if transforms else ())
    )
    ref = operands[0]
    total["stores" if written else "loads"] += rows(np.shape(ref[index]))
    if name == "get":
        return [np.array(ref[index])]
    ref[index] = operands[1] + (ref[index] if name == "addupdate" else 0)
    return [None] * (name == "swap")


def clock() -> float:
    """Measure the core's clock, Hz, with a chain of dependent integer operations."""
    from llvmlite import binding, ir

    module, integer = ir.Module(), ir.IntType(64)
    function = ir.Function(module, ir.FunctionType(integer, [integer]), "chain")
    b = ir.IRBuilder(function.append_basic_block())
    start, body, done = b.block, b.append_basic_block(), b.append_basic_block()
    b.branch(body)
    b.position_at_end(body)
    i, x = b.phi(integer), b.phi(integer)
    i.add_incoming(integer(0), start)
    x.add_incoming(integer(1), start)
    y = x
    for _ in range(16):
        y = b.xor(b.add(y, i), integer(0x5DEECE66D))  # two dependent operations of one cycle each
    after = b.add(i, integer(1))
    i.add_incoming(after, body)
    x.add_incoming(y, body)
    b.cbranch(b.icmp_unsigned("<", after, function.args[0]), body, done)
    b.position_at_end(done)
    b.ret(y)
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    target = binding.Target.from_default_triple().create_target_machine(opt=1)
    engine = binding.create_mcjit_compiler(binding.parse_assembly(str(module)), target)
    import ctypes

    chain = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)(engine.get_function_address("chain"))
    rounds, best = 1_000_000, np.inf
    for _ in range(5):
        begin = time.perf_counter()
        chain(rounds)
        best = min(best, time.perf_counter() - begin)
    return rounds * 32 / best


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")


def run(args: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))
    cycles = clock()
    results = [measured(size, cycles) for size in args.size]
    groups = list(results[0]["stages"])
    rows = []
    for result in results:
        took = [f"{result['stages'][name]['microseconds']:.2g}" for name in groups]
        moved = result["loads"] + result["stores"]
        work = (
            f"{result['operations']:,}",
            f"{moved:,}",
            f"{result['floor']:.2f}",
            f"{result['microseconds'] / result['floor']:.1f}",
        )
        rows.append([result["size"], *took, f"{result['microseconds']:.2g}", *work])
    head = ("size", *groups, "all", "vector operations", "loads and stores", "floor", "times the floor")
    title = f"Microseconds of one core for a block of {LANES} lanes and one physics step"
    return Report(
        title="What a physics step costs",
        results=results,
        tables=[Table(head, rows, title)],
        notes=[f"The core's clock: {cycles / 1e9:.2f} GHz. Floor: {VECTORS_PER_CYCLE} vector operations per cycle."],
    )


def measured(size: str, cycles: float) -> dict[str, Any]:
    """Measure microseconds and work of each group of stages, and of the whole step."""
    inputs, before, counted, stages = worlds(size), 0.0, Counter(), {}
    for group in CUTS:
        done = STAGES[: STAGES.index(group[-1]) + 1]
        now, work = seconds(inputs, done), count(inputs, done)
        stages[", ".join(stage.__name__ for stage in group)] = costs(now - before, work - counted, cycles)
        before, counted = now, work
    return {"size": size, **costs(before, counted, cycles), "clock": cycles, "stages": stages}


def costs(took: float, work: Counter, cycles: float) -> dict[str, float]:
    floor = work["operations"] / VECTORS_PER_CYCLE / cycles
    parts = {what: work[what] for what in ("operations", "loads", "stores")}
    return {"microseconds": took * 1e6, **parts, "floor": floor * 1e6}

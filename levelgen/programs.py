"""Programs that processes share: one makes them, the others load them without tracing the function.

JAX's own cache looks programs up by their trace, and tracing takes longer than loading. Here the key consists of the
function's name, its static arguments, the shapes of the others, all sources, and JAX's versions and settings. The key's
file names the program's file, which in turn is named after the trace, so that keys of other sources can share it.
"""

import hashlib
import inspect
import os
import pickle
import threading
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial, update_wrapper
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import jax
from jax import monitoring
from jax._src import core
from jax.core import Tracer
from jax.experimental import serialize_executable
from llvmlite import binding

from levelproof.physics.codegen.compile import register, texts_in
from levelproof.physics.codegen.kept import cache_is_on, key_by_sources, store, stored

Options = Mapping[str, Any]
# XLA's options for CPUs. Level 1 of its optimiser makes programs as fast as level 3 does, in four fifths of the time.
# Its older code for fusions gives LLVM half as much to do, but slows down networks and the search. A program compiled
# with other options may round differently.
OPTIMISED: Options = {"xla_backend_optimization_level": 1}
OLDER_FUSIONS = {**OPTIMISED, "xla_cpu_use_fusion_emitters": False}
UNOPTIMISED: Options = {"xla_backend_optimization_level": 0}
SOONEST = {**OLDER_FUSIONS, **UNOPTIMISED}  # in place of all others while `jax_disable_most_optimizations` is on
SOURCES = [Path(__file__).parents[1] / room for room in ("physics", "levelgen", "experts")]
LOADED = "/jax/core/compile/levelproof_load"  # event that counts as compiling, as JAX's own do
COMPILED = "/jax/compilation_cache/cache_misses"  # JAX's event when it has compiled a program and written it
TRACING = threading.RLock()  # Python's part of compiling gains nothing from threads, and shares what it caches
T = TypeVar("T")


class Call(NamedTuple):
    """What decides a program: static arguments, and the types of the others."""

    static: tuple[Any, ...]
    tree: Any
    types: tuple[Any, ...]
    settings: tuple[Any, ...]  # of JAX, those that a process may change between calls


class StoredProgram(Generic[T]):
    """A jitted function, whose programs are stored beside JAX's compiled ones.

    On a GPU, on several devices or without a folder for the cache, it is `jax.jit` with XLA's options. A call that JAX
    traces becomes a part of the program that is traced, with that program's options.
    """

    __name__: str  # the function's

    def __init__(self, function: Callable[..., T], options: Options = OPTIMISED, **settings: Any) -> None:
        self.function, self._given, self._settings = function, options, settings
        self._signature, self._programs = inspect.signature(function), dict[Call, Any]()
        self._jitted: dict[str, Any] = {}
        self._locks: dict[Call, threading.Lock] = {}
        names = settings.get("static_argnames", ())
        self._static = {names} if isinstance(names, str) else set(names)
        update_wrapper(self, function)

    @property
    def options(self) -> Options:
        """XLA's options for a CPU."""
        return SOONEST if jax.config.values["jax_disable_most_optimizations"] else self._given

    @property
    def program(self) -> Any:
        """The jitted function; without options on other devices, and as a part of a program, where JAX allows none."""
        options = None if _tracing() or jax.default_backend() != "cpu" else dict(self.options)
        if (key := repr(options)) not in self._jitted:
            self._jitted[key] = jax.jit(self.function, compiler_options=options, **self._settings)
        return self._jitted[key]

    def __call__(self, *args: Any, **kwargs: Any) -> T:
        given, call = self._call(args, kwargs)
        if call is None:
            return self.program(*args, **kwargs)
        return self._ready(call, args, kwargs)(*given)

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Load or compile the program for a call with these arguments, which may be shapes."""
        _, call = self._call(args, kwargs)
        if call is None:
            with TRACING:
                lowered = self.program.lower(*args, **kwargs)
            lowered.compile()
        else:
            self._ready(call, args, kwargs)

    def eval_shape(self, *args: Any, **kwargs: Any) -> Any:
        """Return the shapes of the results; arguments may be shapes."""
        return self.program.eval_shape(*args, **kwargs)

    def forget(self) -> None:
        """Drop the programs that this process holds, which take memory maps; the next calls load them again."""
        self._programs.clear()

    def count(self) -> int:
        """Return the number of programs that this process has compiled or loaded."""
        return len(self._programs) or self.program._cache_size()

    def _call(self, args: Any, kwargs: Any) -> tuple[list[Any], Call | None]:
        """Return the arguments that are not static, and what decides the program; None: leave it to `jax.jit`."""
        bound = self._bound(args, kwargs)
        static = tuple(value for name, value in bound.arguments.items() if name in self._static)
        given = [value for name, value in bound.arguments.items() if name not in self._static]
        leaves, tree = jax.tree.flatten(given)
        if _tracing() or any(isinstance(x, Tracer) for x in leaves) or not _alone() or not cache_is_on():
            return given, None
        return given, Call(static, tree, tuple(map(_type_of, leaves)), _settings())

    def _bound(self, args: Any, kwargs: Any) -> inspect.BoundArguments:
        """Assign the arguments to the function's parameters, defaults included."""
        bound = self._signature.bind(*args, **kwargs)
        bound.apply_defaults()
        return bound

    def _ready(self, call: Call, args: Any, kwargs: Any) -> Any:
        """Return the program of a call, from this process, from the disk, or made now."""
        if (program := self._programs.get(call)) is not None:
            return program
        with self._locks.setdefault(call, threading.Lock()):  # of the threads that need it, one makes it
            if call not in self._programs:
                self._programs[call] = self._found_or_made(call, args, kwargs)
        return self._programs[call]

    def _found_or_made(self, call: Call, args: Any, kwargs: Any) -> Any:
        name = f"{self.function.__module__}.{self.function.__qualname__}"
        request = f"{name} {self.options} {self._settings} {call} {machine()}"
        # Python's default text of an object contains its address, which differs between processes
        key = None if " at 0x" in request else key_by_sources(request, SOURCES)
        place = stored(key) if key else None
        return (place and _load(place.decode(), call)) or self._make(key, call, args, kwargs)

    def _make(self, key: str | None, call: Call, args: Any, kwargs: Any) -> Any:
        bound = self._bound(args, kwargs)  # as positional arguments, which is how the program is called
        with TRACING:
            lowered = self.program.lower(*bound.args, **bound.kwargs)
        if not key:
            return lowered.compile()
        text = lowered.as_text()
        # The text leaves out arguments that nothing reads, but a loaded program checks the shapes of all
        described = f"{text} {call.tree} {call.types} {call.settings} {self.options} {machine()}"
        place = "program " + hashlib.sha256(described.encode()).hexdigest()
        if program := _load(place, call):
            store(key, place.encode())
            return program
        before = _COMPILED.count
        compiled = lowered.compile()
        # XLA cannot serialize all of a program that it loaded from JAX's cache, where another thread may have put it
        if _COMPILED.count > before and _store(place, compiled, texts_in(text)):
            store(key, place.encode())
        return compiled


def jit_stored(**settings: Any) -> Callable[[Callable[..., T]], StoredProgram[T]]:
    """Return a decorator that makes functions `StoredProgram`; settings are those of `jax.jit`.

    For programs in which much of a job's time goes into XLA's code: networks, archives, copies of large arrays.
    """
    return partial(StoredProgram, **settings)  # pyright: ignore[reportReturnType]


def jit_sooner(**settings: Any) -> Callable[[Callable[..., T]], StoredProgram[T]]:
    """Return a decorator as `jit_stored` does, for functions that mostly run physics, or that a job calls rarely.

    XLA compiles them for CPUs in about half the time. They run hardly slower: physics is our own machine code.
    """
    return partial(StoredProgram, options=OLDER_FUSIONS, **settings)  # pyright: ignore[reportReturnType]


def jit_quickly(**settings: Any) -> Callable[[Callable[..., T]], StoredProgram[T]]:
    """Return a decorator as `jit_sooner` does, for functions that only lay arrays out and multiply no floats.

    XLA compiles them for CPUs without optimising. It then rounds every product before adding to it, where the optimiser
    may merge a multiplication and an addition into one operation. So a function with products of floats may change its
    bits: use this only for functions without any (tests/pipeline/jobs/test_programs.py).
    """
    return partial(StoredProgram, options=UNOPTIMISED, **settings)  # pyright: ignore[reportReturnType]


class _FreshlyCompiled(threading.local):
    """Number of programs that this thread has compiled."""

    count = 0

    def note(self, event: str, **_: object) -> None:
        if event == COMPILED:
            self.count += 1


_COMPILED = _FreshlyCompiled()
monitoring.register_event_listener(_COMPILED.note)


def _store(place: str, compiled: Any, kernels: Sequence[str]) -> bool:
    """Store a program that XLA has just compiled; return False if JAX cannot serialize it."""
    try:
        code, _, tree = serialize_executable.serialize(compiled)
        results = jax.tree.unflatten(tree, range(tree.num_leaves))  # JAX cannot pickle the tree itself
        store(place, zlib.compress(pickle.dumps((code, results, kernels)), level=1))
    except (ValueError, NotImplementedError, pickle.PicklingError):
        return False
    return True


def _load(place: str, call: Call) -> Any:
    """Return the stored program, or None if there is none that can be used."""
    if (found := stored(place)) is None:
        return None
    begun = time.perf_counter()
    try:
        code, results, kernels = pickle.loads(zlib.decompress(found))
        for text in kernels:
            register(text)
        inputs = jax.tree.structure((tuple(jax.tree.unflatten(call.tree, range(len(call.types)))), {}))
        program = serialize_executable.deserialize_and_load(code, inputs, jax.tree.structure(results))
    except Exception:  # an unusable file only costs another compilation
        return None
    monitoring.record_event_duration_secs(LOADED, time.perf_counter() - begun)
    return program


def _tracing() -> bool:
    """Whether JAX is tracing another program."""
    return not core.trace_state_clean()


def _alone() -> bool:
    """Whether there is one CPU device and no other."""
    return jax.default_backend() == "cpu" and jax.device_count() == 1


def _type_of(x: Any) -> Any:
    """Return what a program depends on of an argument."""
    if not hasattr(x, "dtype"):
        return type(x).__name__
    return x.shape, jax.dtypes.canonicalize_dtype(x.dtype), getattr(x, "weak_type", False)


def _settings() -> tuple[Any, ...]:
    values = jax.config.values
    return values["jax_enable_x64"], values["jax_disable_most_optimizations"]


def machine() -> str:
    """Return what decides compiled code besides the program: present settings, libraries and the processor."""
    values = {name: value for name, value in jax.config.values.items() if "cache" not in name}
    return f"{values} {os.environ.get('XLA_FLAGS')} {_processor()}"


@cache
def _processor() -> str:
    libraries = [version(name) for name in ("jaxlib", "flax", "optax")]  # besides those of `key_by_sources`
    return f"{libraries} {binding.get_host_cpu_name()} {binding.get_host_cpu_features().flatten()}"

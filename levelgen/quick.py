"""Programs that run too briefly to repay optimisation: compiled without it, in about half the time."""

from collections.abc import Callable
from functools import cached_property, partial, update_wrapper
from typing import Any, Generic, TypeVar

import jax

UNOPTIMISED = {"xla_backend_optimization_level": 0}
T = TypeVar("T")


class Quick(Generic[T]):
    """A jitted function that XLA compiles for CPUs without optimising; it cannot be called inside `jax.jit`.

    Without its optimiser, XLA rounds every product before adding to it; the optimiser may merge a multiplication and an
    addition into one operation. So a function with products of floats may change its bits: use this only for functions
    without any (tests/levelgen/test_quick.py). Physics is our own machine code, which stays optimised.
    """

    def __init__(self, function: Callable[..., T], **settings: Any) -> None:
        self.function, self._settings = function, settings
        update_wrapper(self, function)

    @cached_property
    def program(self) -> Any:
        """The jitted function; made on first use, because `jax.default_backend` starts the backend."""
        options = UNOPTIMISED if jax.default_backend() == "cpu" else None
        return jax.jit(self.function, compiler_options=options, **self._settings)

    def __call__(self, *args: Any, **kwargs: Any) -> T:
        return self.program(*args, **kwargs)

    def eval_shape(self, *args: Any, **kwargs: Any) -> Any:
        """Return the shapes of the results; arguments may be shapes."""
        return self.program.eval_shape(*args, **kwargs)

    def lower(self, *args: Any, **kwargs: Any) -> Any:
        """Lower as `jax.jit` does: arguments may be shapes."""
        return self.program.lower(*args, **kwargs)


def jit_quickly(**settings: Any) -> Callable[[Callable[..., T]], Quick[T]]:
    """Return a decorator that makes functions `Quick`; settings are those of `jax.jit`."""
    return partial(Quick, **settings)  # pyright: ignore[reportReturnType]

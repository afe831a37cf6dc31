"""Pytest's setup: how JAX and Hypothesis run in tests, how slow the machine is, and the reference's environment."""

import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import pytest

from benchmarks import oracle
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.runtime import CACHE_VARIABLE, prepare_jax
from tests import pace, quick

pytest_plugins = ["tests.order"]

ROOT = Path(__file__).parent.parent
REQUIRE_ORACLE = "LEVELPROOF_TEST_ORACLE"

# Workers and the commands that tests start inherit the cache folder. Set up before any test touches JAX.
os.environ.setdefault(CACHE_VARIABLE, str(ROOT / ".pytest_cache" / "levelproof"))
prepare_jax()
jax.devices()  # one, from here on: else a test that trains first would give later tests as many as there are cores
# Ray starts workers with a niceness of 15: beside two tests that compute they get 4% of the machine, so that their
# tests would wait for others to end, not for a defect.
os.environ.setdefault("RAY_worker_niceness", "0")
# Tests start a Ray of their own, or name another.
os.environ.pop("RAY_ADDRESS", None)
# Commands that tests start would compile all of Python's sources, every time.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# A local Ray makes its process ask for tokens, and so all that the process starts later. A command that asks for them
# waits for ever for a head that has none.
os.environ.setdefault("RAY_AUTH_MODE", "disabled")
# Hypothesis's own clocks fail tests on a slow machine, without a defect.
hypothesis.settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("any machine")


def pytest_configure() -> None:
    pace.share()


def pytest_report_header() -> str:
    return f"slowness: {pace.slowness():.1f} (multiplies the limits of all waits; {pace.SLOWNESS} sets it)"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that run the reference as campaigns: golden states replace it in the other tests."""
    for item in items:
        if "reference" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.campaign)


@pytest.fixture(autouse=True, scope="module")
def compiling(request: pytest.FixtureRequest) -> None:
    """Compile for modules that run each program briefly without XLA's optimiser."""
    quick.compile_for(request.node.nodeid)


@pytest.fixture(autouse=True, scope="module")
def room_for_programs() -> Iterator[None]:
    """Keep the process's memory maps below Linux's limit from one module to the next."""
    yield
    quick.make_room()


@pytest.fixture(scope="session")
def reference() -> Path:
    """Return the Python of the reference's environment; build it in the cache folder if it is missing.

    Building downloads a gigabyte, so every test with this fixture is a campaign. Without a package index these tests
    are skipped; with LEVELPROOF_TEST_ORACLE=1 they fail.
    """
    try:
        return oracle.oracle_python()
    except Failure as failure:
        if os.environ.get(REQUIRE_ORACLE):
            raise
        pytest.skip(f"the reference's environment cannot be built: {failure}")

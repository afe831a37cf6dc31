"""One way to run JAX for all tests: as a worker does, with compiled code kept between tests and between runs.

And the reference's own environment, for the campaigns that compare with it; and what was not run, said at the end.
"""

import os
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import jax
import pytest
from xdist.scheduler import LoadScopeScheduling

from benchmarks import oracle
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.runtime import CACHE_VARIABLE, prepare_jax
from tests import pace

ROOT = Path(__file__).parent.parent
DEMANDED = "LEVELPROOF_TEST_ORACLE"
MOST_MAPS = 40_000
# Tests that one process runs, one after another, because they trace and load the same programs. Those of jobs come
# first: they compile what all commands and workers load afterwards; physics, beside them, uses none of that.
TOGETHER = {
    "jobs": ("tests/pipeline/jobs", "tests/pipeline/cli", "tests/test_manifests", "tests/benchmarks/test_handmade"),
    "experts": ("tests/experts",),
    "look": ("tests/pipeline/look/test_show", "tests/pipeline/look/test_gallery"),
}
FIRST, BESIDE = "jobs", "tests/physics/"
DESELECTED = pytest.StashKey[int]()
BEGAN = time.monotonic()

os.environ.setdefault(CACHE_VARIABLE, str(ROOT / ".pytest_cache" / "levelproof"))
prepare_jax()  # before any test touches JAX; commands that tests start inherit the folder
# Hypothesis's own clocks fail tests on a slow machine, without a defect.
hypothesis.settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("any machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--within", type=float, help="seconds after which no test begins; what is left is skipped")


def pytest_configure() -> None:
    pace.share()


def pytest_report_header() -> str:
    return f"slowness: {pace.slowness():.1f} (multiplies the limits of all waits; {pace.SLOWNESS} sets it)"


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    within = item.config.getoption("within")
    if within is not None and time.monotonic() - BEGAN > within:
        pytest.skip(f"no time was left after {within:.0f} s")


@pytest.fixture(autouse=True, scope="module")
def room_for_programs() -> Iterator[None]:
    """Forget compiled programs when there are many: each takes several memory maps, of which Linux gives a process
    65,530 and XLA crashes without another one. The cache folder brings back what is needed again."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def reference() -> Path:
    """The Python of the reference's environment, made in the cache folder if it is not there.

    That downloads a gigabyte, so whatever needs it is a campaign (see below). Where no package index can be reached,
    its tests are skipped; with LEVELPROOF_TEST_ORACLE=1 they fail.
    """
    try:
        return oracle.oracle_python()
    except Failure as failure:
        if os.environ.get(DEMANDED):
            raise
        pytest.skip(f"the reference's environment cannot be made: {failure}")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What runs the reference is a campaign: golden states stand for it in the other tests.

    Groups of files with many slow tests come first, so that no process is left alone with one of them at the end.
    """
    for item in items:
        if "reference" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.campaign)
    slow = Counter(group_of(item.nodeid) for item in items if item.get_closest_marker("slow"))
    beside = lambda group: not group.startswith(BESIDE)
    items.sort(key=lambda item: ((group := group_of(item.nodeid)) != FIRST, beside(group), -slow[group]))


def group_of(nodeid: str) -> str:
    """What runs in one process: a file, or the group that it belongs to."""
    return next((group for group, paths in TOGETHER.items() if nodeid.startswith(paths)), nodeid.partition("::")[0])


class Groups(LoadScopeScheduling):
    """Hands out groups. (xdist's own `--dist=loadgroup` writes them into ids that pytest 9.2 no longer reads.)"""

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Groups:
    return Groups(config, log)


def pytest_deselected(items: list[pytest.Item]) -> None:
    if items:
        stash = items[0].config.stash
        stash[DESELECTED] = stash.get(DESELECTED, 0) + len(items)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A process of pytest-xdist tells the one that reports."""
    told: dict[str, Any] | None = getattr(session.config, "workeroutput", None)
    if told is not None:
        told["deselected"] = session.config.stash.get(DESELECTED, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Each process has deselected the same tests."""
    stash = node.config.stash
    stash[DESELECTED] = max(stash.get(DESELECTED, 0), getattr(node, "workeroutput", {}).get("deselected", 0))


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """What was not run, how much of it, and why."""
    reasons = Counter(
        report.longrepr[-1].removeprefix("Skipped: ") for report in terminalreporter.stats.get("skipped", [])
    )
    left_out, asked = config.stash.get(DESELECTED, 0), config.getoption("markexpr")
    terminalreporter.section("not run")
    terminalreporter.line(f"{reasons.total()} skipped")
    for reason, count in reasons.most_common():
        terminalreporter.line(f"  {count}: {reason}")
    terminalreporter.line(f"{left_out} not asked for (-m '{asked}'); `pytest -m campaign` runs the campaigns")

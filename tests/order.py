"""Pytest plugin: orders tests, groups those that share a process, limits their time, and lists those not run."""

import time
from collections import Counter
from collections.abc import Iterable
from random import Random
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

from tests.quick import is_brief

NOT_REACHED = "not reached: "
# Groups of files that run in one process, one test after another, because they trace and load the same programs. The
# group "jobs" starts first: it compiles what all commands and workers load afterwards. Tests of physics run beside it
# in another process, because they need none of those programs. Groups that compile without XLA's optimiser come last: a
# process that goes back to optimising has to forget its programs.
TOGETHER = {
    "brief experts": (
        "tests/experts/generalist",
        "tests/experts/networks",
        "tests/experts/test_evaluation",
        "tests/experts/test_policy",
        "tests/experts/training/test_ppo",
        "tests/experts/training/test_rollout",
    ),
    "jobs": ("tests/pipeline/jobs", "tests/pipeline/cli", "tests/test_manifests", "tests/benchmarks/test_handmade"),
    "experts": ("tests/experts",),
    "look": ("tests/pipeline/look/test_show", "tests/pipeline/look/test_gallery"),
}
FIRST, BESIDE, LONG = "jobs", "tests/physics/", "tests/pipeline/learn/"  # LONG: few tests, which train
DESELECTED = pytest.StashKey[int]()
BEGAN = time.monotonic()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--within", type=float, help="begin no test after this many seconds; skip and name the rest")
    parser.addoption("--shuffle", metavar="SEED", help="shuffle the groups of tests by this seed, such as a commit")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    within = item.config.getoption("within")
    if within is not None and time.monotonic() - BEGAN > within:
        pytest.skip(f"{NOT_REACHED}no test begins after {within:.0f} s")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Order the groups of tests, before pytest-xdist hands them out."""
    seed = config.getoption("shuffle")
    order = by_weight(items) if seed is None else shuffled(items, seed)
    items.sort(key=lambda item: order[group_of(item.nodeid)])


def by_weight(items: list[pytest.Item]) -> dict[str, Any]:
    """Return a sort key per group: long groups and those with many tests come early, so that none is left for a single
    process at the end; groups that compile without XLA's optimiser come after the others."""
    count = Counter(group_of(item.nodeid) for item in items)
    brief = {group_of(item.nodeid) for item in items if is_brief(item.nodeid)}
    late = lambda group: (group != FIRST, not group.startswith(BESIDE), group in brief, not group.startswith(LONG))
    return {group: (*late(group), -number) for group, number in count.items()}


def shuffled(items: list[pytest.Item], seed: str) -> dict[str, int]:
    """Return a random position per group, equal in all processes that have the same seed."""
    groups = sorted({group_of(item.nodeid) for item in items})
    Random(seed).shuffle(groups)
    return {group: position for position, group in enumerate(groups)}


def group_of(nodeid: str) -> str:
    """Return the name of the group that a test belongs to; files outside TOGETHER are groups of their own."""
    return next((group for group, paths in TOGETHER.items() if nodeid.startswith(paths)), nodeid.partition("::")[0])


class Groups(LoadScopeScheduling):
    """Give each process whole groups. (xdist's `--dist=loadgroup` writes groups into ids, which pytest 9.2 rejects.)"""

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Groups:
    return Groups(config, log)


def pytest_deselected(items: list[pytest.Item]) -> None:
    if items:
        stash = items[0].config.stash
        stash[DESELECTED] = stash.get(DESELECTED, 0) + len(items)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Report the number of deselected tests from a pytest-xdist worker to the process that prints the summary."""
    output: dict[str, Any] | None = getattr(session.config, "workeroutput", None)
    if output is not None:
        output["deselected"] = session.config.stash.get(DESELECTED, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Read that number from a worker; all workers deselect the same tests."""
    stash = node.config.stash
    stash[DESELECTED] = max(stash.get(DESELECTED, 0), getattr(node, "workeroutput", {}).get("deselected", 0))


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Report how many tests did not run and why, and name those that the time limit excluded."""
    reports = terminalreporter.stats.get("skipped", [])
    reason_of = {report.nodeid: report.longrepr[-1].removeprefix("Skipped: ") for report in reports}
    deselected, marks = config.stash.get(DESELECTED, 0), config.getoption("markexpr")
    terminalreporter.section("not run")
    terminalreporter.line(f"{len(reason_of)} skipped")
    for reason, count in Counter(reason_of.values()).most_common():
        terminalreporter.line(f"  {count}: {reason}")
        if reason.startswith(NOT_REACHED):
            for line in lines_of(nodeid for nodeid, why in reason_of.items() if why == reason):
                terminalreporter.line(f"    {line}")
    terminalreporter.line(f"{deselected} deselected (-m '{marks}'); CONTRIBUTING.md says how to run them")


def lines_of(nodeids: Iterable[str]) -> list[str]:
    """Name tests compactly: a line per file, each test once, with its number of cases if there are several."""
    files: dict[str, Counter[str]] = {}
    for nodeid in sorted(nodeids):
        file, _, test = nodeid.partition("::")
        files.setdefault(file, Counter())[test.partition("[")[0]] += 1
    name = lambda test, cases: test if cases == 1 else f"{test} ({cases} cases)"
    return [f"{file}: {', '.join(name(*pair) for pair in tests.items())}" for file, tests in files.items()]

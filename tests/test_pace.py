"""Limits of waits in tests: they scale with the machine, and none is written without scaling."""

import ast
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests import pace
from tests.pace import patience, wait_until
from tests.pipeline import command
from tests.pipeline.command import line_of

TESTS = Path(__file__).parent
ROOT = TESTS.parent
WAITS = ("wait", "settimeout", "wait_for_timeout")  # methods whose first argument is a limit
LIMITING = (Path(pace.__file__), Path(command.__file__))  # one measures how long a process takes, one reads in a thread
RUNS = ("run", "call", "check_call", "check_output")  # functions of subprocess that wait for ever without one
ENDLESS = ("readline", "join")  # methods, of a process's output and of a thread, that without arguments wait for ever


def test_patience_grows_with_the_slowness_and_never_shrinks(monkeypatch: pytest.MonkeyPatch) -> None:
    for slowness, seconds in (("3", 30.0), ("1", 10.0), ("0.2", 10.0), ("1000", 10.0 * pace.MAX_SLOWNESS)):
        monkeypatch.setenv(pace.SLOWNESS, slowness)
        assert patience(10) == seconds


def test_wait_until_fails_when_its_patience_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(pace.SLOWNESS, "4")
    begin = time.monotonic()
    with pytest.raises(AssertionError, match="within 1 s: a sign"):
        wait_until(lambda: False, 0.25, "a sign")
    assert time.monotonic() - begin >= 1
    wait_until(lambda: time.monotonic() - begin > 1.5, 0.25)  # longer than 0.25 s, within 4 times as much


def test_commands_that_tests_start_inherit_the_slowness(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(pace.SLOWNESS, "7")
    code = "from tests.pace import patience; print(patience(2))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True, timeout=patience(1800)
    )
    assert done.stdout == "14.0\n"


@pytest.mark.skipif(sys.platform != "linux", reason="stops a process as Linux does")
def test_measured_slowness_counts_time_that_other_processes_take() -> None:
    """A process that may run for 5 ms of every 45 measures a slow machine, though its own CPU time stays the same."""
    code = (
        "import time\nfrom tests import pace\nprint('ready', flush=True)\n"
        "begin = time.process_time()\nwall = pace.timed(pace.compute)\nprint(wall, time.process_time() - begin)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert line_of(process, process.stdout) == "ready\n"
    while process.poll() is None:
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(0.04)
        os.kill(process.pid, signal.SIGCONT)
        time.sleep(0.005)
    out, _ = process.communicate(timeout=patience(60))
    wall, own = map(float, out.split())
    assert wall > 2 * own


def limits_of(node: ast.AST) -> list[ast.expr]:
    """Return the limits, in seconds or milliseconds, that a call, a sum or a comparison has for how long it waits."""
    match node:
        case ast.Call(ast.Attribute(attr=name), [ast.Constant() as limit]) if name in WAITS:
            return [limit]
        case ast.Call(keywords=keywords):
            return [keyword.value for keyword in keywords if keyword.arg in ("timeout", "open_timeout")]
        case ast.BinOp(ast.Call(ast.Attribute(ast.Name("time"), "monotonic")), ast.Add(), limit):
            return [limit]
        case ast.Compare(ast.BinOp(ast.Call(ast.Attribute(ast.Name("time"))), ast.Sub()), [ast.Lt()], [limit]):
            return [limit]
    return []


def waits_for_ever(node: ast.AST) -> bool:
    match node:
        case ast.Call(ast.Attribute(ast.Name("subprocess"), name), keywords=keywords) if name in RUNS:
            return not {keyword.arg for keyword in keywords} & {"timeout", None}
        case ast.Call(ast.Attribute(attr="urlopen") | ast.Name("urlopen"), keywords=keywords):
            return not {keyword.arg for keyword in keywords} & {"timeout", None}
        case ast.Call(ast.Name("connect"), keywords=keywords):  # of websockets, whose own limit does not scale
            return not {keyword.arg for keyword in keywords} & {"open_timeout", None}
        case ast.Call(ast.Attribute(attr=name), [], []) if name in ENDLESS:
            return True
    return False


def is_scaled(limit: ast.expr) -> bool:
    names = {node.id for node in ast.walk(limit) if isinstance(node, ast.Name)}
    return "patience" in names


def test_every_wait_in_tests_has_a_limit_that_scales() -> None:
    bare = [
        f"{path.relative_to(ROOT)}:{limit.lineno}: {ast.unparse(node)}"
        for path in TESTS.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        for limit in limits_of(node)
        if not is_scaled(limit)
    ]
    assert not bare, "\n".join(["pass these limits through tests.pace.patience:", *bare])


@pytest.mark.parametrize(
    ("code", "endless"),
    [
        ("subprocess.run(['true'])", True),
        ("subprocess.run(['true'], timeout=limit)", False),
        ("urlopen(address)", True),
        ("urllib.request.urlopen(address)", True),
        ("urlopen(address, timeout=limit)", False),
        ("connect(address, max_size=9)", True),
        ("connect(address, open_timeout=limit)", False),
        ("process.stdout.readline()", True),
        ("thread.join()", True),
        ("thread.join(limit)", False),
        ("', '.join(words)", False),
    ],
)
def test_waits_for_ever_finds_calls_without_a_limit(code: str, endless: bool) -> None:
    assert waits_for_ever(ast.parse(code, mode="eval").body) == endless


def test_no_test_waits_for_ever() -> None:
    endless = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in TESTS.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if waits_for_ever(node) and path not in LIMITING
    ]
    assert not endless, "\n".join(["give these a timeout:", *endless])

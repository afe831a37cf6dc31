"""Changed inputs for every reader: it takes them and what it gives is possible, or it says so in one sentence."""

import multiprocessing
import resource
import traceback
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from random import Random

import pytest

from tests.pipeline.hostile.targets import ENDS, TARGETS, Refused, Target

FEW, MANY = 100, 10_000
MOST = 2**30  # bytes of memory beside those of a process that has read good input
LONGEST = 900  # characters of a sentence
TOLD = 5


def wrong_with(target: Target, seed: int) -> str:
    """What a reader does that it should not; empty: nothing."""
    try:
        target(Random(seed))
    except Refused as refusal:
        sentence = str(refusal)
        good = "\n" not in sentence and sentence.isprintable() and 0 < len(sentence) < LONGEST
        whole = isinstance(refusal, ENDS) or sentence.endswith((".", ")"))
        return "" if good and whole else f"{type(refusal).__name__}: {sentence[:2000]!r}"
    except Exception:
        return traceback.format_exc(limit=-6)
    return ""


def findings(name: str, folder: Path, seeds: range) -> dict[int, str]:
    target = TARGETS[name](folder)
    return {seed: wrong for seed in seeds if (wrong := wrong_with(target, seed))}


@pytest.mark.parametrize("name", TARGETS)
def test_a_hundred_inputs(name: str, tmp_path: Path) -> None:
    assert not findings(name, tmp_path, range(FEW))


def bounded_findings(name: str, folder: Path, seeds: range) -> tuple[dict[int, str], int]:
    """In a process that may not have much more memory than it has now; and by how many bytes it grew."""
    target = TARGETS[name](folder)
    for seed in range(20):
        wrong_with(target, seed)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MOST
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    before, found = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, {}
    for seed in seeds:
        (folder / "seed").write_text(str(seed))  # of the input that ends the process
        if wrong := wrong_with(target, seed):
            found[seed] = wrong
            if len(found) == TOLD:
                break
    return found, 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)


@pytest.mark.campaign
@pytest.mark.parametrize("name", TARGETS)
def test_ten_thousand_inputs(name: str, tmp_path: Path) -> None:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        found, grown = process.submit(bounded_findings, name, tmp_path, range(FEW, FEW + MANY)).result()
    assert not found
    assert grown < MOST

"""Fuzzing of every reader: it accepts a mutated input and returns valid values, or rejects it in one sentence."""

import multiprocessing
import resource
import traceback
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from random import Random

import pytest

from tests.pipeline.hostile.targets import ENDS, TARGETS, Refused, Target

FEW, MANY = 100, 10_000
MAX_GROWTH = 2**30  # bytes of memory more than after reading valid input
MAX_LENGTH = 900  # characters of a sentence
MAX_FINDINGS = 5  # reported per target
ACCEPTED = 3  # of FEW inputs: a reader that refuses everything withstands everything


def defect_of(target: Target, seed: int) -> str | None:
    """Run a target on one input; describe any misbehaviour. Empty: it was refused in a sentence; None: accepted."""
    try:
        target(Random(seed))
        return None
    except Refused as refusal:
        sentence = str(refusal)
        good = "\n" not in sentence and sentence.isprintable() and 0 < len(sentence) < MAX_LENGTH
        whole = isinstance(refusal, ENDS) or sentence.endswith((".", ")"))
        return "" if good and whole else f"{type(refusal).__name__}: {sentence[:2000]!r}"
    except Exception:
        return traceback.format_exc(limit=-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_reader_withstands_a_hundred_inputs(name: str, tmp_path: Path) -> None:
    target = TARGETS[name](tmp_path)
    defects = {seed: defect_of(target, seed) for seed in range(FEW)}
    assert not {seed: defect for seed, defect in defects.items() if defect}
    assert [*defects.values()].count(None) >= ACCEPTED


def bounded_findings(name: str, folder: Path, seeds: range) -> tuple[dict[int, str], int]:
    """Collect findings under a memory limit; return them and the growth in bytes."""
    target = TARGETS[name](folder)
    for seed in range(20):
        defect_of(target, seed)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MAX_GROWTH
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    before, found = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, {}
    for seed in seeds:
        (folder / "seed").write_text(str(seed))  # identifies an input that kills the process
        if wrong := defect_of(target, seed):
            found[seed] = wrong
            if len(found) == MAX_FINDINGS:
                break
    return found, 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)


@pytest.mark.campaign
@pytest.mark.parametrize("name", TARGETS)
def test_reader_withstands_ten_thousand_inputs_in_bounded_memory(name: str, tmp_path: Path) -> None:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        found, grown = process.submit(bounded_findings, name, tmp_path, range(FEW, FEW + MANY)).result()
    assert not found
    assert grown < MAX_GROWTH

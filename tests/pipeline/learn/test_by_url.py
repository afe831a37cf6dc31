"""Commands that read a split by URL give what they give of the same split in a folder."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.pace import patience
from tests.pipeline.command import here
from tests.pipeline.learn.test_distill import ROUNDS, TEACHERS
from tests.pipeline.learn.test_train import LANES, PER_UPDATE
from tests.pipeline.learn.test_train import TINY as SMALLEST
from tests.pipeline.servers import serving_bucket

pytestmark = pytest.mark.slow

TINY = (
    "interval=5",
    "played=4",
    "train.updates=5",
    "train.batch=64",
    "validation=0.3",
    "network.width=16",
    "network.depth=1",
)

FEW = *LANES, f"ppo.env_steps={2 * PER_UPDATE}"
FEW_ROUNDS = *ROUNDS, *TEACHERS


@pytest.fixture(scope="module")
def both(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Return a split's folder and its URL in a bucket."""
    folder, place = tmp_path_factory.mktemp("remote"), Path(*split.parts[-2:])
    with pytest.MonkeyPatch.context() as patch, serving_bucket(patch, folder, patience(10)):
        shutil.copytree(split, folder / "s3/bucket" / place)
        yield str(split), f"s3://bucket/{place}"


def results(both: tuple[str, str], folder: Path, *words: str) -> list[str]:
    """Run a command on the folder and on the URL, each in a folder of its own; return what they print."""
    texts = []
    for number, place in enumerate(both):
        (folder / str(number)).mkdir(exist_ok=True)
        done = here([word.replace("SPLIT", place) for word in words], folder / str(number))
        assert done.returncode == 0, done.stderr
        texts.append(done.stdout)
    return texts


def test_policies_of_a_url_are_those_of_its_folder(both: tuple[str, str], tmp_path: Path) -> None:
    results(both, tmp_path, "clone", "SPLIT", "-o", "policy", *TINY, "where=label = 'solved'")
    ours, theirs = ((tmp_path / str(number) / "policy/policy.safetensors").read_bytes() for number in (0, 1))
    assert ours == theirs
    words = "evaluate", str(tmp_path / "0/policy"), "--on", "SPLIT", "--levels", "8", "--attempts", "2", "--json"
    ours, theirs = (json.loads(text) for text in results(both, tmp_path, *words))
    assert [levels["of"] for levels in ours["levels"]] == [levels["of"] for levels in theirs["levels"]]


@pytest.mark.parametrize("words", [("train", "levels=SPLIT", *FEW), ("distill", "SPLIT", *FEW_ROUNDS)])
def test_learners_of_a_url_learn_what_those_of_its_folder_do(
    both: tuple[str, str], tmp_path: Path, words: tuple[str, ...]
) -> None:
    results(both, tmp_path, *words, "where=label = 'solved'", "-o", "policy", *SMALLEST)
    ours, theirs = ((tmp_path / str(number) / "policy/policy.safetensors").read_bytes() for number in (0, 1))
    assert ours == theirs


def test_levels_of_a_url_are_those_of_its_folder(both: tuple[str, str], tmp_path: Path) -> None:
    results(both, tmp_path, "export", "SPLIT", "--format", "parquet", "-o", "levels")
    ours, theirs = (pq.read_table(tmp_path / str(number) / "levels") for number in (0, 1))
    assert ours.num_rows > 0
    assert ours.equals(theirs)

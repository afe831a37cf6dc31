"""Commands that read a split by URL give what they give of the same split in a folder."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from levelproof.pipeline.store import remote
from tests.pipeline.command import here
from tests.pipeline.servers import bucket_of, serving

pytestmark = pytest.mark.slow

KEYS = {"ACCESS_KEY_ID": "any", "SECRET_ACCESS_KEY": "any", "REGION": "us-east-1"}
TINY = (
    "interval=5",
    "played=4",
    "train.updates=5",
    "train.batch=64",
    "validation=0.3",
    "network.width=16",
    "network.depth=1",
)


@pytest.fixture(scope="module")
def both(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Return a split's folder and its URL in a bucket."""
    folder = tmp_path_factory.mktemp("s3")
    place = Path(*split.parts[-2:])
    shutil.copytree(split, folder / "bucket" / place)
    with pytest.MonkeyPatch.context() as patch, serving(bucket_of(folder)) as server:
        for name in [name for name in os.environ if name.startswith("AWS_")]:
            patch.delenv(name)
        for name, value in {**KEYS, "ENDPOINT_URL": server.url}.items():
            patch.setenv(f"AWS_{name}", value)
        pieces = remote.PieceCache(folder / "cache", 10**9)  # programs stay in the cache of all tests
        patch.setattr(remote, "_cache", lambda: pieces)
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
    here_, there = ((tmp_path / str(number) / "policy/policy.safetensors").read_bytes() for number in (0, 1))
    assert here_ == there
    words = "evaluate", str(tmp_path / "0/policy"), "--on", "SPLIT", "--levels", "8", "--attempts", "2", "--json"
    ours, theirs = (json.loads(text) for text in results(both, tmp_path, *words))
    assert [levels["of"] for levels in ours["levels"]] == [levels["of"] for levels in theirs["levels"]]


def test_levels_of_a_url_are_those_of_its_folder(both: tuple[str, str], tmp_path: Path) -> None:
    results(both, tmp_path, "export", "SPLIT", "--format", "parquet", "-o", "levels")
    here_, there = (pq.read_table(tmp_path / str(number) / "levels") for number in (0, 1))
    assert here_.num_rows > 0
    assert here_.equals(there)

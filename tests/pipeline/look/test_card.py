"""Dataset cards: header, numbers, figures and preview."""

import io
import re
import shutil
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from PIL import Image

from levelproof.experts.labels import Label
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.dataset.sample import SAMPLE
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look import card as cards
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.look.preview import PICTURES, PIXELS, SHOWN
from levelproof.pipeline.look.readme import MARK, CardOptions, SplitFacts, readme
from levelproof.pipeline.store.manifest import read_manifest
from tests.pipeline.made import made_split, played_split
from tests.pipeline.planted import PLANTED, no_hang

FACTS = SplitFacts(
    "1M/s", False, "", {"solved": 2}, 2, 2, 2, np.arange(0), 0, 0, "1M", "random", True, True, "", "", [], True
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a split of replayed levels, a split with nothing solved, and their card."""
    folder = tmp_path_factory.mktemp("rigid-levels")
    splits = [played_split(folder), made_split(folder, [[Label.UNSOLVED] * 2, [Label.UNSOLVED]], "budget=64k")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cards, "SAMPLE", 12)
        assert main(["card", *map(str, splits), "--license", "cc-by-4.0", "--repo", "me/levels"]) == 0
    return folder


def header_of(readme: Path) -> dict[str, Any]:
    return yaml.safe_load(readme.read_text().split("---\n")[1])


def test_header_lists_preview_and_manifests(dataset: Path) -> None:
    header = header_of(dataset / "README.md")
    assert (header["license"], header["pretty_name"]) == ("cc-by-4.0", "levels")
    assert (header["task_categories"], header["size_categories"]) == (["reinforcement-learning"], ["1K<n<10K"])
    first, *others = header["configs"]
    assert (first["config_name"], first["default"]) == ("preview", True)
    assert [config["config_name"] for config in others] == ["128k-s", "64k-s"]
    for config in header["configs"]:
        assert re.fullmatch(r"[\w-]+", config["config_name"])
        for entry in config["data_files"]:
            assert re.fullmatch(r"\w+", entry["split"])
            files = sorted(dataset.glob(entry["path"]))
            assert files
            assert all(pq.read_metadata(file).num_rows for file in files)
    assert len(list(dataset.glob(others[1]["data_files"][0]["path"]))) == 2


@pytest.mark.slow
def test_card_of_seed_files_names_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "256k/8-8").mkdir(parents=True)
    seeds = tmp_path / "256k/8-8/part-000.parquet"
    copyfile(SAMPLE, seeds)
    monkeypatch.setattr(cards, "SAMPLE", 4)
    assert main(["card", str(seeds.parent)]) == 0
    text, header = (tmp_path / "README.md").read_text(), header_of(tmp_path / "README.md")
    for config in header["configs"]:
        for entry in config["data_files"]:
            assert re.fullmatch(r"\w+", entry["split"])
            assert [*tmp_path.glob(entry["path"])], entry
    assert ".zarr" not in text
    assert "No level that was tried is left out" not in text, "seed files may be of some levels only"
    shown = pq.read_table(next((tmp_path / "preview").iterdir()))
    assert shown["env_steps"].null_count == 4, "seeds leave costs out"
    steps = np.nansum(read_manifest(seeds).table["steps_to_goal"].to_numpy())
    assert f"| {steps:,.0f} |" in text, "repetitions are not counted"
    assert f" {seeds.stat().st_size / steps:.1f} |" in text
    assert main(["card", str(seeds)]) == 0
    assert header_of(seeds.with_name("README.md"))["configs"][1]["data_files"][0]["path"] == seeds.name


def test_preview_has_pictures_in_the_hubs_format(dataset: Path) -> None:
    table = pq.read_table(dataset / "preview/128k-s.parquet")
    assert table.column_names == [*PICTURES, *SHOWN]
    assert b'"_type": "Image"' in table.schema.metadata[b"huggingface"]
    rows, manifest = table.to_pylist(), read_manifest(dataset / "128k/s").table
    assert [row["level_id"] for row in rows] == np.linspace(0, len(manifest) - 1, 12).round().astype(int).tolist()
    assert {row["label"] for row in rows} == {"solved", "unsolved"}
    for row in rows:
        assert Image.open(io.BytesIO(row["start"]["bytes"])).width == PIXELS
        assert (row["goal"] is not None) == (row["label"] == "solved")
    assert [row["goal"] for row in pq.read_table(dataset / "preview/64k-s.parquet").to_pylist()] == [None] * 3


def test_card_states_the_facts_of_each_manifest(dataset: Path) -> None:
    text, manifest = (dataset / "README.md").read_text(), read_manifest(dataset / "128k/s")
    solved = int((manifest.labels == "solved").sum())
    assert f"| `128k/s` | 64 | 64 | {solved} | {256 * solved:,} |" in text
    assert f"| `128k/s` | {solved} | {64 - solved} | 0 | 0 | {Share(solved, 64)} |" in text
    assert "| `64k/s` | 3 | 3 | 0 | 0 |" in text
    assert f"| 128k | random, `kinetix` | `{manifest.config_hash}` | `density=full` | levelproof " in text
    assert "levelproof regenerate manifest=data/128k/s budget=128k out=again" in text
    assert "hf download me/levels" in text
    assert "cc-by-4.0, chosen by the publisher" in text
    figures = re.findall(r"!\[.*\]\((.*)\)", text)
    assert figures == ["figures/solved.png", "figures/solve-rate.png", "figures/steps-to-goal.png"]
    for figure in figures:
        colours = Image.open(dataset / figure).convert("RGB").getcolors(1 << 24)
        assert colours
        assert len(colours) > 10, f"{figure} is blank"


def test_card_overwrites_only_cards(dataset: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(cards, "SAMPLE", 2)
    split = dataset / "64k/s"
    out = dataset / "OTHER.md"
    assert main(["card", str(split), "-o", str(out)]) == 0
    assert main(["card", str(split), "-o", str(out)]) == 0
    output = capsys.readouterr().out
    assert "It names no licence: choose one with --license" in output
    assert "license" not in header_of(out)
    assert "None has been chosen yet" in out.read_text()
    assert re.findall(r"!\[.*\]\((.*)\)", out.read_text()) == ["figures/solve-rate.png"]
    out.write_text("mine")
    assert main(["card", str(split), "-o", str(out)]) == 2
    assert out.read_text() == "mine"
    assert main(["card", str(split), "-o", str(dataset / "64k")]) == 2
    assert main(["card", str(split), "-o", str(tmp_path / "README.md")]) == 2
    assert main(["card", str(tmp_path / "128k/s")]) == 2
    *_, mine, folder, below, nothing = capsys.readouterr().err.splitlines()
    assert mine.endswith("`levelproof card` did not write it: name another file with -o.")
    assert folder == mine.replace(str(out), str(dataset / "64k"))
    assert "is not below" in below
    assert "There is no split at" in nothing
    assert not list(tmp_path.iterdir())


def test_card_counts_each_split_once_and_refuses_equal_subsets(dataset: Path, monkeypatch) -> None:
    monkeypatch.setattr(cards, "SAMPLE", 2)
    split, out = dataset / "64k/s", dataset / "TWICE.md"
    cards.card([split], out, CardOptions())
    once = out.read_text()
    cards.card([split, dataset / "64k/../64k/s"], out, CardOptions())
    assert out.read_text() == once
    for name, as_what in (("64k.s", "subset 64k-s"), ("64k_s", "preview 64k_s")):
        shutil.copytree(split, dataset / name)
        try:
            with pytest.raises(UserError, match=rf"Both 64k/s and {re.escape(name)} would be the {as_what}: rename"):
                cards.card([split, dataset / name], out, CardOptions())
        finally:
            shutil.rmtree(dataset / name)
    assert out.read_text() == once


@pytest.mark.parametrize(("witnesses", "words"), [(0, "n<1K"), (3, "n<1K"), (4, "1K<n<10K"), (6 * 10**6, "1B<n<10B")])
def test_size_category_counts_transitions(witnesses: int, words: str) -> None:
    facts = replace(FACTS, transitions=256 * witnesses)
    header = readme("name", [facts], CardOptions(), [], "0.1.0").split("---\n")[1]
    assert yaml.safe_load(header)["size_categories"] == [words]


def test_card_tells_which_splits_had_experts() -> None:
    def text(*trained: bool, searched: bool = True) -> str:
        facts = [replace(FACTS, path=f"1M/{i}", searched=searched, experts=each) for i, each in enumerate(trained)]
        return readme("name", facts, CardOptions(), [], "0.1.0")

    assert "Levels were searched for a way to the goal, as configured. No experts were trained." in text(False, False)
    assert "Levels had PPO experts of their own" in text(True)
    assert "Levels of `1M/1` had PPO experts" in text(False, True)
    assert "were searched" not in (published := text(True, searched=False))
    assert "Levels had PPO experts of their own" in published
    assert "experts" not in text(False, searched=False).partition("## How it was made")[2].partition("## Lic")[0]


@pytest.mark.parametrize(
    ("distribution", "whole"), [("random, `kinetix`", True), ("random, `kinetix`", False), ("imported", False)]
)
def test_card_claims_only_what_is_known(distribution: str, whole: bool) -> None:
    facts = replace(FACTS, path="my 1M/s", distribution=distribution, whole=whole)
    text = readme("name", [facts], CardOptions(), [], "0.1.0")
    assert ("solve 2 random physics levels" in text) == distribution.startswith("random")
    assert ("No level that was tried is left out" in text) == whole
    assert ("a row for each of the 2 levels in these files" in text) == (not whole)
    assert ("levelproof regenerate 'manifest=data/my 1M/s' budget=1M" in text) == distribution.startswith("random")
    assert "levelproof verify 'data/my 1M/s'" in text


def test_share_interval_is_wilsons() -> None:
    assert np.allclose(Share(81, 263).interval, (0.2552, 0.3662), atol=1e-4)  # Newcombe, 1998
    assert Share(0, 10).interval == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert Share(10, 10).interval == pytest.approx((0.7225, 1.0), abs=1e-4)
    assert str(Share(0, 0)) == "0.0% (0.0% to 100.0%)"


@pytest.mark.campaign
def test_hub_libraries_load_the_card_and_the_data(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    datasets, hub = (pytest.importorskip(name) for name in ("datasets", "huggingface_hub"))
    cache = str(tmp_path / "cache")
    shown = datasets.load_dataset(str(dataset), cache_dir=cache)  # the default subset
    assert shown["128k_s"].num_rows == 12
    assert all(isinstance(shown["128k_s"].features[name], datasets.Image) for name in PICTURES)
    assert {picture.width for picture in shown["128k_s"]["start"]} == {PIXELS}
    manifest = datasets.load_dataset(str(dataset), "64k-s", split="levels", cache_dir=cache)
    assert manifest["label"][:] == ["unsolved"] * 3
    card = hub.DatasetCard.load(dataset / "README.md", ignore_metadata_errors=False)
    assert (card.data.license, card.data.pretty_name) == ("cc-by-4.0", "levels")
    assert hub.DatasetCardData(**card.data.to_dict()).to_dict() == card.data.to_dict()


@pytest.mark.campaign
def test_python_in_the_card_runs(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The data are below `data/`, where the card's commands put them."""
    (tmp_path / "data").symlink_to(dataset)
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"^```python\n(.*?)^```", (dataset / "README.md").read_text(), re.DOTALL | re.MULTILINE)
    names: dict[str, Any] = {}
    exec(compile(block, "README.md", "exec"), names)
    assert names["batch"].observation.shape[:2] == (64, 256)


@pytest.mark.parametrize("name", ["README.md", "preview", "preview/128k-s.parquet", "figures/solved.svg"])
def test_card_refuses_to_write_through_links(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    split = made_split(tmp_path / "levels", [[Label.UNSOLVED]])
    mine = tmp_path / "mine"
    mine.mkdir() if name == "preview" else mine.write_text(text := f"mine {MARK}")
    link = tmp_path / "levels" / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(mine)
    assert main(["card", str(split)]) == 2
    assert f"{link} is a link" in capsys.readouterr().err
    assert not [*mine.iterdir()] if mine.is_dir() else mine.read_text() == text


@pytest.mark.parametrize("kind", ["hard link", "pipe"])
@pytest.mark.parametrize("name", ["README.md", "preview/128k-s.parquet", "figures/solved.svg"])
def test_card_refuses_hard_links_and_pipes(tmp_path: Path, name: str, kind: str) -> None:
    split = made_split(tmp_path / "levels", [[Label.UNSOLVED]])
    mine, path = tmp_path / "mine", tmp_path / "levels" / name
    mine.write_text(text := f"mine {MARK}")
    path.parent.mkdir(exist_ok=True)
    PLANTED[kind](path, mine)
    with no_hang():
        assert main(["card", str(split)]) == 2
    assert mine.read_text() == text

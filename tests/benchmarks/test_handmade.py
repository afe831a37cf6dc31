"""The benchmark of handmade levels, on levels of our own, so that no reference is needed."""

from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from benchmarks import handmade
from benchmarks.handmade import KINDS, PIXELS, PPO_COLUMNS, labelled, ppo, totals, write_sheet
from levelproof.configs.compose import compose_job
from levelproof.levelgen.files.level_file import LevelFile, write_level_file
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.read.level_files import levels_below

TRIVIAL, UNSOLVABLE = 1, 16


@pytest.mark.campaign
def test_labelled_lists_each_level_and_totals_sum_each_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, level_id in {"falls": TRIVIAL, "hopeless": UNSOLVABLE}.items():
        level = jax.tree.map(np.asarray, sample_levels([level_id], SIZES["s"]))
        write_level_file(LevelFile(level, TaskParams()), tmp_path / f"{name}.json")
    job = compose_job([f"level_files={tmp_path}", "procedure=label", "budget=5k"])
    origins = levels_below(tmp_path, job).levels["s"]
    results, pictures = labelled(job, origins)
    write_sheet(pictures, tmp_path / "sheet.png")
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.width == PIXELS, "only the level with a witness has a picture"
    assert {result["level"]: result["label"] for result in results} == {"falls": "trivial", "hopeless": "unsolvable"}
    assert all(result[kind] == 0 for result in results for kind in KINDS)
    by_ppo = ppo(origins, tmp_path / "kept")
    monkeypatch.setattr(handmade, "label", None)
    assert ppo(origins, tmp_path / "kept") == by_ppo, "known results are not trained again"
    assert [[result[name] is not None for name in PPO_COLUMNS] for result in by_ppo] == [[False, True], [False, False]]
    results = [result | of_ppo for result, of_ppo in zip(results, by_ppo, strict=True)]
    ((size, levels, with_witness, by_ppo, _, *sums),) = totals(results)
    assert (size, levels, with_witness, by_ppo, sums) == ("s", "2", "1", "1", ["0"] * len(KINDS))

"""`TrajectorySource`: single trajectories for grain and PyTorch."""

import os
import pickle

import numpy as np
import pytest

from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.dataset.sample import sample_data
from levelproof.pipeline.errors import UserError
from tests.pipeline.command import wait_for_child


def test_source_elements_are_windows_by_name(data: Dataset) -> None:
    source = data.grain(length=100, fields=["level/role"])
    assert len(source) == 3 * len(data)
    one, whole = source[5], data[1]
    assert {name: x.shape for name, x in one.items()} == {
        "level_id": (), "first": (), "mask": (100,), "observation": (100, 140), "action": (100, 6),
        "action_mask": (100, 6), "reward": (100,), "done": (100,), "terminated": (100,), "truncated": (100,),
        "goal": (100,), "level/role": (7,),
    }  # fmt: skip
    assert one["mask"].sum() == 56
    assert np.array_equal(one["observation"][:56], whole.observation[200:])
    with pytest.raises(IndexError):
        source[len(source)]


def test_observations_of_several_arrays_are_dictionaries(data: Dataset) -> None:
    """As loaders collate them."""
    shown, whole = (
        data.torch(observation="symbolic_entity")[0]["observation"],
        data.read([0], observation="symbolic_entity"),
    )
    assert shown.keys() == vars(whole.observation).keys()
    for name, values in shown.items():
        assert type(values) is np.ndarray
        assert np.array_equal(values, getattr(whole.observation, name)[0]), name


def test_source_pickles_small_and_restores(data: Dataset) -> None:
    source = data.grain(subset="train", length=64, observation=None)
    pickled = pickle.dumps(source)
    assert len(pickled) < 1000
    again = pickle.loads(pickled)
    assert repr(again) == repr(source)
    assert np.array_equal(again[9]["action"], source[9]["action"])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork")
def test_forked_process_reads_but_computes_no_observations(data: Dataset) -> None:
    plain, observing = data.grain(observation=None), data.grain()
    child = os.fork()
    if not child:
        code = 2
        try:
            plain[0]
            code = 3
            observing[0]
        except UserError as error:
            code = 7 if code == 3 and "multiprocessing_context='spawn'" in str(error) else 1
        finally:
            os._exit(code)
    assert wait_for_child(child) == 7


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork")
def test_forked_process_simulates_no_records() -> None:
    """Those of seeds are simulated whatever is asked for."""
    plain = sample_data().grain(observation=None)
    child = os.fork()
    if not child:
        try:
            plain[0]
        except UserError as error:
            os._exit(7 if "cannot simulate records" in str(error) else 1)
        finally:
            os._exit(2)
    assert wait_for_child(child) == 7


@pytest.mark.campaign
@pytest.mark.parametrize("workers", [0, 2])
def test_grain_loads_shuffles_and_batches_a_source(data: Dataset, workers: int) -> None:
    grain = pytest.importorskip("grain")
    pytest.importorskip("absl.flags").FLAGS.mark_as_parsed()  # grain's workers read them
    source = data.grain(subset="train", length=64, observation=None)
    loader = grain.DataLoader(
        data_source=source,
        sampler=grain.samplers.IndexSampler(len(source), shuffle=True, seed=0, num_epochs=1),
        operations=[grain.transforms.Batch(8)],
        worker_count=workers,
    )
    batches = list(loader)
    assert batches[0]["action"].shape == (8, 64, 6)
    found = sorted(
        zip(
            *(np.concatenate([batch[name] for batch in batches]).tolist() for name in ("level_id", "first")),
            strict=True,
        )
    )
    expected = sorted((int(source[i]["level_id"]), int(source[i]["first"])) for i in range(len(source)))
    assert found == expected
    mapped = grain.MapDataset.source(source).seed(1).shuffle().batch(4)
    assert mapped[0]["reward"].shape == (4, 64)


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("context", "observation"),
    [("fork", None), ("spawn", None), ("spawn", "symbolic_flat"), (None, "symbolic_flat"), (None, "symbolic_entity")],
)
def test_torch_dataloader_accepts_a_source(data: Dataset, context: str | None, observation: str | None) -> None:
    torch = pytest.importorskip("torch")
    source = data.torch(subset="train", observation=observation)
    loader = torch.utils.data.DataLoader(
        source, batch_size=8, shuffle=True, num_workers=2 if context else 0, multiprocessing_context=context
    )
    batches = list(loader)
    assert batches[0]["action"].shape == (8, 256, 6)
    assert batches[0]["mask"].dtype == torch.bool
    ids = torch.cat([batch["level_id"] for batch in batches]).tolist()
    assert sorted(ids) == sorted(int(source[i]["level_id"]) for i in range(len(source)))

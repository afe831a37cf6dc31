"""Files that other users can write to are rejected: compiled programs are executed, and experts are resumed."""

import os
from pathlib import Path

import pytest

from levelproof.experts.labels import Label
from levelproof.pipeline import runtime
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.owned import own_folder, require_own
from levelproof.pipeline.runtime import CACHE_VARIABLE, cache_folder, prepare_jax
from levelproof.pipeline.store.checkpoints import load_experts, require_same_experts
from tests.pipeline.command import assert_refused, here
from tests.pipeline.made import made_job, made_split

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="the system has no such users")


def test_own_folder_is_created_for_its_user_alone(tmp_path: Path) -> None:
    before = os.umask(0o002)  # the default of many systems
    try:
        made = own_folder(tmp_path / "deeper/cache", "delete it")
    finally:
        os.umask(before)
    assert made.stat().st_mode & 0o777 == 0o700
    assert own_folder(made, "delete it") == made


@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777])
def test_generate_rejects_a_cache_that_others_can_write_to(
    tmp_path: Path, mode: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    cache.mkdir()
    cache.chmod(mode)
    monkeypatch.setenv(CACHE_VARIABLE, str(cache))
    done = here(["generate", "levels=1", "budget=5k", "out=data"], tmp_path)
    assert_refused(done, 2, f"Other users can write to {cache}", f"{CACHE_VARIABLE} to a folder of your own")
    assert not (tmp_path / "data").exists()


def test_prepare_jax_rejects_programs_that_others_can_write_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    (tmp_path / "jax").mkdir()
    (tmp_path / "jax").chmod(0o777)
    monkeypatch.setattr(runtime, "remove_damaged", lambda _: pytest.fail("the folder was read"))
    with pytest.raises(UserError, match=r"Other users can write to .*/jax"):
        prepare_jax()


def test_cache_folder_rejects_another_users_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    cache_folder()
    owner = tmp_path.stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    if not owner:
        cache_folder()  # root's folders are accepted, because root can write anywhere
        os.chown(tmp_path, 12345, -1)
    with pytest.raises(UserError, match="belongs to another user"):
        cache_folder()


def test_experts_that_others_can_write_to_are_rejected(tmp_path: Path) -> None:
    split = made_split(tmp_path, [[Label.SOLVED]])
    (split / "experts").mkdir(exist_ok=True)
    (split / "experts").chmod(0o777)
    with pytest.raises(UserError, match=r"Other users can write to .*/experts.* leave continue_from out"):
        require_same_experts(made_job("data", f"continue_from={split}", "budget=1M"))
    file = tmp_path / "experts.npz"
    file.touch()
    file.chmod(0o666)
    with pytest.raises(UserError, match="Other users can write to"):
        load_experts(file, made_job())
    require_own(tmp_path / "nothing", "make it")

"""CPU quotas of control groups, from files as the kernel shows them."""

from pathlib import Path

import pytest

from pipeline import runtime
from pipeline.quota import cpu_quota

HYBRID = "9:name=systemd:/\n4:memory:/jobs/a\n2:cpu,cpuacct:/docker/4f\n0::/\n"


def quota(folder: Path, groups: str, files: dict[str, str]) -> float | None:
    """Where the process is in these groups, and these files are below the mount."""
    (folder / "cgroup").write_text(groups)
    for name, text in files.items():
        path = folder / "mount" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return cpu_quota(folder / "cgroup", folder / "mount")


@pytest.mark.parametrize(
    ("groups", "files", "expected"),
    [
        ("0::/\n", {"cpu.max": "400000 100000"}, 4.0),  # as a container of its own namespace sees it
        ("0::/\n", {"cpu.max": "max 100000"}, None),
        ("0::/\n", {}, None),  # the root of a machine has none
        ("0::/pod/box\n", {"pod/cpu.max": "150000 100000", "pod/box/cpu.max": "max 100000"}, 1.5),
        ("0::/pod/box\n", {"pod/cpu.max": "800000 100000", "pod/box/cpu.max": "200000 100000"}, 2.0),
        ("0::/not/mounted/here\n", {"cpu.max": "50000 100000"}, 0.5),
        (HYBRID, {"cpu,cpuacct/docker/4f/cpu.cfs_quota_us": "300000",
                  "cpu,cpuacct/docker/4f/cpu.cfs_period_us": "100000"}, 3.0),
        (HYBRID, {"cpu/cpu.cfs_quota_us": "250000", "cpu/cpu.cfs_period_us": "100000"}, 2.5),
        (HYBRID, {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, None),
        (HYBRID, {"memory/cpu.max": "100000 100000"}, None),
    ],
)  # fmt: skip
def test_the_smallest_quota_of_a_group_and_those_above(
    tmp_path: Path, groups: str, files: dict[str, str], expected: float | None
) -> None:
    assert quota(tmp_path, groups, files) == expected


def test_a_system_without_control_groups_has_no_quota(tmp_path: Path) -> None:
    assert cpu_quota(tmp_path / "nothing", tmp_path) is None


@pytest.mark.parametrize(("quota", "cores"), [(None, 64), (4.0, 4), (2.5, 2), (0.5, 1), (128.0, 64)])
def test_workers_are_as_many_as_the_quota_keeps_busy(
    monkeypatch: pytest.MonkeyPatch, quota: float | None, cores: int
) -> None:
    monkeypatch.setattr(runtime, "_allowed_cores", lambda: list(range(64)))
    monkeypatch.setattr(runtime, "cpu_quota", lambda: quota)
    assert len(runtime.own_cores()) == cores
    pinned = cores == 64  # under a quota, neighbours of other containers would be on the same cores
    assert runtime.cores_for(1000) == (list(range(64)) if pinned else [None] * cores)
    assert runtime.cores_for(2) == [None] * min(2, cores)

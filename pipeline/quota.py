"""How much CPU time a control group grants: a container sees all cores of its machine, and may use a part."""

from collections.abc import Iterator
from pathlib import Path

GROUPS = Path("/proc/self/cgroup")
MOUNT = Path("/sys/fs/cgroup")


def cpu_quota(groups: Path = GROUPS, mount: Path = MOUNT) -> float | None:
    """Seconds of CPU time a second that this process and its like may use; None: no limit.

    Args:
        groups: the groups of this process, a line `number:controllers:path` for each hierarchy.
        mount: where the hierarchies are mounted.
    """
    try:
        lines = groups.read_text().splitlines()
    except OSError:  # not Linux
        return None
    return min((quota for line in lines for quota in _quotas(line, mount)), default=None)


def _quotas(line: str, mount: Path) -> Iterator[float]:
    """The limits that hold in one hierarchy: of the process's group and of all above."""
    _, controllers, path = line.split(":", 2)
    if not controllers:  # version 2
        root, read = mount, _quota_v2
    elif "cpu" in controllers.split(","):
        root, read = mount / controllers, _quota_v1
        root = root if root.is_dir() else mount / "cpu"
    else:
        return
    group = root / path.lstrip("/")
    for folder in (group, *group.parents):
        if folder.is_relative_to(root) and (quota := read(folder)) is not None:
            yield quota


def _quota_v2(group: Path) -> float | None:
    try:
        quota, period = (group / "cpu.max").read_text().split()
        return int(quota) / int(period)
    except (OSError, ValueError):  # not there, or `max`
        return None


def _quota_v1(group: Path) -> float | None:
    try:
        quota, period = (int((group / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
    except (OSError, ValueError):
        return None
    return quota / period if quota > 0 else None

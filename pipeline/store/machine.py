"""Identity of this machine: host names are not unique, and process ids restart after each boot."""

from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # differs between machines, and after each boot


def boot_id() -> str:
    """Return the id of this machine's latest boot; empty if the system has none."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""

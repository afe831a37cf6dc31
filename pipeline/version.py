"""The installed version of levelproof."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("levelproof")
except PackageNotFoundError:  # run from a checkout that was not installed
    __version__ = "uninstalled"

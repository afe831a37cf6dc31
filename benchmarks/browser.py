"""A headless browser: the machine's own Chromium, driven by Playwright."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from levelproof.pipeline.errors import Failure

if TYPE_CHECKING:
    from playwright.sync_api import Browser  # pyright: ignore[reportMissingImports]

VARIABLE = "LEVELPROOF_CHROMIUM"  # the Chromium to use, if it is not on the path
NAMES = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = ("--no-sandbox", "--enable-precise-memory-info")  # containers forbid sandboxes


@contextmanager
def browser() -> "Iterator[Browser]":
    """Run Chromium in the `with` block.

    Raises:
        Failure: Chromium or Playwright is missing.
    """
    program = os.environ.get(VARIABLE) or next(filter(None, map(shutil.which, NAMES)), None)
    if not program:
        raise Failure(f"Chromium is missing: install Debian's package chromium, or name a program in {VARIABLE}.")
    try:
        from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise Failure("Playwright is missing: pip install playwright.") from None
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        try:
            yield opened
        finally:
            opened.close()

"""A browser without a window: Chromium as the machine has it, driven by Playwright, which brings none of its own."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from levelproof.pipeline.errors import Failure

if TYPE_CHECKING:
    from playwright.sync_api import Browser  # pyright: ignore[reportMissingImports]

VARIABLE = "LEVELPROOF_CHROMIUM"  # a Chromium, if it is not on the path
NAMES = ("chromium", "chromium-browser", "google-chrome")
WORDS = ("--no-sandbox", "--enable-precise-memory-info")  # containers let nobody make a sandbox


@contextmanager
def browser() -> "Iterator[Browser]":
    """Chromium, while it is needed.

    Raises:
        Failure: there is none, or no Playwright.
    """
    program = os.environ.get(VARIABLE) or next(filter(None, map(shutil.which, NAMES)), None)
    if not program:
        raise Failure(f"there is no Chromium: install Debian's package chromium, or name a program in {VARIABLE}.")
    try:
        from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise Failure("there is no Playwright: pip install playwright.") from None
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=program, args=list(WORDS))
        try:
            yield opened
        finally:
            opened.close()

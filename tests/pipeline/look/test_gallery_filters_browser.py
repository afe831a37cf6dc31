"""The gallery's filters in a real browser."""

import re
from pathlib import Path
from typing import Any

import pytest

from tests.pipeline.command import ROOT
from tests.pipeline.look.test_gallery_browser import address, chromium, page, rows, wait_until_drawn
from tests.pipeline.made import PLAYED

__all__ = ["address", "chromium", "page"]  # fixtures
pytestmark = pytest.mark.campaign
EXAMPLE = ROOT / "docs/example"  # 64 levels, too


def brush(page: Any, name: str, *, first: float, last: float) -> None:
    """Drag over a histogram between two shares of its width."""
    box = page.get_by_label(re.compile(f"^Histogram of {name}")).bounding_box()
    page.mouse.move(box["x"] + box["width"] * first, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * last, box["y"] + 20, steps=4)
    page.mouse.up()


def test_address_keeps_filters_and_order(page: Any, address: str, split: Path) -> None:
    page.goto(address)
    wait_until_drawn(page)
    page.get_by_role("button", name=re.compile("^solved")).click()
    count = sum(row["label"] == "solved" for row in rows(split))
    assert page.locator("#count").inner_text() == f"{count} of {PLAYED} levels"
    brush(page, "thrusters", first=0.01, last=0.3)
    brushed = int(page.locator("#count").inner_text().split(" of ")[0])
    assert 0 < brushed < count
    assert re.search(r"#label=solved&thrusters=\.\.\d$", page.url)
    page.select_option("#sort", "level_id")
    page.locator("#direction").click()
    first = page.locator("[aria-posinset='1'] a")
    shown = first.get_attribute("href")
    page.reload()
    wait_until_drawn(page)
    assert page.locator("#count").inner_text() == f"{brushed} of {PLAYED} levels"
    assert first.get_attribute("href") == shown
    page.locator("#clear").click()
    assert page.locator("#count").inner_text() == f"{PLAYED} levels"
    assert first.get_attribute("href") == f"#level={PLAYED - 1}"


REFUSING = """() => {
    window.refused = 0;
    history.replaceState = () => {
        refused++;
        throw new DOMException("Attempt to use history.replaceState() more than 100 times", "SecurityError");
    };
}"""


def test_brush_filters_although_the_browser_refuses_new_addresses(page: Any) -> None:
    """Safari does after a hundred in 30 seconds, so a brush asks for one, at its end."""
    page.goto((EXAMPLE / "index.html").as_uri())
    wait_until_drawn(page)
    page.evaluate(REFUSING)
    brush(page, "steps to goal", first=0.1, last=0.9)
    assert re.match(r"\d+ of 64 levels", page.locator("#count").inner_text())
    assert page.evaluate("refused") == 1


def test_typed_limits_are_exact(page: Any, address: str, split: Path) -> None:
    """Typing one limit leaves the other as it is, and both are shown in full."""
    page.goto(f"{address}#thrusters=0.12345678..5.87654321")
    wait_until_drawn(page)
    lower, upper = (page.get_by_label(f"thrusters, {end}", exact=True) for end in ("at least", "at most"))
    assert (lower.input_value(), upper.input_value()) == ("0.12345678", "5.87654321")
    upper.fill("5.5")
    upper.press("Enter")
    assert page.url.endswith("#thrusters=0.12345678..5.5")


def test_limit_that_is_emptied_is_no_condition(page: Any) -> None:
    """Levels without the number are shown again."""
    page.goto((EXAMPLE / "index.html").as_uri())
    wait_until_drawn(page)
    least = page.get_by_label("steps to goal, at least", exact=True)
    for typed, end, count in (("3", "#steps_to_goal=3..", "54 of 64 levels"), ("", "#", "64 levels")):
        least.fill(typed)
        least.press("Enter")
        assert page.url.endswith(end)
        assert page.locator("#count").inner_text() == count


def test_address_that_is_cut_off_shows_what_is_left(page: Any, address: str, split: Path) -> None:
    page.goto(f"{address}#label=%,solved&label_reason=%E2%8")
    wait_until_drawn(page)
    count = sum(row["label"] == "solved" for row in rows(split))
    assert page.locator("#count").inner_text() == f"{count} of {PLAYED} levels"

"""The gallery's filters in a real browser."""

import json
import re
import shutil
from base64 import b64decode, b64encode
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.pipeline.command import ROOT
from tests.pipeline.look.test_gallery import data, numbers
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


HOLDING = """(() => {
    const append = Element.prototype.append;
    Element.prototype.append = function (...nodes) {
        if (nodes[0]?.src?.endsWith("columns/1.js")) window.arrive = () => append.apply(this, nodes);
        else append.apply(this, nodes);
    };
})()"""
FOCUSED = "document.activeElement.closest('.cell')?.firstChild.ariaLabel"


def test_levels_that_arrive_later_meet_open_limits_and_leave_the_focus(page: Any, tmp_path: Path) -> None:
    """The longest witness lies beyond the last bar that the histogram has before."""
    site = Path(shutil.copytree(EXAMPLE, tmp_path / "site"))
    columns = {name: b64decode(text) for name, text in data(site, "columns/0").items()}
    steps = dict(enumerate(numbers(data(site, "columns/0")["steps_to_goal"], "<f4")))
    first = max(steps, key=lambda level_id: np.nan_to_num(steps[level_id]))  # of the second page
    for number, here in enumerate((slice(0, first), slice(first, None))):
        part = {name: np.frombuffer(values, f"V{len(values) // len(steps)}")[here] for name, values in columns.items()}
        encoded = json.dumps({name: b64encode(values.tobytes()).decode() for name, values in part.items()})
        (site / f"data/columns/{number}.js").write_text(f'levelproof.arrived("columns/{number}",{encoded});\n')
    page.add_init_script(HOLDING)
    page.goto((site / "index.html").as_uri())
    wait_until_drawn(page)
    brush(page, "steps to goal", first=0.1, last=1)
    low = int(re.search(r"#steps_to_goal=(\d+)\.\.$", page.url)[1])  # pyright: ignore[reportOptionalSubscript]
    page.select_option("#sort", "steps_to_goal")
    page.locator("#direction").click()
    assert page.locator("#count").inner_text().endswith(f" of {first} levels, more to come")
    page.locator("[aria-posinset='1'] a").focus()
    focused = page.evaluate(FOCUSED)
    page.evaluate("arrive()")
    page.wait_for_function("performance.getEntriesByName('all columns are there').length > 0")
    some = sorted((level_id for level_id in steps if steps[level_id] >= low), key=lambda level_id: -steps[level_id])
    assert page.locator("#count").inner_text() == f"{len(some)} of {len(steps)} levels"
    assert page.evaluate(FOCUSED) == focused
    assert focused.startswith(f"Level {some[1]}, ")
    assert page.evaluate("document.activeElement.closest('.cell').ariaPosInSet") == "2"


def test_address_that_is_cut_off_shows_what_is_left(page: Any, address: str, split: Path) -> None:
    page.goto(f"{address}#label=%,solved&label_reason=%E2%8")
    wait_until_drawn(page)
    count = sum(row["label"] == "solved" for row in rows(split))
    assert page.locator("#count").inner_text() == f"{count} of {PLAYED} levels"

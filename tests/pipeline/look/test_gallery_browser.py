"""The gallery in a real browser."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.browser import browser
from levelproof.experts.networks.saved import save_policy
from levelproof.experts.witness.witness import steps_to_goal
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.look.gallery.gallery import gallery
from levelproof.pipeline.look.gallery.worlds import ANGLE, LENGTH
from levelproof.pipeline.read.rows import read_row
from levelproof.pipeline.store.manifest import require_manifest
from tests.pace import patience
from tests.pipeline.command import ROOT
from tests.pipeline.made import PLAYED, small_policy

DEMANDED = "LEVELPROOF_TEST_BROWSER"
DESKTOP, PHONE = {"width": 1280, "height": 860}, {"width": 390, "height": 844}
STATES = """async (id) => {
    const { load, worldOf, statesOf, bytesOf } = levelproof;
    const [worlds, data] = [await load("worlds/0"), await load(`levels/0/${id}`)];
    const steps = bytesOf(data.actions).length / 6;
    return statesOf(worldOf(worlds[id]), data.states, steps + 1).map((places) => Array.from(places));
}"""
COLOURED = """(canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const seen = new Set();
    for (let i = 0; i < data.length; i += 4) seen.add(`${data[i]},${data[i + 1]},${data[i + 2]}`);
    return [...seen];
}"""
UNNAMED = """() => [...document.querySelectorAll("button, input, select, a, [role=img]")]
    .filter((element) => element.checkVisibility())
    .filter((element) => !(element.ariaLabel || element.textContent.trim() || element.labels?.length))
    .map((element) => element.outerHTML)"""

pytestmark = pytest.mark.campaign


@pytest.fixture(scope="module")
def address(split: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    out = tmp_path_factory.mktemp("site") / "gallery"
    gallery(split, out, None, PLAYED)
    return (out / "index.html").as_uri()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Start Chromium; without one, skip, or fail if LEVELPROOF_TEST_BROWSER=1."""
    try:
        with browser() as opened:
            yield opened
    except Failure as failure:
        if os.environ.get(DEMANDED):
            raise
        pytest.skip(f"no browser: {failure}")


@pytest.fixture
def page(chromium: Any) -> Iterator[Any]:
    """A page that must log no errors and make no requests to other hosts."""
    context = chromium.new_context(viewport=DESKTOP, reduced_motion="reduce")
    opened, messages = patient(context.new_page()), list[str]()
    opened.on("console", lambda message: messages.append(message.text))
    opened.on("pageerror", lambda error: messages.append(str(error)))
    opened.on(
        "request",
        lambda request: messages.append(request.url) if not request.url.startswith(("file:", "data:")) else None,
    )
    yield opened
    assert messages == []
    context.close()


def patient(page: Any) -> Any:
    """Lengthen a page's own limits, 30 s each, by the machine's slowness."""
    page.set_default_timeout(1000 * patience(30))
    return page


def rows(split: Path) -> list[dict[str, Any]]:
    return require_manifest(split).table.to_pylist()


def wait_until_drawn(page: Any) -> None:
    page.wait_for_function("performance.getEntriesByName('levels are drawn').length > 0")


def solved(split: Path) -> int:
    return next(int(row["level_id"]) for row in rows(split) if row["shard"])


def test_grid_draws_visible_levels(page: Any, address: str) -> None:
    page.goto(address)
    wait_until_drawn(page)
    assert page.locator("#count").inner_text() == f"{PLAYED} levels"
    cells = page.locator(".cell:visible")
    assert 12 <= cells.count() < PLAYED  # only those on the screen
    seen = {colour for i in range(6) for colour in cells.nth(i).locator("canvas").evaluate(COLOURED)}
    assert {"62,176,92", "58,124,220", "247,247,243"} <= seen  # green, blue, sky
    assert page.evaluate(UNNAMED) == []


MILLIONS = """(count) => {
    const layout = levelproof.Grid.prototype.layout;
    levelproof.Grid.prototype.layout = function () {
        window.grid = this;
        layout.call(this);
    };
    dispatchEvent(new Event("scroll"));
    return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => {
        grid.show(Uint32Array.from({ length: count }, (_, i) => i % grid.rows.length), "steps_to_goal");
        done(grid.element.clientHeight);
    })));
}"""
PRESSED = "(key) => document.body.dispatchEvent(new KeyboardEvent('keydown', { ...key, bubbles: true }))"
NEXT_FRAMES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
SHOWN = """() => [...document.querySelectorAll(".cell")].filter((cell) => {
    const { top, bottom } = cell.getBoundingClientRect();
    return cell.checkVisibility() && bottom > 0 && top < innerHeight;
}).map((cell) => Number(cell.ariaPosInSet)).sort((a, b) => a - b)"""


def test_grid_of_millions_of_levels_is_no_higher_than_browsers_show(page: Any, address: str) -> None:
    """Every level can be reached by scrolling or by keys, and cells lie side by side."""
    count = 3_000_000
    page.goto(address)
    wait_until_drawn(page)
    assert page.evaluate(MILLIONS, count) <= 8_000_000
    for share in (0, 0.25, 0.5, 1):
        page.evaluate("share => scrollTo(0, share * (document.body.scrollHeight - innerHeight))", share)
        page.evaluate(NEXT_FRAMES)
        shown = page.evaluate(SHOWN)
        assert shown == [*range(shown[0], shown[0] + len(shown))]
        assert len(shown) >= 12
        assert abs(shown[0] / count - share) < 0.001
    assert shown[-1] == count
    page.locator(f"[aria-posinset='{count}'] a").focus()
    for key, position in ("ArrowLeft", count - 1), ("Home", 1), ("ArrowRight", 2), ("End", count):
        page.keyboard.press(key)
        assert page.evaluate("document.activeElement.closest('.cell').ariaPosInSet") == str(position)
        assert position in page.evaluate(SHOWN)
    page.evaluate("scrollTo(0, 4e6)")
    page.keyboard.press("ArrowLeft")  # before the page is laid out again
    assert page.evaluate(SHOWN)[-1] == count
    page.evaluate("scrollTo(0, 4e6)")
    page.evaluate(NEXT_FRAMES)
    before = page.evaluate(SHOWN)
    page.evaluate("grid.show(grid.rows.slice(0, 2_900_000), 'steps_to_goal')")  # as if more were loaded or left out
    assert before[0] in page.evaluate(SHOWN)
    page.evaluate("grid.move(5)")
    page.keyboard.press("End")
    page.keyboard.press("PageUp")
    page.keyboard.press("ArrowUp")
    assert int(page.evaluate("document.activeElement.closest('.cell').ariaPosInSet")) in page.evaluate(SHOWN)


def test_level_page_plays_the_record(page: Any, address: str, split: Path) -> None:
    level_id = solved(split)
    page.goto(f"{address}#level={level_id}")
    page.wait_for_selector("#title:has-text('Level')")
    arrays = read_row(split, next(row for row in rows(split) if row["level_id"] == level_id))
    steps = int(steps_to_goal(arrays["record/done"])[0])
    states = np.array(page.evaluate(STATES, level_id)).reshape(steps + 1, -1, 3)
    present = np.flatnonzero(arrays["level/model/active"][:, 0])
    order = present[np.argsort(arrays["level/model/inverse_mass"][present, 0] != 0, kind="stable")]
    where, turned = (arrays[f"record/state/{name}"][:steps, ..., 0][:, order] for name in ("position", "rotation"))
    np.testing.assert_allclose(states[:-1, :, :2], where, atol=0.51 * LENGTH)
    np.testing.assert_allclose(np.exp(1j * states[:-1, :, 2]), np.exp(1j * turned), atol=ANGLE)
    start = page.locator("#stage").evaluate("(canvas) => canvas.toDataURL()")
    page.keyboard.press("End")
    assert page.locator("#clock").inner_text().startswith(f"step {steps} of {steps} · ")
    assert page.locator("#stage").evaluate("(canvas) => canvas.toDataURL()") != start
    page.keyboard.press("ArrowLeft")
    assert page.locator("#clock").inner_text().startswith(f"step {steps - 1} of {steps} · ")
    page.get_by_role("button", name="Play", exact=True).click()
    page.wait_for_selector("#play:text-is('Pause')")
    assert page.locator("#command").inner_text().startswith("levelproof generate")
    assert page.locator("#reason").inner_text() == "Made for a test."
    assert "to 50%" in page.locator("#curve").get_attribute("aria-label")
    assert page.evaluate(UNNAMED) == []


def test_keys_work_after_a_button_and_in_capitals(page: Any, address: str, split: Path) -> None:
    page.goto(f"{address}#level={solved(split)}")
    page.wait_for_selector("#title:has-text('Level')")
    steps = int(page.locator("#scrub").get_attribute("max"))
    page.locator("#step-on").click()
    page.keyboard.press("End")
    assert page.locator("#clock").inner_text().startswith(f"step {steps} of {steps} · ")
    page.keyboard.press("Enter")  # presses the button, which is at the end already
    page.locator("#trails").click()
    page.keyboard.press("Home")
    assert page.locator("#clock").inner_text().startswith("step 0 of ")
    for press, step in (("", 0), ("pointerdown", steps)):  # a list that the mouse has not touched keeps the keys
        page.locator("#speed").focus()
        if press:
            page.locator("#speed").dispatch_event(press)
        page.select_option("#speed", "0.5" if press else "2")
        page.keyboard.press("End")
        assert page.locator("#clock").inner_text().startswith(f"step {step} of {steps} · ")
    page.locator("#scrub").click()
    for words in ("Pause", "Play"):  # a slider has no use for Space
        page.keyboard.press(" ")
        page.wait_for_selector(f"#play:text-is('{words}')")
    page.keyboard.press("N")
    page.wait_for_selector(f"#title:not(:text('Level {solved(split)}'))")
    page.evaluate(PRESSED, {"key": "\u0437", "code": "KeyP"})  # on a Russian keyboard
    page.wait_for_selector(f"#title:text('Level {solved(split)}')")


def test_one_step_back_leaves_the_last_picture(page: Any, address: str, split: Path) -> None:
    """Also while the film rests on it."""
    page.goto(f"{address}#level={solved(split)}")
    page.wait_for_selector("#title:has-text('Level')")
    steps = int(page.locator("#scrub").get_attribute("max"))
    page.keyboard.press("End")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press(" ")
    page.wait_for_selector(f"#clock:has-text('step {steps} of')")
    page.keyboard.press("ArrowLeft")
    assert page.locator("#clock").inner_text().startswith(f"step {steps - 1} of {steps} · ")


def test_level_page_plays_a_policy_beside_the_witness(page: Any, split: Path, tmp_path: Path) -> None:
    save_policy(tmp_path / "policy", small_policy())
    gallery(split, tmp_path / "site", None, PLAYED, tmp_path / "policy")
    page.goto((tmp_path / "site" / "index.html").as_uri())
    wait_until_drawn(page)
    page.get_by_role("button", name=re.compile("^fails")).click()
    assert 0 < int(page.locator("#count").inner_text().split(" of ")[0]) < PLAYED
    page.goto(f"{(tmp_path / 'site' / 'index.html').as_uri()}#level={solved(split)}")
    page.wait_for_selector("#policy-words:has-text('Policy: ')")
    assert page.locator("#stage-words").inner_text().startswith("Witness: ")
    both = [page.locator(f"#{stage}") for stage in ("stage", "policy-stage")]
    starts = [stage.evaluate("(canvas) => canvas.toDataURL()") for stage in both]
    page.keyboard.press("End")
    ends = [stage.evaluate("(canvas) => canvas.toDataURL()") for stage in both]
    assert starts[0] != ends[0]
    assert starts[1] != ends[1]
    assert page.evaluate(UNNAMED) == []


def test_search_keyboard_and_back_navigation(page: Any, address: str) -> None:
    page.goto(address)
    wait_until_drawn(page)
    page.get_by_label("Level id").fill("999")
    page.keyboard.press("Enter")
    assert page.get_by_role("alert").inner_text() == "There is no level 999 in this gallery."
    page.locator("[aria-posinset='1'] a").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowDown")
    name = page.evaluate("document.activeElement.ariaLabel")
    assert re.match(r"Level \d+, (un)?solved", name)
    page.keyboard.press("End")
    assert page.evaluate("document.activeElement.ariaLabel").startswith(f"Level {PLAYED - 1}, ")
    assert page.evaluate("scrollY") > 0
    page.keyboard.press("Enter")
    page.wait_for_selector(f"#title:has-text('Level {PLAYED - 1}')")
    page.keyboard.press("p")
    page.wait_for_selector(f"#title:has-text('Level {PLAYED - 2}')")
    page.keyboard.press("Escape")
    page.wait_for_selector("#overview:visible")
    assert page.evaluate("scrollY") > 0  # scroll position restored
    assert page.evaluate("document.activeElement.ariaLabel").startswith(f"Level {PLAYED - 2}, ")
    page.goto(f"{address}#level=12345")
    page.wait_for_selector("#problem:has-text('no level 12345')")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_fit_a_phone_in_light_and_dark(chromium: Any, address: str, split: Path, scheme: str) -> None:
    context = chromium.new_context(viewport=PHONE, color_scheme=scheme, device_scale_factor=2, has_touch=True)
    page = patient(context.new_page())
    for at in ("", f"#level={solved(split)}"):
        page.goto(address + at)
        page.wait_for_selector("#title:has-text('Level')" if at else ".cell:visible")
        assert page.evaluate("document.scrollingElement.scrollWidth") <= PHONE["width"]
    page.goto(address)
    wait_until_drawn(page)
    page.get_by_text("Filters", exact=True).click()
    assert page.get_by_role("button", name=re.compile("^solved")).is_visible()
    page.get_by_text("Filters", exact=True).click()
    page.wait_for_function("document.querySelectorAll('.cell:not([hidden])').length > 3")
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(19, 21, 25)"
    assert dark == (scheme == "dark")
    context.close()


def test_docs_example_opens_from_disk(page: Any) -> None:
    page.goto((ROOT / "docs/example/index.html").as_uri())
    wait_until_drawn(page)
    assert page.locator("#count").inner_text() == "64 levels"
    page.goto((ROOT / "docs/example/index.html").as_uri() + "#level=7")
    page.wait_for_selector("#title:has-text('Level 7')")
    page.keyboard.press("End")
    assert page.locator("#clock").inner_text().startswith("step 24 of 24 · ")


def test_page_reports_a_damaged_file(chromium: Any, tmp_path: Path, split: Path) -> None:
    gallery(split, tmp_path / "gallery", None, PLAYED)
    (tmp_path / "gallery/data/columns/0.js").write_text("levelproof.nothing = 1;\n")
    page = chromium.new_page()
    page.goto((tmp_path / "gallery/index.html").as_uri())
    page.wait_for_selector("#problem:has-text('write the gallery again with levelproof gallery')")
    page.close()

"""`levelproof play` in a real browser."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from levelproof.levelgen.files.level_file import from_document
from levelproof.pipeline.look.gallery.contender import Contender
from levelproof.pipeline.play.server import HOST, serving
from levelproof.pipeline.play.session import Session, empty_file
from tests.pace import patience
from tests.pipeline.look.test_gallery_browser import PRESSED, UNNAMED, chromium, patient
from tests.pipeline.made import small_policy
from tests.pipeline.play.test_play import QUICK, driven_by_a_thruster

__all__ = ["chromium"]  # a fixture
pytestmark = pytest.mark.campaign
VIEW, BORDER, TOP = 5.16, 0.08, 5.08  # m; the canvas shows -BORDER to TOP
RECORDING = """() => {
    const send = WebSocket.prototype.send;
    window.asked = [];
    WebSocket.prototype.send = function (text) {
        asked.push(JSON.parse(text));
        send.call(this, text);
    };
}"""


@pytest.fixture
def page(chromium: Any) -> Iterator[Any]:
    with serving(empty_file("m"), None, QUICK, 20_000, 0, Contender(small_policy(), 1)) as server:
        opened = patient(chromium.new_page(viewport={"width": 1280, "height": 900}, accept_downloads=True))
        opened.failures = []
        opened.on("pageerror", lambda error: opened.failures.append(str(error)))
        opened.goto(f"http://{HOST}:{server.socket.getsockname()[1]}/")
        opened.wait_for_function("document.querySelector('#pads').textContent.includes('Nothing acts')")
        yield opened
        assert not opened.failures
        opened.close()


def click(page: Any, x: float, y: float) -> None:
    """Click at a point of the world, m."""
    box = page.locator("#stage").bounding_box()
    scale = box["width"] / VIEW
    page.mouse.click(box["x"] + (x + BORDER) * scale, box["y"] + (TOP - y) * scale)


def button(page: Any, name: str, role: str = "button") -> None:
    page.get_by_role(role, name=name, exact=True).click()


def place(page: Any, shape: str, x: float, y: float, role: str) -> None:
    """Add a body with a role."""
    button(page, shape, "radio")
    click(page, x, y)
    page.wait_for_selector("[data-tool=select][aria-checked=true]")  # the page returns to this tool
    click(page, x, y)
    button(page, role)
    page.wait_for_function(f"document.querySelector('#what').textContent.toLowerCase().startsWith('{role}')")


def test_page_builds_edits_plays_and_saves_a_level(page: Any, tmp_path: Path) -> None:
    place(page, "Circle", 1.0, 0.7, "green")
    place(page, "Rectangle", 4.0, 0.7, "blue")
    button(page, "Fix it")
    page.wait_for_function("document.querySelector('#what').textContent.includes('cannot move')")
    button(page, "Thruster", "radio")
    box = page.locator("#stage").bounding_box()
    scale = box["width"] / VIEW
    at = lambda x, y: (box["x"] + (x + BORDER) * scale, box["y"] + (TOP - y) * scale)
    page.mouse.move(*at(1.0, 0.7))
    page.mouse.down()
    page.mouse.move(*at(1.4, 0.7))
    page.mouse.up()
    page.wait_for_selector("#pads button")
    assert not page.evaluate(UNNAMED)

    page.keyboard.down("1")
    page.wait_for_function(
        "document.querySelector('#outcome').textContent.startsWith('Solved')", timeout=1000 * patience(60)
    )
    page.keyboard.up("1")
    with page.expect_download() as saved:
        button(page, "Save level with witness")
    path = tmp_path / "witness.json"
    saved.value.save_as(path)
    document = json.loads(path.read_text())
    assert len(document["witness"]["actions"]) > 3
    assert sorted(from_document(document).level.role[4:].ravel().tolist())[-2:] == [1, 2]

    button(page, "Let the policy play")
    page.wait_for_function(
        "document.querySelector('#outcome').textContent.startsWith('The policy')", timeout=1000 * patience(60)
    )
    button(page, "Watch")
    page.wait_for_function("document.querySelector('#outcome').textContent.startsWith('The witness reaches')")
    button(page, "Undo")
    page.wait_for_function("document.querySelector('#pads').textContent.includes('Nothing acts')")
    page.locator("#open").set_input_files(path)
    page.wait_for_selector("#pads button")
    assert page.locator("#watch").is_enabled()


def test_selection_stays_with_its_body_when_the_drawing_order_changes(page: Any) -> None:
    """Immovable bodies are drawn first."""
    place(page, "Rectangle", 4.0, 0.7, "blue")
    place(page, "Circle", 1.0, 0.7, "green")
    button(page, "Fix it")
    page.wait_for_selector("#what:text-is('Green body, cannot move')")
    page.keyboard.press("Delete")
    page.wait_for_selector("#selected", state="hidden")
    click(page, 4.0, 0.7)
    page.wait_for_selector("#what:text-is('Blue body')")


def test_delete_key_leaves_scenery_as_it_is(page: Any) -> None:
    click(page, 2.5, -0.04)
    page.wait_for_selector("#what:text-is('Plain body, cannot move')")
    page.keyboard.press("Delete")
    place(page, "Circle", 1.0, 0.7, "green")  # answers come in the order of requests
    click(page, 2.5, -0.04)
    page.wait_for_selector("#what:text-is('Plain body, cannot move')")


def wait_for_step(page: Any, step: int) -> None:
    page.wait_for_selector(f"#clock:has-text('step {step} of')")


def test_page_and_engine_stay_at_the_same_step(page: Any) -> None:
    """When there is nothing to undo, and when the engine refuses an edit."""
    for step in (1, 2):
        button(page, "One step")
        wait_for_step(page, step)
    page.keyboard.press("Control+z")
    wait_for_step(page, 2)
    place(page, "Circle", 1.0, 0.7, "green")
    wait_for_step(page, 0)
    button(page, "One step")
    wait_for_step(page, 1)
    page.keyboard.press("Control+Shift+z")
    button(page, "One step")
    wait_for_step(page, 2)
    for _ in range(16):  # the first only goes to the start, too
        button(page, "Larger")
    page.wait_for_selector("#problem:has-text('The body would reach')")
    button(page, "One step")
    wait_for_step(page, 1)
    button(page, "Larger")
    wait_for_step(page, 0)
    button(page, "One step")
    wait_for_step(page, 1)


def test_control_held_while_the_level_changes_is_released(page: Any) -> None:
    place(page, "Circle", 1.0, 0.7, "plain")
    button(page, "Thruster", "radio")
    click(page, 1.0, 0.7)
    page.wait_for_selector("#pads button")
    button(page, "Select", "radio")
    click(page, 1.0, 0.9)
    button(page, "blue")
    page.wait_for_selector("#what:has-text('Blue')")
    page.evaluate(RECORDING)
    page.locator("#pads button").hover()
    page.mouse.down()
    page.wait_for_selector("#play:text-is('Pause')")
    page.keyboard.press("Control+z")
    page.wait_for_selector("#what:has-text('Plain')")
    page.mouse.move(5, 5)  # off the button that has taken the other's place
    page.mouse.up()
    button(page, "One step")
    wait_for_step(page, 1)
    actions = [request["action"] for request in page.evaluate("asked") if request["ask"] == "step"]
    assert (actions[0], actions[-1]) == ([0, 0, 0, 0, 1, 0], [0] * 6)
    page.evaluate(PRESSED, {"key": "&", "code": "Digit1"})  # on a French keyboard
    page.wait_for_selector("#pads .lit")


def test_page_says_which_file_is_no_level(page: Any, tmp_path: Path) -> None:
    for text, problem in (("{}", "env_state is missing."), ("{", "it is not JSON.")):
        (tmp_path / "bad.json").write_text(text)
        page.locator("#open").set_input_files(tmp_path / "bad.json")
        page.wait_for_selector(f"#problem:text-is('Cannot use the level file bad.json: {problem}')")


def test_film_ends_when_another_level_is_opened(page: Any, tmp_path: Path) -> None:
    session = Session(empty_file("m"))
    for name, *values in driven_by_a_thruster():
        session.edit({"name": name, "with": values})
    while not session.step({"action": [0, 0, 0, 0, 1, 0]})["done"]:
        pass
    (tmp_path / "witness.json").write_text(json.dumps(session.save({})["document"]))
    page.locator("#open").set_input_files(tmp_path / "witness.json")
    page.wait_for_selector("#pads button")
    page.select_option("#speed", "0.25")
    button(page, "Watch")
    page.wait_for_function("/^step [1-9]/.test(document.querySelector('#clock').textContent)")  # frames may be skipped
    page.select_option("#new-size", "s")
    page.click("#new")
    page.wait_for_function("document.querySelector('#pads').textContent.includes('Nothing acts')")
    page.wait_for_timeout(1000 * patience(0.5))  # ms, in which the film could go on
    assert page.locator("#clock").inner_text().startswith("step 0 of")


def test_page_shows_training_to_its_end(page: Any, tmp_path: Path) -> None:
    place(page, "Circle", 1.0, 0.7, "green")
    place(page, "Rectangle", 4.0, 0.7, "blue")
    button(page, "Thruster", "radio")
    click(page, 1.0, 0.7)
    page.wait_for_selector("#pads button")
    button(page, "Train an expert for this level")
    done = "/^(solved|unsolved|trivial|unsolvable):/.test(document.querySelector('#stage-of-training').textContent)"
    page.wait_for_function(done, timeout=1000 * patience(240))
    assert page.locator("#learning").is_hidden() == (page.locator("#curve path").count() == 0)
    verdict = page.locator("#stage-of-training")
    assert "began" not in verdict.inner_text()
    button(page, "Undo")  # the verdict is about another level now
    page.wait_for_function("document.querySelector('#stage-of-training').textContent === ''")
    assert page.locator("#learning").is_hidden()
    button(page, "Redo")
    page.wait_for_selector("#pads button")
    button(page, "Train an expert for this level")
    button(page, "Undo")
    page.wait_for_function(done, timeout=1000 * patience(240))
    assert verdict.inner_text().endswith(" It is about the level as it was when training began.")
    assert page.locator("#watch").is_disabled()


def test_page_shows_a_learning_curve(page: Any) -> None:
    rates = "levelproof.drawCurve(document.querySelector('#curve'), [null, 0.25, null, 0.5])"
    assert page.locator("#curve").is_hidden()
    page.evaluate(rates)
    assert page.locator("#curve").is_visible()
    assert "from 25% to 50%" in (page.locator("#curve").get_attribute("aria-label") or "")

"""Take the screenshots docs/gallery.png, docs/gallery-level.png and docs/play.png of the gallery and the player.

levelproof generate size=l levels=96 budget=64k
levelproof gallery data/64k/l -o gallery
python docs/make_pages.py gallery data/64k/l 76
"""

import sys
from pathlib import Path

from benchmarks.browser import browser
from levelproof.experts.procedure import Procedure
from levelproof.pipeline.play.open import level_to_play
from levelproof.pipeline.play.server import HOST, serving
from levelproof.pipeline.runtime import prepare_jax

VIEW = {"width": 1180, "height": 700}
FOLDER = Path(__file__).parent
BODY = (0.63, 0.56)  # fractions of the canvas; a body of level 76 to select
MIDDLE = 0.4  # fraction of the episode that gallery-level.png shows


def main(site: Path, split: Path, level_id: int) -> None:
    prepare_jax()
    address = (site / "index.html").resolve().as_uri()
    file, actions = level_to_play(split, level_id, "")
    with browser() as chromium, serving(file, actions, Procedure(), 64_000, 0) as server:
        page = chromium.new_page(viewport=VIEW, color_scheme="light", reduced_motion="reduce")
        page.goto(address)
        page.wait_for_function("performance.getEntriesByName('levels are drawn').length > 0")
        page.screenshot(path=FOLDER / "gallery.png")
        page.goto(f"{address}#level={level_id}")
        page.wait_for_selector(f"#title:has-text('Level {level_id}')")
        steps = int(page.locator("#clock").inner_text().split(" of ")[1].split()[0])
        for _ in range(round(MIDDLE * steps)):
            page.keyboard.press("ArrowRight")
        page.screenshot(path=FOLDER / "gallery-level.png")
        page.goto(f"http://{HOST}:{server.socket.getsockname()[1]}/")
        page.wait_for_selector("#pads button")
        box = page.locator("#stage").bounding_box()
        page.mouse.click(box["x"] + BODY[0] * box["width"], box["y"] + BODY[1] * box["height"])
        page.wait_for_timeout(500)
        page.screenshot(path=FOLDER / "play.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))

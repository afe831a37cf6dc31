"""Draws docs/gallery.png: the first screen of a gallery, in half of a page's width.

levelproof generate size=l levels=96 budget=64k
levelproof gallery data/64k/l -o gallery
python docs/make_gallery.py gallery
"""

import io
import sys
from pathlib import Path

from PIL import Image

from benchmarks.browser import browser

VIEW = {"width": 1180, "height": 700}
PICTURE = Path(__file__).with_name("gallery.png")
COLOURS = 256


def main(site: Path) -> None:
    with browser() as chromium:
        page = chromium.new_page(viewport=VIEW, color_scheme="light")
        page.goto((site / "index.html").resolve().as_uri())
        page.wait_for_function("performance.getEntriesByName('levels are drawn').length > 0")
        shown = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    shown.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

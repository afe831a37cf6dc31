"""Films in SVG files against the pictures of their scenes, by a rasteriser and, where there is one, a browser."""

import io
import shutil
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import resvg_py
from PIL import Image

from levelproof.levelgen.pictures.raster import rasterise
from levelproof.levelgen.pictures.scene import scene_of
from levelproof.levelgen.pictures.shapes import Scene
from levelproof.levelgen.pictures.svg import svg_of
from levelproof.levelgen.pictures.words import Caption
from tests.golden.load import golden
from tests.pace import patience

SVG = "{http://www.w3.org/2000/svg}"
WORLD = slice(40, 500)  # rows without text, whose font may differ between machines
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")


def scene(sample, lane: int, **caption) -> Scene:
    captions = Caption(**{"title": "level 7 · size m", "clock": "1.2 s"} | caption)
    return scene_of(sample.level, sample.state, lane, sample.action[:, lane], captions)


def film(sample, steps: int = 5) -> tuple[list[Scene], list[float]]:
    """Show one level in states of others, so that every part moves, turns, appears and vanishes."""
    level = jax.tree.map(lambda x: x[..., :1], sample.level)
    captions = [Caption("film", f"{step} s", "goal reached" if step == steps - 1 else "") for step in range(steps)]
    scenes = [scene_of(level, sample.state, step, sample.action[:, step], words) for step, words in enumerate(captions)]
    return scenes, [0.1] * (steps - 1) + [1.0]


def picture(svg: str) -> np.ndarray:
    data = bytes(resvg_py.svg_to_bytes(svg_string=svg))
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


def pixels(sample: Scene) -> np.ndarray:
    return np.asarray(rasterise(sample)).astype(int)


def coarse(image: np.ndarray) -> np.ndarray:
    """Average over squares of eight pixels, so that differences at edges vanish."""
    height, width = image.shape[0] // 8 * 8, image.shape[1] // 8 * 8
    return image[:height, :width].reshape(height // 8, 8, width // 8, 8, 3).mean((1, 3))


def assert_alike(svg: np.ndarray, png: np.ndarray) -> None:
    assert svg.shape == png.shape
    assert np.abs(svg - png)[WORLD].mean() < 3
    assert np.abs(coarse(svg[WORLD]) - coarse(png[WORLD])).max() < 45
    assert np.abs(svg - png).mean() < 4


def at(svg: str, second: float) -> str:
    """Freeze a film as a browser shows it at a time: replace animated attributes by their values."""
    root = ET.fromstring(svg)
    for parent in root.iter():
        moves = []
        for element in list(parent):
            if not element.tag.startswith(f"{SVG}animate"):
                continue
            parent.remove(element)
            value = _value(element, second)
            if element.get("attributeName") == "transform":
                moves.append(f"{element.get('type')}({value})")
            else:
                parent.set(element.get("attributeName", ""), value)
        if moves:
            parent.set("transform", " ".join(moves))
    return ET.tostring(root, encoding="unicode")


def _value(element: ET.Element, second: float) -> str:
    share = second / float(element.get("dur", "")[:-1])
    times = [float(time) for time in element.get("keyTimes", "").split(";")]
    values = element.get("values", "").split(";")
    assert len(times) == len(values)
    assert times[0] == 0
    assert sorted(times) == times
    if element.get("calcMode") == "discrete":
        return values[max(i for i, time in enumerate(times) if time <= share + 1e-4)]
    assert times[-1] == 1
    numbers = np.array([[float(part) for part in value.split(",")] for value in values])
    return ",".join(str(np.interp(share, times, column)) for column in numbers.T)


def test_comparison_notices_a_moved_or_missing_part() -> None:
    """One part is six pixels away from its position, or missing."""
    still = scene(golden("l"), 3)
    body = max(i for i, part in enumerate(still.parts) if part.angle)
    part = still.parts[body]
    for other in (replace(part, position=(part.position[0] + 0.06, part.position[1])), replace(part, shapes="")):
        parts = [*still.parts[:body], other, *still.parts[body + 1 :]]
        with pytest.raises(AssertionError):
            assert_alike(picture(svg_of([replace(still, parts=tuple(parts))], [1.0])), pixels(still))


@pytest.mark.parametrize("size", "sml")
def test_film_shows_each_scene_at_its_time(size: str) -> None:
    scenes, seconds = film(golden(size))
    svg = svg_of(scenes, seconds)
    for number, start in enumerate(np.cumsum([0.0, *seconds[:-1]])):
        assert_alike(picture(at(svg, float(start))), pixels(scenes[number]))
    assert_alike(picture(at(svg, sum(seconds) - 0.01)), pixels(scenes[-1]))  # the last scene is held


def test_film_begins_with_its_first_scene() -> None:
    """For programs that do not play films."""
    scenes, seconds = film(golden("m"))
    assert_alike(picture(svg_of(scenes, seconds)), pixels(scenes[0]))


def test_still_parts_are_not_animated() -> None:
    still = scene(golden("l"), 0)
    svg = svg_of([still] * 10, [0.1] * 10)
    assert "animate" not in svg
    assert svg == svg_of([still], [0.1])


def test_film_file_is_small() -> None:
    scenes, seconds = film(golden("l"), 64)
    assert len(svg_of(scenes, seconds)) < 150_000


@pytest.mark.parametrize("title", ["<script>alert(1)</script>", 'a & b "quoted"', "\x00\x1b[31m\udcff", "x" * 500])
def test_svg_escapes_any_title(title: str) -> None:
    root = ET.fromstring(svg_of([scene(golden("s"), 0, title=title)], [1.0]).encode())
    assert not list(root.iter(f"{SVG}script"))
    words = [element.text or "" for element in root.iter(f"{SVG}text")]
    assert words[0][:3] == title[:3] or not title.isprintable()
    assert len(words[0]) < 80


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="needs the program chromium or google-chrome")
def test_browser_plays_a_film(tmp_path) -> None:
    scenes, seconds = film(golden("l"))
    svg = svg_of(scenes, seconds)
    for number, start in enumerate(np.cumsum([0.0, *seconds[:-1]])):
        assert_alike(photograph(svg, float(start) + 1e-4, tmp_path), pixels(scenes[number]))


def photograph(svg: str, second: float, folder: Path) -> np.ndarray:
    """Take a screenshot of a film in a browser at a time."""
    seek = f"let s = document.querySelector('svg'); s.pauseAnimations(); s.setCurrentTime({second});"
    page, shot = folder / "page.html", folder / "shot.png"
    page.write_text(f"<!doctype html><meta charset=utf-8><body style='margin:0'>{svg}<script>{seek}</script>")
    width, height = picture(svg).shape[1::-1]
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--screenshot={shot}"]
    command = [str(BROWSER), *options, f"--window-size={width},{height + 200}", str(page)]
    subprocess.run(command, check=True, capture_output=True, timeout=patience(60))
    return np.asarray(Image.open(shot).convert("RGB")).astype(int)[:height, :width]

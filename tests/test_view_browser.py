"""The viewer in a browser without a network: a surface, a camera's click shows its picture, two clicks measure.

Slow, and left out where Chromium or the package that drives it is not installed:
apt-get install chromium; pip install playwright
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
from view_runs import CANARY, LENGTH, RADIUS, write_frames, write_run

pytest.importorskip("viser", reason="needs the extra `view`")
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
NOWHERE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
"""No other host has an address."""

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    run = write_run(folder / "run", write_frames(folder / CANARY))
    argv = [sys.executable, "-m", "lightdepth", "view", str(run), "--port", "0", "--quiet"]
    process = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True, env=os.environ, start_new_session=True)
    yield process.stdout.readline().split()[-1]
    process.terminate()
    process.communicate()


@pytest.fixture(scope="module")
def page(url):
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=[*SOFTWARE, NOWHERE])
        opened = browser.new_page(viewport={"width": 1280, "height": 900})
        opened.asked, opened.wrong = [], []
        opened.on("request", lambda request: opened.asked.append(request.url))
        opened.on("pageerror", lambda error: opened.wrong.append(str(error)))
        opened.goto(url)
        opened.get_by_text("lightdepth view").wait_for(timeout=60_000)
        opened.get_by_text("keyframe 000000.png").wait_for(timeout=60_000)
        yield opened
        browser.close()


def seen(page, wait: int = 3000) -> np.ndarray:
    """The scene (H, W, 3) RGB, without the panel and the word on slow drawing, once it is drawn."""
    page.wait_for_timeout(wait)
    box = page.locator("canvas").first.bounding_box()
    image = cv2.imdecode(np.frombuffer(page.screenshot(clip=box), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    image[:170, :330] = 255
    return image.astype(int)


def drawn(page, wait: int = 3000) -> float:
    """The share of the scene that is not background."""
    return float((seen(page, wait) < 245).any(-1).mean())


def test_the_surface_is_drawn_and_goes_when_it_is_switched_off_and_nothing_is_asked_of_anywhere_else(page, url):
    for _ in range(20):
        if (before := drawn(page, 1000)) > 0.15:
            break
    assert before > 0.15
    page.get_by_label("Surface", exact=True).uncheck(force=True)
    assert drawn(page) < before / 2
    page.get_by_label("Surface", exact=True).check(force=True)
    assert drawn(page) == pytest.approx(before, rel=0.05)
    elsewhere = [
        asked for asked in page.asked if not asked.startswith((url, url.replace("http", "ws"), "data:", "blob:"))
    ]
    assert elsewhere == [] and page.wrong == [] and CANARY not in page.content()


def shown_grey(page) -> int:
    """The grey of the picture in the panel, which each keyframe has of its own."""
    image = page.locator("img").last
    data = cv2.imdecode(np.frombuffer(image.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return int(np.median(data))


def test_a_click_on_a_camera_shows_its_picture(page):
    page.get_by_label("Surface", exact=True).uncheck(force=True)
    assert abs(shown_grey(page) - 40) < 4
    image = seen(page)
    rows, columns = np.nonzero((np.ptp(image, axis=-1) < 8) & (np.abs(image.mean(-1) - 90) < 15))
    assert len(rows) > 100  # of the picture on the second camera
    page.mouse.click(float(np.median(columns)), float(np.median(rows)))
    page.wait_for_timeout(2000)
    assert page.get_by_text("keyframe 000001.png").count() == 1 and abs(shown_grey(page) - 90) < 4
    page.get_by_label("Surface", exact=True).check(force=True)


def test_two_clicks_measure_along_the_wall_of_the_tube_and_the_inside_view_looks_along_it(page):
    """Both on the line of the far wall that the eye looks at straight, from where the whole tube fits in."""
    page.get_by_label("Click two places").check(force=True)
    page.wait_for_timeout(1000)
    box = page.locator("canvas").first.bounding_box()
    for across in (0.4, 0.6):
        page.mouse.click(box["x"] + across * box["width"], box["y"] + 0.5 * box["height"])
        page.wait_for_timeout(3000)
    said = page.get_by_text("along the surface").inner_text()
    away = RADIUS + 1.08 * (LENGTH / 2) / 0.36
    true = 2 * 0.36 * 0.2 * box["width"] / box["height"] * (away + RADIUS)
    length = float(said.split(" mm")[0].split()[-1])
    print(f"true {true:.3f}, measured {length:.3f} mm")
    assert length == pytest.approx(true, rel=0.02)
    page.get_by_label("Click two places").uncheck(force=True)
    outside = seen(page)
    page.get_by_label("Look from inside").check(force=True)
    inside = seen(page)
    assert (np.abs(inside - outside).max(-1) > 20).mean() > 0.3
    page.get_by_role("button", name="Look from outside").click()
    assert (np.abs(seen(page) - outside).max(-1) > 20).mean() < 0.05

"""The scene of a report in a browser without a network: it turns, its layers change, its keyframes show their pictures.

Slow, and left out where Chromium or the packages that drive it are not installed:
apt-get install chromium; pip install playwright axe-playwright-python
"""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
from colons import colon, sequence, slam, truth

from densify.config import DensifyConfig
from densify.page import FILES, Gallery, densify_page
from densify.pipeline import densify

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-playwright-python")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

CHOSEN = np.array([255, 158, 26])  # the colour of the camera whose picture is shown

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    frames = colon(0).frames[:4]
    found = slam(frames, maps=1).map
    gallery = Gallery(found)
    results = densify(sequence(frames), found, truth, DensifyConfig(), gallery)
    results[0].dense.write(folder / "map_000")
    page = densify_page("Densified maps", results, gallery, ["Verdict: green."])
    page.files(folder, FILES)
    page.write(folder / "report.html")
    return folder / "report.html"


@pytest.fixture(scope="module")
def start():
    with playwright.sync_playwright() as driver:
        yield lambda *flags: driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *flags])


@pytest.fixture(scope="module")
def browser(start):
    started = start(*SOFTWARE)
    yield started
    started.close()


def opened(browser, report, width=1280, **settings):
    """The page, and what it complained of."""
    page, said = browser.new_page(viewport={"width": width, "height": 900}, offline=True, **settings), []
    page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(report.as_uri())
    page.wait_for_timeout(500)
    return page, said


def seen(page) -> bytes:
    page.wait_for_timeout(300)
    return page.locator(".scene canvas").screenshot()


def test_the_scene_turns_comes_nearer_and_changes_its_layers(browser, report):
    page, said = opened(browser, report)
    scene, box = page.locator(".scene"), page.locator(".scene canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    looks = [seen(page)]
    assert seen(page) == looks[0]

    def changed() -> bool:
        looks.append(seen(page))
        return looks[-1] not in looks[:-1]

    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 80, y + 30, steps=4)
    page.mouse.up()
    assert changed()
    page.mouse.wheel(0, -200)
    assert changed()
    for layer in ("Shape alone", "Confidence", "How well seen"):
        scene.get_by_role("radio", name=layer).check()
        assert changed()
    assert "seen well" in scene.locator(".scene-legend").inner_text()
    for part in ("Surface", "Cameras", "Points used"):
        scene.get_by_role("checkbox", name=part).focus()
        page.keyboard.press("Space")
        assert changed()
    page.locator(".scene canvas").focus()
    page.keyboard.press("ArrowLeft")
    assert changed()
    scene.get_by_role("slider").fill("1.5")
    scene.get_by_role("checkbox", name="Surface", exact=True).check()
    assert changed()
    scene.get_by_role("button", name="From outside").click()
    assert changed()
    assert said == [] and page.locator(".scene-still").is_hidden()


def test_a_click_on_a_camera_shows_its_picture_and_so_does_the_list_of_keyframes(browser, report):
    page, said = opened(browser, report)
    canvas, picture = page.locator(".scene canvas"), page.locator(".scene-picture")
    keyframe = page.locator(".scene").get_by_label("Keyframe")
    assert picture.is_hidden()
    keyframe.select_option(index=2)
    assert picture.locator("img").count() == 3 and "000001.png" in picture.inner_text()
    assert "predicted distance" in picture.inner_text() and "map points (white" in picture.inner_text()
    page.evaluate("document.querySelector('.scene-picture').style.visibility = 'hidden'")
    image = cv2.imdecode(np.frombuffer(seen(page), np.uint8), cv2.IMREAD_COLOR).astype(int)
    rows, columns = np.nonzero(np.abs(image - CHOSEN[::-1]).max(-1) < 12)
    keyframe.select_option(index=0)
    assert picture.is_hidden() and len(rows) > 20
    canvas.click(position={"x": float(np.median(columns)), "y": float(np.median(rows))})
    assert "000001.png" in picture.text_content() and keyframe.input_value() == "1"
    canvas.click(position={"x": 5, "y": 5})
    assert keyframe.input_value() == "1" and said == []


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_and_can_be_used_by_everyone(browser, report, width, scheme):
    page, said = opened(browser, report, width, color_scheme=scheme)
    across = page.evaluate("[document.documentElement.scrollWidth, window.innerWidth]")
    assert across[0] <= across[1] == width
    told = axe.Axe().run(page).response
    found = told["violations"]
    assert len(told["passes"]) > 10
    assert [(v["id"], v["impact"], len(v["nodes"])) for v in found if v["impact"] in ("serious", "critical")] == []
    assert said == []


def test_a_still_picture_stays_where_there_is_no_webgl_and_where_there_is_no_javascript(browser, start, report):
    page, _ = opened(browser, report, java_script_enabled=False)
    assert page.locator(".scene-still img").is_visible() and "Without JavaScript" in page.locator(".scene").inner_text()
    without = start("--disable-gpu", "--disable-3d-apis")
    page, said = opened(without, report)
    assert page.locator(".scene-still img").is_visible() and page.locator(".scene canvas").count() == 0
    assert "A still picture, because" in page.locator(".scene").inner_text() and said == []
    without.close()

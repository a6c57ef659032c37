"""The page of `predict` shows what was written, and no image where previews are not wanted."""

from __future__ import annotations

import re

import numpy as np
import pytest
from colons import colon
from pages import check_self_contained

from lightdepth.cli import main
from lightdepth.datasets.folder import write_folder
from lightdepth.prediction import read_prediction
from lightdepth.reporting.predicted import SHOWN, spread


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "muellerheinz"
    write_folder(colon(0).frames[:4], folder)
    return folder


@pytest.fixture(scope="module")
def run(data):
    out = data.parent / "out"
    assert main(["predict", str(data), "-o", str(out), "--checkpoint", "lightdepth-both"]) == 0
    return out


def test_a_page_shows_image_distance_uncertainty_albedo_and_normals_of_frames(run):
    page = check_self_contained(run / "report.html")
    text = (run / "report.html").read_text()
    assert (
        len(page.pictures) == 4 * 5
        and "4 of 4 frames predicted by lightdepth-both." in text
        and "muellerheinz" not in text
    )
    for label in ("image", "distance", "uncertainty", "albedo", "normals"):
        assert text.count(f"<figcaption>{label}</figcaption>") == 4
    prediction = read_prediction(run / "000000.npz")
    (row,) = re.findall(r'<tr><td class="text short">000000</td>(.*?)</tr>', text)
    _, low, middle, high, unsure = map(float, re.findall(r"<td>([\d.]+)</td>", row))
    known = prediction.distance[prediction.valid]
    np.testing.assert_allclose([low, middle, high], np.quantile(known, (0.1, 0.5, 0.9)), rtol=0.006)
    assert unsure == pytest.approx(100 * np.median(prediction.uncertainty[prediction.valid]), rel=0.006)


def test_a_page_has_no_image_where_previews_are_not_wanted(data, tmp_path):
    argv = ["predict", str(data), "-o", str(tmp_path / "out"), "--checkpoint", "constant", "--no-previews"]
    assert main(argv) == 0
    text = (tmp_path / "out" / "report.html").read_text()
    assert "<img" not in text and "none: --previews is false" in text


def test_the_frames_that_are_shown_are_spread_over_the_sequence():
    assert spread(0) == [] and spread(1) == [0] and spread(3) == [0, 1, 2]
    assert len(spread(100)) == SHOWN and spread(100)[0] == 0 and spread(100)[-1] == 99

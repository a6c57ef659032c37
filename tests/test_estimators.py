"""Estimators of one scale side by side: where each breaks, and where LMedS loses."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from pages import check_self_contained
from raising import refused

from densify.bench.estimators import (
    ESTIMATORS,
    EstimatorFigures,
    EstimatorsConfig,
    compared_estimators,
    consensus_scale,
    estimators_tables,
    losses,
    question,
)
from densify.commands.bench import bench


@pytest.fixture(scope="module")
def error() -> dict[tuple[str, float, str], float]:
    """Median error by kind, share and estimator, 100 points."""
    config = EstimatorsConfig(shares=(0.0, 0.3, 0.55), points=(100,), draws=25, seed=1)
    return {(r.kind, r.wrong_share, r.estimator): r.median_error for r in compared_estimators(config)}


def test_without_wrong_points_lmeds_loses_to_the_median_and_refinement_makes_good(error):
    for kind in ("uniform", "clustered", "depth"):
        assert error[kind, 0.0, "LMedS"] > error[kind, 0.0, "median ratio"]
        assert error[kind, 0.0, "LMedS + refinement"] < error[kind, 0.0, "LMedS"]


def test_at_thirty_percent_lmeds_holds_where_the_median_and_least_squares_do_not(error):
    for kind in ("clustered", "depth"):
        assert error[kind, 0.3, "LMedS"] < 0.03 < error[kind, 0.3, "median ratio"]
        assert error[kind, 0.3, "LMedS"] < 0.1 * error[kind, 0.3, "least squares"]


def test_more_than_half_wrong_breaks_lmeds_and_a_cluster_takes_it_all_the_way(error):
    assert error["clustered", 0.55, "LMedS"] == pytest.approx(0.6, abs=0.1)
    assert 0.1 < error["depth", 0.55, "LMedS"] < error["clustered", 0.55, "LMedS"]


def test_a_threshold_ten_times_off_costs_ransac_its_point(error):
    assert error["depth", 0.3, "RANSAC, true threshold"] < 0.02
    assert error["depth", 0.3, "RANSAC, ten times too wide"] > 3 * error["depth", 0.3, "RANSAC, true threshold"]


def test_every_proposal_is_tried():
    """Against the slow way: all proposals, all residuals."""
    rng = np.random.default_rng(0)
    b = rng.uniform(1, 9, 40)
    a = 0.3 * b * (1 + rng.normal(0, 0.03, 40))
    a[:18] = rng.uniform(0.1, 6, 18)
    inliers = np.abs(a[:, None] - b[:, None] * (a / b)) <= 0.1
    chosen = inliers[:, np.argmax(inliers.sum(0))]
    best = inliers[:, inliers.sum(0) == inliers.sum(0).max()]
    found = consensus_scale(a, b, 0.1)
    expected = [(a[c] * b[c]).sum() / (b[c] ** 2).sum() for c in (chosen, *best.T)]
    assert min(abs(found - e) for e in expected) < 1e-12


@pytest.mark.parametrize("kind", ["uniform", "clustered", "depth"])
def test_questions_have_the_share_of_wrong_points_that_they_say(kind):
    q = question(kind, 0.4, 500, np.random.default_rng(0))
    off = np.abs(np.log(q.observed.mapped / q.observed.predicted / q.scale))
    assert 0.3 < (off > 0.2).mean() < 0.42


def test_the_same_seed_gives_the_same_records_and_every_estimator_the_same_questions():
    config = EstimatorsConfig(shares=(0.2,), kinds=("depth",), points=(20,), draws=3)
    first, second = compared_estimators(config), compared_estimators(config)
    assert first == second and [r.estimator for r in first] == list(ESTIMATORS)
    assert compared_estimators(EstimatorsConfig((0.2,), ("depth",), (20,), 3, seed=1)) != first


def test_no_library_estimates_one_scale_by_magsac():
    """What NO_LIBRARY says; when this fails, MAGSAC belongs into the table."""
    points = np.random.default_rng(0).uniform(0, 1, (20, 2)).astype(np.float32)
    with pytest.raises(cv2.error):
        cv2.estimateAffinePartial2D(points, points, method=cv2.USAC_MAGSAC)
    if hasattr(cv2, "estimateTranslation2D"):
        with pytest.raises(cv2.error):
            cv2.estimateTranslation2D(points, points, method=cv2.USAC_MAGSAC)


def test_the_verb_writes_table_figure_and_sentences_on_where_lmeds_loses(tmp_path):
    arguments = ["--shares", "[0.0, 0.5]", "--points", "[20]", "--draws", "4"]
    assert bench(["estimators", "-o", str(tmp_path / "out"), *arguments]) == 0
    found = json.loads((tmp_path / "out" / "estimators.json").read_text())
    assert len(found["records"]) == 3 * 2 * len(ESTIMATORS) and "MAGSAC" in found["notes"][-1]
    text = (tmp_path / "out" / "estimators.md").read_text()
    assert all(name in text for name in ESTIMATORS) and "LMedS loses" in text
    assert (tmp_path / "out" / "estimators.png").read_bytes()[:4] == b"\x89PNG"
    page = (tmp_path / "out" / "report.html").read_text()
    assert check_self_contained(tmp_path / "out" / "report.html").tags.count("img") == 1 and "LMedS loses" in page


def test_losses_are_found_where_the_records_have_them():
    rows = [("median ratio", 0.01), ("least squares", 0.05), ("LMedS", 0.03)]
    records = [EstimatorFigures("uniform", 20, 0.0, n, e, e, 0.25, e) for n, e in rows]
    assert losses(records) == [
        "Wrong points uniform: LMedS loses to the median ratio or least squares at 0% of 20 (3.0 % against 1.0 % by "
        "median ratio)."
    ]
    table = estimators_tables(records)[0]
    assert table.rows[2] == ["LMedS", "3.0 / 3.0 (25% refused)"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shares": (1.2,)}, "below 1"),
        ({"points": (4,)}, "from 8 to"),
        ({"draws": 0}, "from 1 to"),
        ({"kinds": ("odd",)}, "expected some of uniform, clustered, depth"),
    ],
)
def test_what_cannot_be_drawn_is_refused(changes, message):
    with refused(cure=message):
        EstimatorsConfig(**changes)

"""Least Median of Squares for one scale: exact, and honest about what it survives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize_scalar

from lightdepth.robust import (
    CAUCHY,
    HUBER,
    TUKEY,
    LMedS,
    inlier_sigma,
    lmeds_scale,
    lower_quartile,
    mad_sigma,
    median_rank,
    refine_scale,
    robust_weights,
)


def distances(rng, n: int, outliers: float, noise: float, scale: float = 2.5) -> tuple[np.ndarray, np.ndarray]:
    """Mapped and predicted distances with a share of wrong points, spread over 5 to 300."""
    predicted = rng.uniform(15, 100, n)
    mapped = scale * predicted * np.exp(noise * rng.normal(size=n))
    wrong = rng.permutation(n)[: round(outliers * n)]
    mapped[wrong] = scale * rng.uniform(5, 300, len(wrong))
    return mapped, predicted


def slow_objective(mapped: np.ndarray, predicted: np.ndarray, proposal: int) -> float:
    """Lower median of |mapped - s predicted| over the points other than the proposer."""
    residuals = np.abs(mapped - mapped[proposal] / predicted[proposal] * predicted)
    return np.sort(np.delete(residuals, proposal))[(len(mapped) - 2) // 2]


def slow_lmeds(mapped: np.ndarray, predicted: np.ndarray) -> LMedS:
    objectives = [slow_objective(mapped, predicted, j) for j in range(len(mapped))]
    best = int(np.argmin(objectives))
    return LMedS(mapped[best] / predicted[best], objectives[best], best)


@pytest.mark.parametrize("chunk", range(10))
def test_objective_is_that_of_trying_every_proposal(chunk):
    for case in range(50):
        rng = np.random.default_rng([chunk, case])
        n = int(rng.integers(2, 201)) if case % 3 else int(rng.integers(2, 12))
        mapped, predicted = distances(rng, n, rng.uniform(0, 0.7), rng.choice([0.0, 0.01, 0.1]))
        if case % 5 == 0:  # duplicates, of points and of ratios
            twin = rng.integers(0, n, n // 2)
            mapped[: n // 2], predicted[: n // 2] = mapped[twin], predicted[twin]
        found, expected = lmeds_scale(mapped, predicted, rng), slow_lmeds(mapped, predicted)
        assert found.median == pytest.approx(expected.median, rel=1e-9, abs=1e-12), (chunk, case, n)
        assert found.scale == mapped[found.proposal] / predicted[found.proposal]
        assert slow_objective(mapped, predicted, found.proposal) == pytest.approx(found.median, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_the_smallest_cases_by_hand(n):
    mapped = np.arange(1.0, n + 1)
    found = lmeds_scale(mapped, np.ones(n))
    assert found.median == {2: 1, 3: 1, 4: 1, 5: 1, 6: 2}[n]
    assert found.median == slow_lmeds(mapped, np.ones(n)).median
    assert median_rank(n) == 1 + (n - 2) // 2


def test_result_is_the_same_without_a_generator_and_its_objective_with_any():
    mapped, predicted = distances(np.random.default_rng(0), 301, 0.3, 0.03)
    first = lmeds_scale(mapped, predicted)
    assert lmeds_scale(mapped, predicted) == first
    assert {lmeds_scale(mapped, predicted, np.random.default_rng(s)).median for s in range(20)} == {first.median}


def test_all_points_equal_are_solved_exactly():
    found = lmeds_scale(np.full(50, 3.0), np.full(50, 2.0))
    assert (found.scale, found.median) == (1.5, 0.0)


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e4])
def test_units_of_the_map_and_of_the_prediction_carry_through(factor):
    mapped, predicted = distances(np.random.default_rng(1), 200, 0.3, 0.03)
    reference = lmeds_scale(mapped, predicted)
    in_map = lmeds_scale(mapped * factor, predicted)
    assert (in_map.scale, in_map.median) == pytest.approx((reference.scale * factor, reference.median * factor))
    assert lmeds_scale(mapped, predicted * factor).scale == pytest.approx(reference.scale / factor)


def scale_errors(outliers: float, clustered: bool, trials: int = 20) -> np.ndarray:
    errors = []
    for trial in range(trials):
        rng = np.random.default_rng([trial, 5])
        mapped, predicted = distances(rng, 400, 0 if clustered else outliers, 0.03)
        if clustered:  # a wrong surface, twice as far
            wrong = slice(round(outliers * 400))
            mapped[wrong] *= rng.normal(2, 0.05, round(outliers * 400))
        found = lmeds_scale(mapped, predicted)
        errors.append(refine_scale(mapped, predicted, found.scale, inlier_sigma(found.median, 400)) / 2.5 - 1)
    return np.abs(errors)


@pytest.mark.parametrize("clustered", [False, True], ids=["uniform", "clustered"])
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.45])
def test_scale_survives_45_percent_wrong_points(outliers, clustered):
    errors = scale_errors(outliers, clustered)
    assert np.median(errors) < 0.005
    assert errors.max() < 0.015


def test_scale_breaks_when_half_of_the_points_agree_on_another():
    assert np.median(scale_errors(0.55, clustered=True)) > 0.5


@pytest.mark.parametrize(
    ("mapped", "predicted"),
    [([1.0], [1.0]), ([1.0, 2.0], [1.0]), ([1.0, 0.0], [1.0, 1.0]), ([1.0, 2.0], [1.0, -1.0])],
)
def test_fewer_than_two_points_or_distances_that_are_none_are_our_own_mistake(mapped, predicted):
    with pytest.raises(AssertionError):
        lmeds_scale(np.array(mapped), np.array(predicted))


def geman_mcclure(scale: float, mapped, predicted, sigma: float) -> float:
    squared = ((mapped - scale * predicted) / sigma) ** 2
    return float((squared / (1 + squared)).sum())


@pytest.mark.parametrize("outliers", [0.0, 0.2, 0.45])
@pytest.mark.parametrize("seed", range(5))
def test_refinement_reaches_the_minimum_of_its_objective(outliers, seed):
    mapped, predicted = distances(np.random.default_rng([seed, 9]), 300, outliers, 0.03)
    start = lmeds_scale(mapped, predicted)
    sigma = inlier_sigma(start.median, 300)
    found = refine_scale(mapped, predicted, start.scale, sigma, iterations=200)
    near = (0.95 * start.scale, 1.05 * start.scale)
    scalar = minimize_scalar(
        geman_mcclure, near, near, args=(mapped, predicted, sigma), method="bounded", options={"xatol": 1e-12}
    )

    def loss(z: np.ndarray) -> np.ndarray:  # scipy's form: rho(z) and two derivatives, z the squared residual
        return np.stack([z / (1 + z), 1 / (1 + z) ** 2, -2 / (1 + z) ** 3])

    robust = least_squares(lambda s: (mapped - s * predicted) / sigma, start.scale, loss=loss, xtol=1e-14, ftol=1e-14)
    assert found == pytest.approx(scalar.x, rel=1e-6)
    assert found == pytest.approx(robust.x[0], rel=1e-6)
    assert geman_mcclure(found, mapped, predicted, sigma) <= geman_mcclure(start.scale, mapped, predicted, sigma)


def tukey(z: np.ndarray) -> np.ndarray:
    """scipy's form: rho(z) and two derivatives, z the squared residual over the squared constant."""
    inside = np.clip(1 - z, 0, None)
    return np.stack([(1 - inside**3) / 3, inside**2, -2 * inside])


@pytest.mark.parametrize(
    ("loss", "scipys", "constant"), [("huber", "huber", HUBER), ("cauchy", "cauchy", CAUCHY), ("tukey", tukey, TUKEY)]
)
@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_every_loss_is_refined_to_the_minimum_that_scipy_finds(loss, scipys, constant, outliers):
    mapped, predicted = distances(np.random.default_rng(11), 300, outliers, 0.03)
    start = lmeds_scale(mapped, predicted)
    sigma = inlier_sigma(start.median, 300)
    found = refine_scale(mapped, predicted, start.scale, sigma, iterations=300, loss=loss)
    oracle = least_squares(
        lambda s: (mapped - s * predicted) / sigma, start.scale, loss=scipys, f_scale=constant, xtol=1e-14, ftol=1e-14
    )
    assert found == pytest.approx(oracle.x[0], rel=1e-6)
    assert refine_scale(mapped, predicted, start.scale, sigma, loss="geman_mcclure") != found


def test_weights_are_one_at_zero_and_fall_and_another_loss_is_refused():
    x = np.array([0.0, 1.0, 3.0, 10.0])
    for loss in ("geman_mcclure", "huber", "cauchy", "tukey"):
        w = robust_weights(x, loss)
        assert w[0] == 1 and (np.diff(w) <= 0).all() and w[-1] < 0.2
    with pytest.raises(ValueError, match="loss 'l1'; expected geman_mcclure"):
        robust_weights(x, "l1")


def test_tukey_that_reaches_no_point_leaves_the_scale():
    assert refine_scale(np.full(9, 50.0), np.ones(9), 2.0, 0.1, loss="tukey") == 2.0


def test_twenty_iterations_of_refinement_are_enough():
    mapped, predicted = distances(np.random.default_rng(2), 300, 0.3, 0.03)
    start = lmeds_scale(mapped, predicted)
    sigma = inlier_sigma(start.median, 300)
    far = refine_scale(mapped, predicted, start.scale, sigma, iterations=500)
    assert refine_scale(mapped, predicted, start.scale, sigma) == pytest.approx(far, rel=1e-6)


def test_refinement_of_perfect_points_keeps_the_scale():
    predicted = np.linspace(1, 9, 30)
    assert refine_scale(2.5 * predicted, predicted, 2.5, 0.0) == pytest.approx(2.5, rel=1e-12)
    with_wrong = np.append(2.5 * predicted, 100.0)
    assert refine_scale(with_wrong, np.append(predicted, 1.0), 2.5, 0.0) == pytest.approx(2.5, rel=1e-12)


def test_sigma_of_gaussian_residuals_is_their_standard_deviation():
    residuals = np.random.default_rng(0).normal(0, 0.7, 200_000)
    assert inlier_sigma(float(np.median(np.abs(residuals))), len(residuals)) == pytest.approx(0.7, rel=0.01)


def test_the_deviation_of_residuals_is_found_where_a_third_of_them_are_wrong_and_not_below_the_least():
    residuals = np.random.default_rng(1).normal(0, 0.7, 100_000)
    assert mad_sigma(residuals) == inlier_sigma(float(np.median(np.abs(residuals))), len(residuals))
    assert mad_sigma(residuals) == pytest.approx(0.7, rel=0.01)
    residuals[:33_000] = 100
    assert mad_sigma(residuals) < 2 * 0.7
    assert mad_sigma(np.zeros(5), least=0.02) == 0.02


def test_the_finite_sample_factor_is_rousseeuws_and_off_by_default():
    assert inlier_sigma(2.0, 11) == pytest.approx(2 * 1.4826)
    assert inlier_sigma(2.0, 11, finite_sample=True) == pytest.approx(2 * 1.4826 * 1.5)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 101, 500])
def test_the_lower_quartile_is_numpys(n):
    values = np.random.default_rng(n).standard_normal(n)
    assert lower_quartile(values) == pytest.approx(np.quantile(values, 0.25), rel=1e-12)

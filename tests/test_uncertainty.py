"""Measures of predicted uncertainty, on errors whose deviation is known."""

import cv2
import numpy as np
import pytest

from lightdepth.uncertainty import (
    LEVELS,
    Calibration,
    Doubted,
    chart_png,
    coverage,
    doubted,
    fit_calibration,
    sparsification,
    summary,
)


def frames(count: int = 6, pixels: int = 4000, spread: float = 0.8, seed: int = 0) -> list[Doubted]:
    """Normal errors whose deviation varies from pixel to pixel, and is known."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        sigma = 0.1 * np.exp(spread * rng.normal(size=pixels))
        made.append(Doubted(sigma * rng.normal(size=pixels), sigma))
    return made


def changed(given: list[Doubted], change) -> list[Doubted]:
    return [Doubted(frame.error, change(frame.sigma)) for frame in given]


def test_the_known_deviation_covers_what_it_states():
    assert np.allclose(coverage(frames()), LEVELS, atol=0.01)
    assert (coverage(changed(frames(), lambda s: 0.5 * s)) < np.asarray(LEVELS) - 0.1).all()


def test_knowing_each_error_leaves_no_sparsification_error_and_knowing_nothing_leaves_all():
    known = [Doubted(f.error, np.abs(f.error) + 1e-9) for f in frames()]
    assert sparsification(known).area < 1e-6 and sparsification(known).relative < 1e-6
    rng = np.random.default_rng(1)
    guessed = changed(frames(), lambda s: rng.permutation(s))
    assert sparsification(guessed).relative == pytest.approx(1.0, abs=0.05)
    backwards = changed(frames(), lambda s: 1 / s)
    assert sparsification(backwards).relative > 1.2


def test_a_deviation_that_varies_more_says_more():
    relative = [sparsification(frames(spread=spread)).relative for spread in (0.2, 0.6, 1.2)]
    assert relative[0] > relative[1] > relative[2]


def test_sparsification_agrees_with_dropping_pixels_one_by_one():
    frame = frames(1, 40)[0]
    curves, squared = sparsification([frame]), sparsification([frame], 2)
    order = np.argsort(-frame.sigma)
    for share, found, rms, best in zip(curves.dropped, curves.predicted, squared.predicted, curves.best, strict=True):
        gone = int(40 * share)
        assert found == pytest.approx(np.abs(frame.error[order[gone:]]).mean())
        assert rms == pytest.approx(np.sqrt(np.square(frame.error[order[gone:]]).mean()))
        assert best == pytest.approx(np.sort(np.abs(frame.error))[: 40 - gone].mean())
    assert np.allclose(curves.random, np.abs(frame.error).mean())


@pytest.mark.parametrize(("exponent", "scale"), [(1.0, 3.0), (2.0, 0.5), (0.5, 1.0)])
def test_calibration_undoes_a_wrong_scale_and_exponent_on_frames_it_has_not_seen(exponent, scale):
    def distorted(sigma):
        return (sigma / scale) ** (1 / exponent)

    fitted = fit_calibration(changed(frames(seed=1), distorted))
    assert fitted.exponent == pytest.approx(exponent, rel=0.05) and fitted.scale == pytest.approx(scale, rel=0.15)
    others = changed(changed(frames(seed=2), distorted), fitted)
    assert np.allclose(coverage(others), LEVELS, atol=0.02)


def test_calibration_does_not_touch_the_order():
    given = frames()
    assert sparsification(changed(given, Calibration(1.7, 0.2))).relative == pytest.approx(
        sparsification(given).relative
    )


def test_the_scale_of_the_frame_is_no_error():
    rng = np.random.default_rng(0)
    truth = rng.uniform(5, 50, (8, 10)).astype(np.float32)
    valid = truth > 6
    sigma = np.full_like(truth, 0.1)
    frame = doubted(3 * truth, sigma, truth, valid)
    assert frame is not None and np.abs(frame.error).max() < 1e-6 and len(frame.error) == valid.sum()
    assert doubted(truth, sigma, np.zeros_like(truth), valid) is None


def test_without_truth_nothing_is_measured():
    for measure in (sparsification, fit_calibration):
        with pytest.raises(ValueError, match="no frame"):
            measure([])


def test_the_chart_is_a_picture_and_the_summary_has_its_numbers():
    given = frames(2)
    picture = cv2.imdecode(np.frombuffer(chart_png(given), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[0] > 200 and picture.std() > 5
    found = summary(given)
    assert found["frames"] == 2 and list(found["coverage"]) == ["50%", "68%", "90%", "95%"]
    assert found["sparsification"]["mean"] == pytest.approx(sparsification(given).relative, abs=1e-3)
    assert found["sparsification"]["rms"] == pytest.approx(sparsification(given, 2).relative, abs=1e-3)


def test_errors_of_distance_carry_the_truth_s_unit_and_sigma_s_share_of_it():
    true = np.array([[1.0, 2.0, 4.0, 8.0, 10.0]])
    found = 3 * true * np.array([[1.0, 1.0, 1.0, 1.25, 0.9]])  # a scale of 3, which the median takes out
    frame = doubted(found, np.full((1, 5), 0.1), true, true > 0, log=False)
    np.testing.assert_allclose(frame.error, [0, 0, 0, 2.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(frame.sigma, [0.1, 0.2, 0.4, 1.0, 0.9])

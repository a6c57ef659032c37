"""The report of a light fit: brightness against distance, residuals, parameters, errors on what was withheld."""

from __future__ import annotations

import numpy as np

from lightdepth.light.fit_on_map import LightFit
from lightdepth.photometry import DEFAULT_GAMMA, DEFAULT_MU
from lightdepth.reporting.figures import chart, chart_png
from lightdepth.reporting.report import Report


def light_page(fit: LightFit, what: str) -> Report:
    """The whole page; `what` says what it was fitted to."""
    page = Report("Light of the endoscope")
    page.text(f"{what}. {fit.summary()[0].upper()}{fit.summary()[1:]}.")
    page.heading("Decline of the light")
    on_map = fit.cosine_exponent is None
    page.wide_figures(
        [
            (
                _decline_chart(fit, on_map),
                f"Brightness against distance; the line falls as distance^-{_slope(fit):.2f}",
            ),
            (_residual_chart(fit), "What is left of log distance; wrong points lie in the tails"),
        ]
    )
    page.heading("Parameters")
    u = fit.uncertainty
    rows = [
        ["gamma", fit.fitted.gamma, u["gamma"], DEFAULT_GAMMA],
        ["mu", fit.fitted.mu, u["mu"], DEFAULT_MU],
    ]
    if fit.cosine_exponent is not None:
        rows.append(["cosine exponent", fit.cosine_exponent, u.get("cosine_exponent"), 1.0])
        rows.append(["wall reflectance", fit.fitted.reflectance, None, 0.0])
    page.table(["", "fitted", "standard deviation", "default"], rows)
    page.text("Standard deviations come from a bootstrap over keyframes; they do not contain errors of the model.")
    if on_map:
        page.text(
            "A map has no normals: this is the light with which the closed form errs least if all wall faces the "
            "camera. In a tube that makes gamma smaller than the endoscope's; light from wall to wall makes it larger."
        )
    fitted_to = f"Fitted to {fit.points} points of {fit.keyframes[0]} keyframes, judged"
    if on_map:
        page.heading("Hidden points")
        page.text(
            f"{fitted_to} by points of {fit.keyframes[1]} of them, in blocks of wall that were hidden from the fit."
        )
    else:
        page.heading("Withheld frames")
        page.text(f"{fitted_to} on {fit.keyframes[1]} others.")
    labels = {"constant": "constant", "default": "default light", "fitted": "fitted light"}
    page.table(["", fit.measure], [[labels[name], error] for name, error in fit.errors.items()])
    if fit.candidates:
        page.heading("Models tried")
        page.table(
            ["", "withheld residual", "gamma", "mu", "cosine exponent"],
            [[name, error, light.gamma, light.mu, q] for name, error, light, q in fit.candidates],
        )
    return page


def _slope(fit: LightFit) -> float:
    return 2 / fit.fitted.gamma


def _decline_chart(fit: LightFit, on_map: bool) -> bytes:
    figure, axes = chart((6.4, 3.6))
    shown = fit.shown[:: max(1, len(fit.shown) // 4000)]
    log_a, log_v = shown[:, 0], shown[:, 1]
    reach = np.quantile(log_a, (0.01, 0.99))
    axes.loglog(np.exp(log_a), np.exp(log_v), ".", markersize=2, alpha=0.3, color="#2a6f97")
    axes.loglog(np.exp(reach), np.exp(-_slope(fit) * reach), color="#c1121f", label=f"slope -{_slope(fit):.2f}")
    axes.set_xlabel("distance over the keyframe's median" if on_map else "distance [mm]")
    axes.set_ylabel("brightness, freed of all else")
    low, high = np.quantile(log_v, (0.005, 0.995))
    axes.set_xlim(*np.exp(np.quantile(log_a, (0.002, 0.998)) + (-0.1, 0.1)))
    axes.set_ylim(np.exp(low - 0.3), np.exp(high + 0.3))
    axes.legend(frameon=False)
    return chart_png(figure)


def _residual_chart(fit: LightFit) -> bytes:
    figure, axes = chart((6.4, 2.4))
    axes.hist(np.clip(fit.shown[:, 2], -1.5, 1.5), 121, color="#2a6f97")
    axes.set_xlabel("residual of log distance (clipped at 1.5)")
    axes.set_ylabel("points")
    return chart_png(figure)

"""The page of a training: how good the exported network is, and what it says of frames that it was not trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from lightdepth.frame import FrameBatch
from lightdepth.losses import LossConfig, render_image
from lightdepth.network import DepthNetwork
from lightdepth.reporting.figures import Chart, chart_png, jpeg
from lightdepth.reporting.report import Report, Tile

from .board import Seen, decline, panels_of
from .card import chosen_said

SHOWN = 6
"""The most frames that are shown."""
FILES = {
    "model.safetensors": "the network: --checkpoint takes it",
    "model.md": "its card: what it learned from, with which settings, and how well it does",
    "checkpoints/*.ckpt": "to go on from with --resume",
}
"""What the files of a run are, by pattern."""
_MEASURES = {
    "abs_rel_median": "AbsRel",
    "rmse_mm_median": "RMSE [mm]",
    "medae_mm_median": "median error [mm]",
    "delta1_median": "share within 1.25",
}


def training_page(said: Sequence[str], errors: Mapping[str, float], chosen_by: str = "") -> Report:
    """The verdict and the figures; `said` are sentences on what was learned from, `errors` by name, those of the closed
    form after `closed_form/`; `chosen_by` is the measure by which the frames of the verdict chose the checkpoint."""
    page = Report("Training")
    page.text(verdict(errors, chosen_by))
    for sentence in said:
        page.text(sentence)
    if "abs_rel_median" in errors:
        page.heading("On the validation frames, against their truth")
        rows: list[list[Any]] = [
            [who, *(errors.get(f"{prefix}{key}") for key in _MEASURES)]
            for prefix, who in (("", "network"), ("closed_form/", "closed form"))
        ]
        page.table(["depth, median-aligned per frame", *_MEASURES.values()], rows)
    return page


def verdict(errors: Mapping[str, float], chosen_by: str = "") -> str:
    """Whether the network is better than the formula that needs no training, in a sentence, and what that is worth."""
    return " ".join(filter(None, [_compared(errors), chosen_said(chosen_by) if chosen_by else ""]))


def _compared(errors: Mapping[str, float]) -> str:
    if "abs_rel_median" not in errors:
        loss = errors.get("loss", float("nan"))
        return f"The validation frames have no truth: their loss, {loss:.4g}, says little of how good depth is."
    ours, formula = errors["abs_rel_median"], errors["closed_form/abs_rel_median"]
    what = "better than" if ours < formula else "no better than"
    return f"The network is {what} the closed form, which needs no training: AbsRel {ours:.3g} against {formula:.3g}."


@torch.no_grad()
def show_frames(page: Report, network: DepthNetwork, batch: FrameBatch, loss: LossConfig, doubt: bytes | None) -> None:
    """Frames of a validation batch with what the network says of them, the decline of light on them, and the picture
    (PNG) of its calibrated uncertainty, where it has one."""
    distance, albedo_hs, _ = network.estimate(batch.image, batch.mask, batch.rays, batch.light)
    seen, rendered = Seen.of(distance.float(), batch), render_image(distance, albedo_hs, batch, loss)
    count = min(SHOWN, len(batch.image))
    page.heading("Frames that it was not trained on")
    page.text(
        "Distance: light near, dark far, from half to three times a frame's median. What is off: red too far, blue too "
        "near. Rendered: the image that the network's distance and albedo make under the light."
    )
    for i in range(count):
        panels = panels_of(batch, rendered, seen, i)
        names = ["image", *list(panels)[1:]]
        tiles = [Tile(jpeg(panel), name) for name, panel in zip(names, panels.values(), strict=True)]
        page.tiles(tiles, f"Frame {i + 1}", 150)
    page.wide_figures([(chart_png(decline(batch, seen, count)), "Brightness of these frames over distance")])
    if doubt is not None:
        said = "How far the stated uncertainty can be trusted, on the frames that it was calibrated on"
        page.wide_figures([(Chart(doubt), said)])

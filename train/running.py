"""What training anew and adapting share: a quiet Lightning, how often to report, the card as a page."""

from __future__ import annotations

import json
import logging
import math
import warnings
from typing import Any

import torch


def card_text(card: dict[str, Any], name: str) -> str:
    """The card as a page to read."""
    errors = card["errors"]
    lines = [f"# {name}", "", card["trained_on"], ""]
    lines += [f"- {key}: {card[key]}" for key in ("steps", "seed", "checkpoint", "rows", "version") if key in card]
    lines += [f"- network: `{json.dumps(card['network'])}`", f"- loss: `{json.dumps(card['loss'])}`", ""]
    if "abs_rel_median" in errors:
        lines += ["On the validation frames, depth median-aligned per frame:", ""]
        lines += ["| | AbsRel | RMSE mm | MedAE mm | share within 1.25 |", "|---|---|---|---|---|"]
        for prefix, who in (("", "network"), ("closed_form/", "closed form")):
            values = [errors[f"{prefix}{key}_median"] for key in ("abs_rel", "rmse_mm", "medae_mm", "delta1")]
            lines.append(f"| {who} | " + " | ".join(f"{value:.3f}" for value in values) + " |")
    else:
        lines.append(f"Validation loss (no truth): {errors.get('loss', math.nan):.4f}")
    doubt = card.get("uncertainty")
    if doubt:
        mean, rms = (doubt["sparsification"][name] for name in ("mean", "rms"))
        shares = ", ".join(f"{level}: {share:.1%}" for level, share in doubt["coverage"].items())
        lines += [
            "",
            f"Uncertainty, calibrated on those frames: sparsification error {mean:.2f} (mean error), {rms:.2f} (RMS) "
            f"of a random order's; share of pixels inside the intervals of {shares}.",
        ]
    return "\n".join(lines) + "\n"


def report_every(steps: int) -> int:
    return 50 if steps <= 0 else max(1, min(100, steps // 10))


def quiet() -> None:
    """Lightning's tips and hardware lists do not belong in a log; its warnings that matter stay."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", ".*does not have many workers.*")
    warnings.filterwarnings("ignore", ".*number of training batches.*")
    warnings.filterwarnings("ignore", ".*exists and is not empty.*")
    warnings.filterwarnings("ignore", ".*isn't supported for scheduler.*")
    warnings.filterwarnings("ignore", ".*dirpath has changed.*")
    warnings.filterwarnings("ignore", ".*LeafSpec.*")
    warnings.filterwarnings("ignore", ".*mid-epoch.*|.*ended.*epoch.*")
    warnings.filterwarnings("ignore", ".*in eval mode at the start of training.*")  # what is frozen is so on purpose
    torch.set_float32_matmul_precision("high")

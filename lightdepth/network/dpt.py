"""DPT: a DINOv2 vision transformer with the neck and head of a dense prediction transformer, from `transformers`.

The architecture is Depth Anything's (Yang et al., CVPR 2024; Ranftl et al., ICCV 2021) and is built from a
configuration: nothing is ever downloaded. Its published weights, or DINOv2's alone, can be read from a local file
(lightdepth.network.pretrained). Needs the extra `lightdepth[dpt]`.
"""

from __future__ import annotations

from typing import Any

import torch.nn.functional as F
from torch import Tensor, nn

from lightdepth.errors import InputError

ENCODERS: dict[str, dict[str, Any]] = {
    "vitt14": {"hidden": 192, "layers": 12, "heads": 3, "neck": (24, 48, 96, 192), "fusion": 32},
    "vits14": {"hidden": 384, "layers": 12, "heads": 6, "neck": (48, 96, 192, 384), "fusion": 64},
    "vitb14": {"hidden": 768, "layers": 12, "heads": 12, "neck": (96, 192, 384, 768), "fusion": 128},
    "vitl14": {"hidden": 1024, "layers": 24, "heads": 16, "neck": (256, 512, 1024, 1024), "fusion": 256},
}
"""Depth Anything's small, base and large; vitt14 is ours, for tests and CPUs: nobody published weights for it."""

STEM = "backbone.embeddings.patch_embeddings.projection.weight"
"""The weights that see the image."""

_PATCH, _POSITIONS = 14, 518  # the image size at which DINOv2's positions were learnt; other sizes interpolate them
_TAPS = {12: (3, 6, 9, 12), 24: (5, 12, 18, 24)}


class DPT(nn.Module):
    """(B, inputs, H, W) -> features (B, channels, H, W) for `head`, H and W multiples of `multiple`.

    6 M parameters with vitt14, 25 M with vits14, 97 M with vitb14, 335 M with vitl14.
    """

    multiple = _PATCH

    def __init__(self, inputs: int, outputs: int, encoder: str = "vits14") -> None:
        super().__init__()
        try:
            from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config
        except ImportError as error:
            raise InputError(
                "network kind 'dpt'", f"it needs transformers ({error})", "install it: pip install 'lightdepth[dpt]'"
            ) from error
        size = ENCODERS[encoder]
        backbone = Dinov2Config(
            num_channels=inputs,
            hidden_size=size["hidden"],
            num_hidden_layers=size["layers"],
            num_attention_heads=size["heads"],
            image_size=_POSITIONS,
            patch_size=_PATCH,
            out_features=[f"stage{i}" for i in _TAPS[size["layers"]]],  # type: ignore[call-arg]  # known to its base
            reshape_hidden_states=False,
            apply_layernorm=True,
            use_mask_token=False,
        )
        config = DepthAnythingConfig(
            backbone_config=backbone,
            reassemble_hidden_size=size["hidden"],
            neck_hidden_sizes=list(size["neck"]),
            fusion_hidden_size=size["fusion"],
        )
        whole = DepthAnythingForDepthEstimation(config)
        self.backbone, self.neck = whole.backbone, whole.neck
        # Of the head's three convolutions the last, which makes one depth channel, gives way to `head`.
        self.conv1, self.conv2 = whole.head.conv1, whole.head.conv2
        self._last = whole.head.head_in_index
        self.channels = self.conv2.out_channels
        self.head = nn.Conv2d(self.channels, outputs, 1)
        # The neck ends in a branch that nothing below it feeds, and DDP waits for every gradient.
        for name, parameter in self.neck.named_parameters():
            if name.startswith("fusion_stage.layers.0.residual_layer1"):
                parameter.requires_grad_(False)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        maps = self.backbone(x).feature_maps
        fused = self.neck(maps, height // _PATCH, width // _PATCH)[self._last]
        x = F.interpolate(self.conv1(fused), size=(height, width), mode="bilinear", align_corners=True)
        return F.relu(self.conv2(x))

"""TensorBoard's files of a training run, read back: curves, charts, panels, the decline of light, settings."""

from __future__ import annotations

import re
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from training import TINY_RUN, batch_of

from lightdepth.decline import log_closed_form
from lightdepth.losses import LossConfig, render_image
from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig
from train.board import Seen, decline, row_of
from train.commands.train import train


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "a run"
    assert train(["-o", str(folder), *TINY_RUN, "--trainer.max_steps", "20", "--trainer.log_every_n_steps", "5"]) == 0
    return folder


@pytest.fixture(scope="module")
def board(run) -> EventAccumulator:
    return EventAccumulator(str(run / "tensorboard"), size_guidance={"images": 0, "scalars": 0, "tensors": 0}).Reload()


def picture(board: EventAccumulator, tag: str) -> np.ndarray:
    data = board.Images(tag)[-1].encoded_image_string
    return cv2.imdecode(np.frombuffer(BytesIO(data).read(), np.uint8), cv2.IMREAD_COLOR)


def test_every_chart_has_curves_and_errors_stand_beside_the_closed_form_s(board):
    (content,) = board.PluginTagToContent("custom_scalars").keys()
    layout = Layout.FromString(board.Tensors(content)[0].tensor_proto.string_val[0])
    charts = {chart.title: list(chart.multiline.tag) for category in layout.category for chart in category.chart}
    tags = board.Tags()["scalars"]
    found = {title: {t for t in tags for p in patterns if re.match(p, t)} for title, patterns in charts.items()}
    assert found["abs_rel"] == {"val/abs_rel_median", "val/closed_form/abs_rel_median"}
    assert {"train/loss", "train/photometric", "train/smoothness"} <= found["training"]
    assert {"val/loss", "val/photometric", "val/inconsistency"} <= found["validation"]
    assert not any("median" in tag for tag in found["validation"]) and "train/frames_per_s" not in found["training"]
    assert all(found.values())


def test_images_per_second_are_a_curve(board):
    assert all(event.value > 0 for event in board.Scalars("train/frames_per_s"))


def test_the_same_frames_are_shown_at_every_validation_with_labels_over_their_panels(board):
    steps = [event.step for event in board.Images("val/images")]
    assert steps == [10, 20] == [event.step for event in board.Images("val/decline")]
    shown = picture(board, "val/images")
    assert shown.shape == (4 * (18 + 2 * 32), 6 * 2 * 40, 3)  # four frames of six panels
    strip = shown[:18].mean(-1)
    assert all((strip[:, 80 * i : 80 * (i + 1)] < 128).sum() > 20 for i in range(6)) and np.median(strip) > 250


def test_the_settings_are_kept_to_compare_runs_by_and_name_no_file(board, run):
    contents = board.PluginTagToContent("hparams")
    start = HParamsPluginData.FromString(contents["_hparams_/session_start_info"]).session_start_info
    settings = {name: value.WhichOneof("kind") for name, value in start.hparams.items()}
    assert {"learning_rate", "batch_size", "max_steps", "network", "loss.photometric", "train_frames"} <= set(settings)
    assert str(run.parent) not in str(start)


def test_the_command_that_shows_them_is_said_when_the_run_begins_and_when_it_ends(run):
    lines = (run / "log.txt").read_text().splitlines()
    said = [i for i, line in enumerate(lines) if line.startswith("curves: tensorboard --logdir ")]
    first_step = next(i for i, line in enumerate(lines) if line.startswith("step "))
    assert len(said) == 2 and said[0] < first_step and said[1] > len(lines) - 4
    assert "tensorboard'" in lines[said[1]]  # the name has a blank in it


def test_without_tensorboard_no_command_is_named(tmp_path):
    assert train(["-o", str(tmp_path / "run"), *TINY_RUN, "--trainer.max_steps", "2", "--trainer.logger", "csv"]) == 0
    assert "tensorboard" not in (tmp_path / "run" / "log.txt").read_text()


def estimated(batch):
    torch.manual_seed(0)
    module = LightDepth(NetworkConfig(width=4), LossConfig(reflectance=0.0), rows=32)
    with torch.no_grad():
        distance, albedo = module(batch)
        return distance, render_image(distance, albedo, batch, module.loss_config)


def test_what_is_as_far_as_the_truth_is_white_and_twice_as_far_is_red():
    batch = batch_of()
    _, rendered = estimated(batch)
    exact = row_of(batch, rendered, Seen.of(3.0 * batch.true_distance.clamp(min=1e-3), batch), 0)
    residual = exact[18:, -80:][(exact[18:, -80:] > 0).any(-1)]
    assert (residual >= 254).all()
    far = batch.true_distance.clone()
    far[..., :20] *= 2
    off = row_of(batch, rendered, Seen.of(far.clamp(min=1e-3), batch), 0)[18:, -80:]
    left, right = off[:, :36].reshape(-1, 3), off[:, 44:].reshape(-1, 3)
    reds = [(side[:, 0].astype(int) - side[:, 2])[side.any(1)].mean() for side in (left, right)]
    assert reds[0] > reds[1] + 60


def test_a_frame_without_truth_is_held_against_the_closed_form_and_says_so():
    batch = batch_of()._replace(true_valid=torch.zeros_like(batch_of().true_valid))
    closed = log_closed_form(batch.image, batch.mask, batch.rays, batch.light).exp()
    seen = Seen.of(5.0 * closed, batch)
    assert seen.has_truth == [False, False] and float(seen.residual.abs().max()) < 1e-5
    assert decline(batch, seen, 2).axes[0].get_legend_handles_labels()[1] == ["predicted distance", "inverse square"]


def test_a_batch_in_which_nothing_is_seen_has_panels_and_a_plot_all_the_same():
    batch = batch_of()
    nothing = torch.zeros_like(batch.mask)
    batch = batch._replace(mask=nothing, true_valid=nothing, image=torch.zeros_like(batch.image))
    distance, rendered = estimated(batch)
    seen = Seen.of(distance, batch)
    assert row_of(batch, rendered, seen, 1).shape == (82, 480, 3)
    assert decline(batch, seen, 2).axes[0].get_legend_handles_labels()[1] == ["inverse square"]

"""Images a second of a training, beside those without waiting for frames, and what is done in every step."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from scenes import C3VD, cylinder
from torch.utils.data import Dataset
from training import LIGHT, batch_of

import train.callbacks as callbacks
import train.loader as loading
from lightdepth.decline import informative, log_closed_form, most_spread
from lightdepth.frame import FrameBatch
from lightdepth.losses.masked import masked_std
from lightdepth.module import LightDepth
from lightdepth.network import NetworkConfig
from train.callbacks import Diagnosis, DiagnosisConfig, TrainingProgress


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_loader_counts_the_seconds_for_which_it_is_waited_for_and_no_others(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(loading, "time", SimpleNamespace(perf_counter=clock))

    class Slow(Dataset[FrameBatch]):
        def __len__(self) -> int:
            return 6

        def __getitem__(self, index: int) -> FrameBatch:
            clock.now += 1.0
            return batch_of(1)

    waited = loading.Waited()
    for _ in loading.loader(Slow(), 2, 0, lambda error: None, waited=waited):
        clock.now += 10.0
    assert waited.seconds == 6.0


def test_images_a_second_leave_validation_aside_and_stand_beside_those_without_waiting(monkeypatch):
    clock, waited, lines, logged = Clock(), [5.0], list[str](), list[dict[str, float]]()
    monkeypatch.setattr(callbacks, "time", SimpleNamespace(monotonic=clock))
    progress = TrainingProgress(lines.append, 10, lambda: waited[0])
    logger = SimpleNamespace(log_metrics=lambda metrics, step: logged.append(metrics))
    trainer = SimpleNamespace(global_step=0, estimated_stepping_batches=100, accumulate_grad_batches=2, world_size=2)
    trainer.logger, trainer.callback_metrics, trainer.sanity_checking = logger, {}, True
    trainer.training, trainer.callbacks = True, [progress]
    progress.on_validation_start(trainer, None)
    progress.on_validation_end(trainer, None)
    trainer.sanity_checking = False
    progress.on_train_start(trainer, None)
    assert callbacks.speed_of(trainer) is None
    for step in range(1, 11):  # a second each, a quarter of which waits for 2 * 2 * 3 frames
        trainer.global_step, clock.now, waited[0] = step, clock.now + 1.0, waited[0] + 0.25
        if step == 6:
            progress.on_validation_start(trainer, None)
            clock.now += 100.0
            progress.on_validation_end(trainer, None)
        progress.on_train_batch_end(trainer, None, None, SimpleNamespace(image=torch.zeros(3, 3, 4, 4)), 0)
    speed = callbacks.speed_of(trainer)
    assert speed is not None and (speed.frames_per_s, speed.without_waiting, speed.waiting) == (12.0, 16.0, 0.25)
    assert "12 frames/s (16 without waiting for them)" in lines[-1] and lines[-1].endswith("16:30 left")
    assert logged[-1] == {"train/frames_per_s": 12.0, "train/waiting_share": 0.25}
    assert speed.record() == {"frames_per_s": 12.0, "without_waiting": 16.0, "waiting_share": 0.25}


@pytest.mark.parametrize("gamma", [1.0, 2.2, 4.0])
@pytest.mark.parametrize("mu", [0.0, 3.0])
def test_no_closed_form_varies_more_than_its_bound(gamma, mu):
    generator = torch.Generator().manual_seed(0)
    scene = cylinder(C3VD.resized(40, 32))
    light = LIGHT.terms()._replace(gamma=torch.full((1, 1, 1, 1), gamma), mu=torch.full((1, 1, 1, 1), mu))
    rays, mask = scene.rays.float(), scene.valid
    half = torch.zeros(1, 3, 32, 40)
    half[..., :20] = 1.0
    for image in (torch.rand(1, 3, 32, 40, generator=generator), half, 5 * half + 0.01):
        for blur in (0.0, 0.018):
            closed = log_closed_form(image, mask, rays, light, blur)
            for where in (mask, informative(image, mask)):
                assert float(masked_std(closed, where)) <= float(most_spread(image, light))
    assert float(masked_std(log_closed_form(half, mask, rays, light, 0.0), mask)) > 0.4 * float(
        most_spread(half, light._replace(mu=torch.zeros(1, 1, 1, 1)))
    )


def test_the_closed_form_is_not_asked_in_a_step_whose_distance_varies(monkeypatch):
    asked = []

    def counted(*given):
        asked.append(given)
        return log_closed_form(*given)

    monkeypatch.setattr(callbacks, "log_closed_form", counted)
    batch, module = batch_of(2), LightDepth(NetworkConfig(width=4))
    trainer = SimpleNamespace(global_step=1, current_epoch=0)
    diagnosis = Diagnosis(DiagnosisConfig(constant=1000), lambda epoch, index: [])
    closed = log_closed_form(batch.image, batch.mask, batch.rays, batch.light)
    for flatter, times, row in ((1.0, 0, 0), (0.005, 1, 1), (0.012, 2, 0), (1.0, 2, 0)):
        outputs = {"loss": torch.tensor(1.0), "terms": {}, "distance": (flatter * closed).exp()}
        diagnosis.on_train_batch_end(trainer, module, outputs, batch, 0)
        assert (len(asked), diagnosis._row["constant"]) == (times, row)


def test_of_several_gradients_the_first_that_is_no_number_is_named():
    module = LightDepth(NetworkConfig(width=4))
    named = dict(module.named_parameters())
    diagnosis = Diagnosis(DiagnosisConfig(), lambda epoch, index: [])
    trainer = SimpleNamespace(precision_plugin=None)
    diagnosis.on_before_optimizer_step(trainer, module, None)  # no gradient at all
    for value in named.values():
        value.grad = torch.zeros_like(value)
    diagnosis.on_before_optimizer_step(trainer, module, None)
    assert diagnosis._bad == "" and all(value.grad is not None for value in named.values())
    for name in list(named)[3:5]:
        named[name].grad.fill_(torch.nan)
    diagnosis.on_before_optimizer_step(trainer, module, None)
    assert diagnosis._bad == list(named)[3] and all(value.grad is None for value in named.values())

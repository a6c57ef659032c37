"""What of Lightning's Trainer a run can be told: plain values and names of ours, so that a file of settings names no
class and no code; and which values end a run.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from lightdepth.errors import InputError
from lightdepth.ranges import above, at_least, checked


@checked
@dataclass(frozen=True)
class TrainerSettings:
    """Lightning's Trainer: device, length of the run, and what is logged."""

    accelerator: Literal["auto", "cpu", "gpu", "cuda", "mps"] = "auto"
    """Kind of device to train on: cpu, gpu (cuda), mps (Apple's), or auto, the fastest that is there."""
    strategy: Literal[
        "auto",
        "ddp",
        "ddp_spawn",
        "ddp_fork",
        "ddp_find_unused_parameters_true",
        "ddp_find_unused_parameters_false",
        "fsdp",
    ] = "auto"
    """How several devices share the work: ddp (each has a copy of the network and frames of its own), in newly started
    processes; ddp_spawn and ddp_fork, the same in processes started in other ways; fsdp, which also splits the network;
    auto lets Lightning choose."""
    devices: Annotated[list[int] | str | int, at_least(-1, up_to=100_000)] = "auto"
    """Number of devices to train on, or a list of the numbers of those to take, such as [0, 2]; auto takes all. More
    are faster, and each adds its own batch to every step."""
    num_nodes: Annotated[int, at_least(1, up_to=100_000)] = 1
    """Number of machines that train together. More are faster, and each adds its own batches to every step."""
    precision: int | str | None = None
    """Numbers that the network computes with: 32-true (also where it is left out), 16-mixed or bf16-mixed (16 bits
    where that is safe: faster on a GPU, and less exact)."""
    logger: bool | Literal["tensorboard", "csv", "none"] | None = None
    """Where the curves of losses and errors are logged: tensorboard (true, or left out), as TensorBoard's files in the
    run folder; csv, as a table there; none (false), not at all."""
    fast_dev_run: Annotated[int | bool, at_least(0)] = False
    """Number of batches to train and to validate on in a trial run (true is one), which shows whether everything works:
    it exports a model, and logs no curves. More take longer; false or 0 is a whole run."""
    max_epochs: Annotated[int | None, at_least(-1)] = None
    """Number of epochs (passes over the training frames) after which training ends, if max_steps does not end it
    sooner; null or -1 for no limit. More train longer."""
    min_epochs: Annotated[int | None, at_least(0)] = None
    """Least number of epochs (passes over the training frames) before --fit.patience or max_time may end the run; null
    for none. More train longer."""
    max_steps: Annotated[int, at_least(-1)] = 1500
    """Number of steps (changes of the weights) after which training ends; -1 for no limit. More train longer."""
    min_steps: Annotated[int | None, at_least(0)] = None
    """Least number of steps (changes of the weights) before --fit.patience or max_time may end the run; null for none.
    More train longer."""
    max_time: Annotated[str | dict[str, int] | None, at_least(0)] = None
    """Time after which training ends, if max_steps does not end it sooner, as days:hours:minutes:seconds; left out, no
    limit. A longer one trains longer."""
    limit_train_batches: Annotated[int | float | None, above(0)] = None
    """How much of the training frames an epoch has: a share of their batches (0.5), or a number of batches (5); left
    out, all. More show more frames in an epoch; how long a run takes, max_steps says."""
    limit_val_batches: Annotated[int | float | None, above(0)] = None
    """How much of the validation frames is used: a share of their batches (0.5), or a number of batches (5); left out,
    all. More judge more surely and take longer."""
    overfit_batches: Annotated[int | float, at_least(0)] = 0.0
    """Share (0.5) or number (5) of the training batches that are trained on again and again, in one order, to see
    whether the network can learn them by heart; validation uses as many. 0.0 trains as usual. More are harder to learn
    by heart."""
    val_check_interval: Annotated[int | float | str | dict[str, int] | None, above(0)] = 250
    """Number of batches from one validation to the next, max_steps at most; or a time, days:hours:minutes:seconds; or,
    where check_val_every_n_epoch is a number, a share of an epoch, such as 0.5. Larger values validate less often."""
    check_val_every_n_epoch: Annotated[int | None, at_least(1)] = None
    """Number of epochs (passes over the training frames) from one that is validated to the next; null lets
    val_check_interval count batches, whatever the epoch. More validate less often."""
    num_sanity_val_steps: Annotated[int | None, at_least(-1)] = 0
    """Number of validation batches that are tried before training, so that a fault in them shows at once; 0 for none,
    -1 for all. More find mistakes more surely, and training begins later."""
    log_every_n_steps: Annotated[int | None, at_least(0)] = 10
    """Number of steps from one point of the logged training curves to the next. More make coarser curves and smaller
    files."""
    enable_progress_bar: bool | None = None
    """true: a progress bar is shown. false: none is. Left out, there is one where messages go to a terminal. Lines on
    progress are printed in any case."""
    enable_model_summary: bool | None = False
    """true: the layers of the network and their numbers of weights are listed before training begins. false: they are
    not."""
    accumulate_grad_batches: Annotated[int, at_least(1)] = 1
    """Number of batches whose mean gradient makes one step, as one larger batch would, in less memory. More make
    steadier steps, and the same number of steps takes longer."""
    gradient_clip_val: Annotated[int | float | None, at_least(0)] = 1.0
    """Norm above which the gradient of a step is scaled down to it (with gradient_clip_algorithm value: size above
    which each of its values is cut); null and 0 never do. A larger one lets larger steps through."""
    gradient_clip_algorithm: Literal["norm", "value"] | None = None
    """What gradient_clip_val holds down: norm (also where it is left out), the length of the whole gradient, whose
    direction stays; value, each of its values by itself."""
    deterministic: bool | Literal["warn"] | None = None
    """true: only operations that give the same numbers in every run, and an error where there is none. warn: a warning
    there. false or left out: the fastest ones."""
    benchmark: bool | None = None
    """true: on a GPU, cuDNN tries several ways of each convolution and keeps the fastest. false or left out: it does
    not, and the first steps are quicker."""
    inference_mode: bool = True
    """true: validation runs in PyTorch's inference mode, a little faster. false: it only leaves gradients out, for code
    that the mode does not suit. The results are the same."""
    use_distributed_sampler: bool = True
    """With several devices, true gives each its own part of the frames: in a step they see together what one device
    would see with a batch as large as all of theirs. false gives all frames to each device. With one device it changes
    nothing."""
    profiler: Literal["simple", "advanced", "pytorch"] | None = None
    """Profiler that measures where a run spends its time: simple, advanced or pytorch, each in more detail and slower
    than the one before. Left out, nothing is measured."""
    detect_anomaly: bool = False
    """true: where a gradient is not a number, PyTorch names the operation that it came from; much slower. false: it
    does not look."""
    sync_batchnorm: bool | None = None
    """With several devices, true takes the mean and deviation of batch normalisation over the frames of all devices,
    and false over those of each. Left out, it is true on GPUs and false on processors, which can do nothing else. With
    one device it changes nothing."""
    reload_dataloaders_every_n_epochs: Annotated[int, at_least(0)] = 0
    """Number of epochs (passes over the training frames) after which the reading of frames is started anew; 0 for
    never. The frames stay the same. More do it less often."""


def check_trainer_options(options: Mapping[str, object]) -> None:
    """Raises InputError where a value would end the run with an error of Lightning's, or with nothing trained."""
    for name in ("max_steps", "max_epochs"):
        value = options.get(name)
        if isinstance(value, int) and (value == 0 or value < -1):
            raise _wrong(name, value, "a number above 0, or -1 for no limit")
    for name in ("accumulate_grad_batches", "num_nodes"):
        value = options.get(name, 1)
        if isinstance(value, int) and value < 1:
            raise _wrong(name, value, "a number above 0")
    for name in ("limit_train_batches", "limit_val_batches"):
        value = options.get(name)
        if isinstance(value, int | float) and not (0 < value <= 1 or (isinstance(value, int) and value > 1)):
            cure = "a share above 0 and up to 1.0, or a number of batches"
            if name == "limit_val_batches" and value == 0:
                cure += ": the checkpoint that is exported is chosen and judged on validation frames"
            raise _wrong(name, value, cure)
    _check_interval(options.get("val_check_interval"), options.get("check_val_every_n_epoch", 1))
    devices, cores = _count(options.get("devices")), os.cpu_count() or 1
    if devices > max(2, cores) and _on_cpu(options.get("accelerator", "auto")):
        raise _wrong("devices", devices, f"{cores} at most, the cores of this machine")


def _count(devices: object) -> int:
    """How many devices a number or a word such as "4" asks for; 1 where it asks for none by number."""
    if isinstance(devices, int):
        return devices
    return int(devices) if isinstance(devices, str) and devices.strip().isdecimal() else 1


def _on_cpu(accelerator: object) -> bool:
    """Whether each device would be one more process on this machine's processor."""
    import torch

    return accelerator == "cpu" or (accelerator == "auto" and not torch.cuda.is_available())


def _check_interval(interval: object, epochs: object) -> None:
    if isinstance(epochs, int) and epochs < 1:
        raise _wrong("check_val_every_n_epoch", epochs, "a number above 0, or null")
    if isinstance(interval, float) and epochs is None:
        cure = "a whole number of batches, or --trainer.check-val-every-n-epoch 1 beside it for a share of an epoch"
        raise _wrong("val_check_interval", interval, cure)
    if isinstance(interval, float) and not 0 < interval <= 1:
        raise _wrong("val_check_interval", interval, "a share of an epoch, above 0 and up to 1.0")
    if isinstance(interval, int) and interval < 1:
        raise _wrong("val_check_interval", interval, "a number of batches above 0")


def _wrong(name: str, value: object, expected: str) -> InputError:
    return InputError(f"--trainer.{name.replace('_', '-')}", f"{value}", f"expected {expected}")

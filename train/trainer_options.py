"""What the options of Lightning's Trainer do, in a sentence each, as its own docstrings are written for programs; which
of them a run does not have, and which values end it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

from lightdepth.errors import InputError
from lightdepth.ranges import above, at_least

WITHOUT = {
    "default_root_dir",  # the run's folder
    "limit_test_batches",
    "limit_predict_batches",  # training neither tests nor predicts
    "enable_autolog_hparams",
    "model_registry",  # settings and checkpoints are written by the run itself
    "enable_checkpointing",
    "barebones",  # a run has checkpoints and a log
}
"""Options of the Trainer that do nothing here, or end the run whatever they are."""
_SENTENCES = {
    "accelerator": "Kind of device to train on: cpu, gpu (cuda), mps (Apple's), or auto, the fastest that is there.",
    "strategy": "How several devices share the work, by Lightning's name, such as ddp (each has a copy of the network "
    "and frames of its own); auto lets Lightning choose.",
    "devices": "Number of devices to train on, or a list of the numbers of those to take, such as [0, 2]; auto takes "
    "all. More are faster, and each adds its own batch to every step.",
    "num_nodes": "Number of machines that train together. More are faster, and each adds its own batches to every "
    "step.",
    "precision": "Numbers that the network computes with: 32-true (also where it is left out), 16-mixed or bf16-mixed "
    "(16 bits where that is safe: faster on a GPU, and less exact).",
    "logger": "Whether the curves of losses and errors are logged: true, or left out, to TensorBoard files in the run "
    "folder; false, not at all; or a Lightning logger to take TensorBoard's place.",
    "callbacks": "Lightning callbacks (objects that Lightning calls as it trains), by their classes, to add to those "
    "of the run. Left out, the run has its own alone.",
    "fast_dev_run": "Number of batches to train and to validate on in a trial run (true is one), which shows whether "
    "everything works: it exports a model, and logs no curves. More take longer; false or 0 is a whole run.",
    "max_epochs": "Number of epochs (passes over the training frames) after which training ends, if max_steps does "
    "not end it sooner; null or -1 for no limit. More train longer.",
    "min_epochs": "Least number of epochs (passes over the training frames) before --fit.patience or max_time may end "
    "the run; null for none. More train longer.",
    "max_steps": "Number of steps (changes of the weights) after which training ends; -1 for no limit. More train "
    "longer.",
    "min_steps": "Least number of steps (changes of the weights) before --fit.patience or max_time may end the run; "
    "null for none. More train longer.",
    "max_time": "Time after which training ends, if max_steps does not end it sooner, as days:hours:minutes:seconds; "
    "left out, no limit. A longer one trains longer.",
    "limit_train_batches": "How much of the training frames an epoch has: a share of their batches (0.5), or a number "
    "of batches (5); left out, all. More show more frames in an epoch; how long a run takes, max_steps says.",
    "limit_val_batches": "How much of the validation frames is used: a share of their batches (0.5), or a number of "
    "batches (5); left out, all. More judge more surely and take longer.",
    "overfit_batches": "Share (0.5) or number (5) of the training batches that are trained on again and again, in one "
    "order, to see whether the network can learn them by heart; as much is validated on. 0.0 trains as usual. More "
    "are harder to learn by heart.",
    "val_check_interval": "Number of batches from one validation to the next, max_steps at most; or a time, "
    "days:hours:minutes:seconds; or, where check_val_every_n_epoch is a number, a share of an epoch, such as 0.5. "
    "Larger values validate less often.",
    "check_val_every_n_epoch": "Number of epochs (passes over the training frames) from one that is validated to the "
    "next; null lets val_check_interval count batches, whatever the epoch. More validate less often.",
    "num_sanity_val_steps": "Number of validation batches that are tried before training, so that what is wrong with "
    "them shows at once; 0 for none, -1 for all. More find mistakes more surely, and training begins later.",
    "log_every_n_steps": "Number of steps from one point of the logged training curves to the next. More make coarser "
    "curves and smaller files.",
    "enable_progress_bar": "true: a progress bar is shown. false: none is. Left out, there is one where messages go "
    "to a terminal. Lines on progress are printed in any case.",
    "enable_model_summary": "true: the layers of the network and their numbers of weights are listed before training "
    "begins. false: they are not.",
    "accumulate_grad_batches": "Number of batches whose mean gradient makes one step, as one larger batch would, in "
    "less memory. More make steadier steps, and as many steps take longer.",
    "gradient_clip_val": "Norm above which the gradient of a step is scaled down to it (with gradient_clip_algorithm "
    "value: size above which each of its values is cut); null and 0 never do. A larger one lets larger steps through.",
    "gradient_clip_algorithm": "What gradient_clip_val holds down: norm (also where it is left out), the length of "
    "the whole gradient, whose direction stays; value, each of its values by itself.",
    "deterministic": "true: only operations that give the same numbers in every run, and an error where there is "
    "none. warn: a warning there. false or left out: the fastest ones.",
    "benchmark": "true: on a GPU, cuDNN tries several ways of each convolution and keeps the fastest. false or left "
    "out: it does not, and the first steps are quicker.",
    "inference_mode": "true: validation runs in PyTorch's inference mode, a little faster. false: it only leaves "
    "gradients out, for code that the mode does not suit. The results are the same.",
    "use_distributed_sampler": "Of several devices, true gives each its own part of the frames, and false gives all "
    "of them to each. With one device it changes nothing.",
    "profiler": "What measures where the time of a run goes, by Lightning's name: simple, advanced or pytorch, each "
    "in more detail and slower. Left out, nothing does.",
    "detect_anomaly": "true: where a gradient is not a number, PyTorch names the operation that it came from; much "
    "slower. false: it does not look.",
    "plugins": "Lightning plugins, by their classes, that change how it computes in other precisions, works in a "
    "cluster or writes checkpoints. Left out, Lightning's own.",
    "sync_batchnorm": "Of several devices, true takes the mean and deviation of batch normalisation over the frames "
    "of all of them, and false over those of each. With one device it changes nothing.",
    "reload_dataloaders_every_n_epochs": "Number of epochs (passes over the training frames) after which what reads "
    "the frames is started anew; 0 for never. The frames stay the same. More do it less often.",
}
_RANGES = {
    "num_nodes": at_least(1, up_to=100_000),
    "devices": at_least(-1, up_to=100_000),
    "fast_dev_run": at_least(0),
    "max_epochs": at_least(-1),
    "min_epochs": at_least(0),
    "max_steps": at_least(-1),
    "min_steps": at_least(0),
    "max_time": at_least(0),
    "limit_train_batches": above(0),
    "limit_val_batches": above(0),
    "overfit_batches": at_least(0),
    "val_check_interval": above(0),
    "check_val_every_n_epoch": at_least(1),
    "num_sanity_val_steps": at_least(-1),
    "log_every_n_steps": at_least(0),
    "accumulate_grad_batches": at_least(1),
    "gradient_clip_val": at_least(0),
    "reload_dataloaders_every_n_epochs": at_least(0),
}
"""Of those that are numbers; `check_trainer_options` knows more of some."""
TRAINER_RANGES = {f"trainer.{name}": numbers for name, numbers in _RANGES.items()}
TRAINER_OPTIONS = {f"trainer.{name}": sentence for name, sentence in _SENTENCES.items()}


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

"""What the options of Lightning's Trainer do, in a sentence each: its own docstrings are written for programs."""

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
    "limit_test_batches": "Share or number of the test batches, of which training has none: it has no effect. More "
    "change nothing.",
    "limit_predict_batches": "Share or number of the batches to predict, of which training has none: it has no "
    "effect. More change nothing.",
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
    "enable_checkpointing": "To be left out: the run always writes its checkpoints. true changes nothing, and false "
    "ends it with an error.",
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
    "barebones": "To be left at false: true, in which Lightning measures its own overhead, does not go together with "
    "the run's log and checkpoints, and ends it with an error.",
    "plugins": "Lightning plugins, by their classes, that change how it computes in other precisions, works in a "
    "cluster or writes checkpoints. Left out, Lightning's own.",
    "sync_batchnorm": "Of several devices, true takes the mean and deviation of batch normalisation over the frames "
    "of all of them, and false over those of each. With one device it changes nothing.",
    "reload_dataloaders_every_n_epochs": "Number of epochs (passes over the training frames) after which what reads "
    "the frames is started anew; 0 for never. The frames stay the same. More do it less often.",
    "enable_autolog_hparams": "Whether Lightning logs the settings: it has no effect, because a run has them in its "
    "config.yaml, not in its logs.",
    "model_registry": "Name of the model in Lightning's model hub: it has no effect, because the run writes its "
    "checkpoints itself, into its folder.",
}
TRAINER_OPTIONS = {f"trainer.{name}": sentence for name, sentence in _SENTENCES.items()}

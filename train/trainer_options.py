"""What the options of Lightning's Trainer do, in a sentence each: its own docstrings are written for programs."""

_SENTENCES = {
    "accelerator": "Kind of device to train on: cpu, gpu, mps or auto.",
    "strategy": "How several devices share the work, by Lightning's name, such as ddp.",
    "devices": "Number of devices to train on, or a list of theirs; auto takes all. More are faster.",
    "num_nodes": "Number of machines to train on. More are faster.",
    "precision": "Number format of the network: 32-true, 16-mixed or bf16-mixed.",
    "logger": "Whether curves are logged; the run has TensorBoard logs of its own.",
    "callbacks": "Lightning callbacks to add to those of the run.",
    "fast_dev_run": "Number of batches of a trial run that writes nothing; false for none. More take longer.",
    "max_epochs": "Largest number of passes over the training frames; null and -1 for no limit. More train longer.",
    "min_epochs": "Least number of passes over the training frames. More train longer.",
    "max_steps": "Number of steps after which training ends; -1 for no limit. More train longer.",
    "min_steps": "Least number of steps before training may end. More train longer.",
    "max_time": "Time after which training ends, days:hours:minutes:seconds. A longer one trains longer.",
    "limit_train_batches": "Share of the training batches of an epoch, or number of them. More take longer.",
    "limit_val_batches": "Share of the validation batches, or number of them. More judge more surely and take longer.",
    "limit_test_batches": "Share of the test batches, or number of them; train has no test. More take longer.",
    "limit_predict_batches": "Share of the batches to predict, or number of them; there are none. More take longer.",
    "overfit_batches": "Share of the training batches, or number of them, to train on again and again. "
    "More overfit later.",
    "val_check_interval": "Number of steps from one validation to the next, or share of an epoch. "
    "Larger values validate less often.",
    "check_val_every_n_epoch": "Number of epochs from one validation to the next; null counts steps alone. "
    "More validate less often.",
    "num_sanity_val_steps": "Number of validation batches tried before training. More find mistakes sooner.",
    "log_every_n_steps": "Number of steps from one point of the logged curves to the next. More log less often.",
    "enable_checkpointing": "Whether Lightning writes checkpoints besides those of the run.",
    "enable_progress_bar": "Whether Lightning shows a bar of its own.",
    "enable_model_summary": "Whether Lightning lists the layers of the network first.",
    "accumulate_grad_batches": "Number of batches whose gradients make one step. More make fewer, steadier steps.",
    "gradient_clip_val": "Norm at which gradients are cut off, a number above 0; null for never. "
    "A larger one cuts off fewer.",
    "gradient_clip_algorithm": 'How gradients are cut off: by "norm" or by "value".',
    "deterministic": 'Whether only reproducible operations are used; "warn" says where there are none.',
    "benchmark": "Whether cuDNN tries several ways of each convolution and keeps the fastest.",
    "inference_mode": "Whether validation runs in PyTorch's inference mode.",
    "use_distributed_sampler": "Whether Lightning divides the frames among several devices by itself.",
    "profiler": "What measures the time of each step, by Lightning's name: simple, advanced or pytorch.",
    "detect_anomaly": "Whether PyTorch looks for the operation that first gives no number; slow.",
    "barebones": "Whether Lightning leaves out all that costs time, to measure its own overhead.",
    "plugins": "Lightning plugins to change precision, cluster or checkpoints.",
    "sync_batchnorm": "Whether batch normalisation is shared among several devices.",
    "reload_dataloaders_every_n_epochs": "Number of epochs after which the data are opened anew; 0 for never. "
    "More open them less often.",
    "enable_autolog_hparams": "Whether Lightning logs the settings at the start of a run.",
    "model_registry": "Name of the model in Lightning's model hub, to upload it to.",
}
TRAINER_OPTIONS = {f"trainer.{name}": sentence for name, sentence in _SENTENCES.items()}

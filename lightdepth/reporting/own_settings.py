"""The config.yaml of a run, given to `--config`: it calls the run's inputs by names, and is read with their paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from lightdepth.command_line.config_words import with_configs
from lightdepth.command_line.settings_yaml import read_settings
from lightdepth.errors import InputError
from lightdepth.files.named_inputs import INPUTS, real, real_inputs, unknown_names

_OF_ANOTHER_RUN = ("output", "overwrite", "resume")


def with_real_settings(argv: Sequence[str]) -> list[str]:
    """The words of a command line; a --config FILE that calls inputs by names is put in as text with their paths, and
    without where that run went. Raises InputError where inputs.json beside it is gone, for names of options that the
    command line does not give."""
    return with_configs(argv, lambda file: _text_of(file, argv) or file)


def _text_of(file: str, argv: Sequence[str]) -> str | None:
    """The settings of a file with paths in the place of names; None where it has no names."""
    path = Path(file)
    try:
        settings = read_settings(path)
    except (OSError, ValueError, yaml.YAMLError):
        return None  # the parser says what is wrong with it
    if not isinstance(settings, Mapping) or not any(unknown_names(settings)):
        return None
    found = real(settings, real_inputs(path.parent))
    options = [word.partition("=")[0][2:].replace("-", "_") for word in argv if word.startswith("--")]
    given = {option.rpartition(".")[2] for option in options}
    for key, name in unknown_names(found):
        if key not in given and not (key in ("data", "run", "what") and argv[:1] and Path(argv[0]).exists()):
            said = f"{key} is {name}, and {INPUTS} beside it, which says what that is, is gone"
            raise InputError(path, said, f"give --{key.replace('_', '-')}" if key != "data" else "give the data")
    kept = {key: value for key, value in found.items() if key not in _OF_ANOTHER_RUN}
    return yaml.safe_dump(kept, sort_keys=False)

"""Settings that a config file has and that are not taken from it: those of earlier versions that are no more, and those
that are given with each run, as where it goes. The file is still read, with a warning.

A key that was never a setting stays an error: it is a typing mistake.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightdepth.command_line.config_words import with_configs

_WITHHOLD = "the surface uses every point; blocks of wall judge it, see judge.folds"
_NO_EFFECT = "it had no effect"
_NO_CODE = "settings name no code: fit() of train.fit takes such objects"
_ALWAYS = "a run always has its log and checkpoints"
GONE_SETTINGS: dict[str, dict[str, str]] = {
    "import": {"source": "it is data now, as with the other verbs"},
    "densify": {"withhold": _WITHHOLD, "seed": "it drew withheld points; judge.seed draws blocks of wall"},
    "demo": {"withhold": _WITHHOLD},
    "train": {
        **dict.fromkeys(("trainer.limit_test_batches", "trainer.limit_predict_batches"), _NO_EFFECT),
        **dict.fromkeys(("trainer.enable_autolog_hparams", "trainer.model_registry"), _NO_EFFECT),
        **dict.fromkeys(("trainer.enable_checkpointing", "trainer.barebones"), _ALWAYS),
        **dict.fromkeys(("trainer.callbacks", "trainer.plugins"), _NO_CODE),
    },
}
"""By verb, the dotted keys that are gone, each with what became of it. A key stands for all that is below it."""
GIVEN_WITH_EACH_RUN = ("output", "overwrite", "resume", "table", "config", "preset", "quiet", "json")
"""Options that no file sets: a file of someone else's does not say what is written where, and what is replaced there.
So the config.yaml of a run serves for another one."""


def without_gone(verb: str, argv: Sequence[str]) -> list[str]:
    """The words of a command line; a --config FILE with settings that are not taken from it is put in as text without
    them."""
    gone = GONE_SETTINGS.get(verb, {})
    return with_configs(argv, lambda file: _kept(file, gone))


def without_given(settings: dict[str, Any]) -> list[str]:
    """Takes what is given with each run out of settings, and names what said something."""
    taken = {key: settings.pop(key) for key in GIVEN_WITH_EACH_RUN if key in settings}
    return [key for key, value in taken.items() if value not in (None, False)]


def _kept(file: str, gone: Mapping[str, str]) -> str:
    """The file's name, or, where it has settings that are not taken from it, its text without them."""
    import yaml

    from lightdepth.command_line.settings_yaml import read_settings

    try:
        settings = read_settings(Path(file))
    except (OSError, ValueError, yaml.YAMLError):
        return file  # the parser says what is wrong with it
    if not isinstance(settings, dict):
        return file
    count = len(settings)
    given = without_given(settings)
    found = {key: why for key, why in gone.items() if _dropped(settings, key.split("."))}
    if given:
        said = f"{file}: left out, as they are given with each run: {', '.join(given)}"
        warnings.warn(said, UserWarning, stacklevel=2)
    if found:
        listed = "; ".join(f"{key} ({why})" for key, why in found.items())
        warnings.warn(f"{file}: settings that no longer exist are ignored: {listed}", UserWarning, stacklevel=2)
    return yaml.safe_dump(settings, sort_keys=False) if found or len(settings) < count else file


def _dropped(settings: Any, keys: Sequence[str]) -> bool:
    """Takes a key out of nested settings; False where it is not there."""
    whole = ".".join(keys)
    if isinstance(settings, dict) and whole in settings:
        del settings[whole]
        return True
    for key in keys[:-1]:
        settings = settings.get(key) if isinstance(settings, dict) else None
    if not isinstance(settings, dict) or keys[-1] not in settings:
        return False
    del settings[keys[-1]]
    return True

"""Settings of earlier versions that are no more: a config file that has them is still read, with one warning.

A key that was never a setting stays an error: it is a typing mistake.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_WITHHOLD = "the surface uses every point; blocks of wall judge it, see judge.folds"
_NO_EFFECT = "it had no effect"
_ALWAYS = "a run always has its log and checkpoints"
GONE_SETTINGS: dict[str, dict[str, str]] = {
    "import": {"source": "it is data now, as with the other verbs"},
    "densify": {"withhold": _WITHHOLD, "seed": "it drew withheld points; judge.seed draws blocks of wall"},
    "demo": {"withhold": _WITHHOLD},
    "train": {
        **dict.fromkeys(("trainer.limit_test_batches", "trainer.limit_predict_batches"), _NO_EFFECT),
        **dict.fromkeys(("trainer.enable_autolog_hparams", "trainer.model_registry"), _NO_EFFECT),
        **dict.fromkeys(("trainer.enable_checkpointing", "trainer.barebones"), _ALWAYS),
    },
}
"""By verb, the dotted keys that are gone, each with what became of it. A key stands for all that is below it."""


def without_gone(verb: str, argv: Sequence[str]) -> list[str]:
    """The words of a command line; a --config FILE that has settings which are gone is put in as text without them."""
    gone = GONE_SETTINGS.get(verb, {})
    words = list(argv)
    for place, word in enumerate(words):
        joined = word.startswith("--config=")
        if gone and (joined or (place > 0 and words[place - 1] == "--config")):
            words[place] = ("--config=" if joined else "") + _kept(word.removeprefix("--config="), gone)
    return words


def _kept(file: str, gone: Mapping[str, str]) -> str:
    """The file's name, or, where it has settings that are gone, its text without them."""
    import yaml

    from lightdepth.command_line.settings_yaml import read_settings

    try:
        settings = read_settings(Path(file))
    except (OSError, ValueError, yaml.YAMLError):
        return file  # the parser says what is wrong with it
    found = {key: why for key, why in gone.items() if _dropped(settings, key.split("."))}
    if not found:
        return file
    listed = "; ".join(f"{key} ({why})" for key, why in found.items())
    warnings.warn(f"{file}: settings that are no more are left out: {listed}", UserWarning, stacklevel=2)
    return yaml.safe_dump(settings, sort_keys=False)


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

"""YAML of settings: `judge: {on: false}`, where YAML 1.1 takes a bare `on` for the value true; and keys as `--help`
spells options, with dashes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from jsonargparse import get_loader, set_loader, set_parsing_settings

from lightdepth import plain_yaml
from lightdepth.regular import regular

_WORDS = {True: "on", False: "off"}
_DASHED = re.compile(r"[a-z][a-z0-9_.]*(-[a-z0-9_.]+)+")
_library = get_loader("yaml")


def read_settings(file: Path) -> Any:
    """What a file of settings holds. Raises OSError, UnicodeDecodeError or yaml.YAMLError, and InputError of what is no
    file, which would be waited for."""
    return with_words(plain_yaml.read(regular(file, "expected a YAML file of settings")))


def use_words() -> None:
    """From here on jsonargparse reads its YAML so, too."""
    set_loader("yaml", _loaded, exceptions=(yaml.YAMLError,))


def take_plain_values() -> None:
    """Keeps a file of settings from naming a module to import, a class to make, or an address to read."""
    set_parsing_settings(
        import_path_denylist=["*"],
        import_path_allowlist=["lightdepth", "densify", "train"],  # where the classes of our own options are
        instantiate_subclass_spec_in_any=False,
        config_read_mode_urls_enabled=False,
        config_read_mode_fsspec_enabled=False,
    )


def _loaded(text: str) -> Any:
    """What a word of the command line, or a file, means as YAML; the name of a file that is not UTF-8 means itself."""
    if any("\udc80" <= letter <= "\udcff" for letter in text):
        return text
    plain_yaml.check(text)
    try:
        return with_words(_library(text))
    except (ValueError, OverflowError, LookupError, AttributeError, TypeError) as error:  # 5000 digits; `!!bool x`
        raise yaml.YAMLError(str(error)) from error


def with_words(value: Any) -> Any:
    """The same with keys that are words again where YAML took them for true and false, and settings' own names where
    they have dashes."""
    if isinstance(value, Mapping):
        return {_word(k): with_words(v) for k, v in value.items()}
    return [with_words(v) for v in value] if isinstance(value, list) else value


def _word(key: Any) -> Any:
    if isinstance(key, bool):
        return _WORDS[key]
    return key.replace("-", "_") if isinstance(key, str) and _DASHED.fullmatch(key) else key

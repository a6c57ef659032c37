"""Settings that come with the program: `--preset NAME` is `--config` with the file of that name.

The files stand in `configs/` of the repository and, by a link, in `lightdepth/configs/` of the installed package. What
counts more comes later: a preset, then the files of `--config` in their order, then single options.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

FOLDERS = {"train": "train", "ablate": "ablation"}
"""Folder of configs/ that holds a verb's presets; verbs that are not here have none."""

_HERE = Path(__file__).resolve().parents[1]
# Without links (some checkouts have none) the repository's own folder serves.
_CONFIGS = next((folder for folder in (_HERE / "configs", _HERE.parent / "configs") if folder.is_dir()), _HERE)


def presets(verb: str) -> dict[str, Path]:
    """The files of a verb's presets by name; none for most verbs."""
    if verb not in FOLDERS:
        return {}
    return {path.stem: path for path in sorted((_CONFIGS / FOLDERS[verb]).glob("*.yaml"))}


def preset_help(verb: str) -> str:
    """What `--help` says of the option --preset."""
    names = ", ".join(presets(verb))
    return (
        f"Settings that come with lightdepth, by name: {names}. Each is a file configs/{FOLDERS[verb]}/NAME.yaml, "
        "which begins with what it is for; a --config file and single options win over it."
    )


def with_preset(verb: str, argv: Sequence[str], error: Callable[[str], NoReturn]) -> list[str]:
    """The words of a command line with `--preset NAME` spelled out as --config, and all --config before the options.

    `error` is called with one line when a preset is not there: it is what a parser does with wrong usage.
    """
    chosen: list[str] = []
    configs: list[str] = []
    others: list[str] = []
    words = list(argv)
    while words:
        word = words.pop(0)
        name, equals, value = word.partition("=")
        if name not in ("--preset", "--config") or (name == "--preset" and verb not in FOLDERS):
            others.append(word)
        elif not equals and not words:
            error(f"{name}: expected {'the name of a preset' if name == '--preset' else 'a file'} after it")
        else:
            (chosen if name == "--preset" else configs).append(value if equals else words.pop(0))
    files = [str(_found(verb, name, error)) for name in chosen] + configs
    return [word for file in files for word in ("--config", file)] + others


def shipped(path: Path) -> Path:
    """A path that begins with configs/ means the program's own file where the working folder has none of that name."""
    own = _CONFIGS.joinpath(*path.parts[1:])
    return own if path.parts[:1] == ("configs",) and not path.exists() and own.is_file() else path


def _found(verb: str, name: str, error: Callable[[str], NoReturn]) -> Path:
    known = presets(verb)
    if name not in known:
        close = difflib.get_close_matches(name, known, 1)
        hint = f"is {close[0]} meant?" if close else f"expected one of {', '.join(known)}"
        if name.endswith((".yaml", ".yml")):
            hint += " (--config takes a file)"
        error(f"--preset {name}: no such preset of {verb}; {hint}")
    return known[name]

"""What a command line gives to --config: the name of a file of settings, or the settings themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence


def configs(argv: Sequence[str]) -> Iterator[str]:
    """What is given to each --config, in either way to write it."""
    for place, word in enumerate(argv):
        if word.startswith("--config="):
            yield word.removeprefix("--config=")
        elif place and argv[place - 1] == "--config":
            yield word


def with_configs(argv: Sequence[str], change: Callable[[str], str]) -> list[str]:
    """The words of a command line, with what is given to each --config changed."""
    words = list(argv)
    for place, word in enumerate(argv):
        if word.startswith("--config="):
            words[place] = f"--config={change(word.removeprefix('--config='))}"
        elif place and argv[place - 1] == "--config":
            words[place] = change(word)
    return words

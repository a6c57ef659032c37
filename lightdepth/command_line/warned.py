"""Warnings on the command line: a sentence each, without the place in the code that Python shows with them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from lightdepth.foreign_text import for_terminal


@contextmanager
def warnings_as_sentences() -> Iterator[None]:
    """Within it a UserWarning is printed as `warning: ` and what it says, on one line. Which ones are shown, and who
    records them, stays as it is; other kinds, such as a library's deprecations, look as they always do."""
    as_python = warnings.formatwarning

    def formatted(
        message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
    ) -> str:
        if not issubclass(category, UserWarning):
            return as_python(message, category, filename, lineno, line)
        return for_terminal(f"warning: {' '.join(str(message).split())}") + "\n"

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = as_python


@contextmanager
def heard(take: Callable[[str], None], known: Callable[[str], bool] = lambda said: False) -> Iterator[None]:
    """Within it `take` is told what each UserWarning says, after it was shown; one that is `known` is passed over. A
    library's deprecations are no news to a user."""
    shown = warnings.showwarning

    def hear(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        ours = issubclass(category, UserWarning)
        if ours and known(str(message)):
            return
        shown(message, category, filename, lineno, file, line)
        if ours:
            take(str(message))

    warnings.showwarning = hear
    try:
        yield
    finally:
        warnings.showwarning = shown

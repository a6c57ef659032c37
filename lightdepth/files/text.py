"""Text files: whole, as lines, as numbers; what cannot be read is named with its place."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.reading import MOST_TEXT, check_bytes
from lightdepth.regular import regular


def read_text(path: Path, expected: str) -> str:
    """The file's text; `expected` ends the message when it is something else."""
    try:
        check_bytes(regular(path, expected).stat().st_size, MOST_TEXT, path, "text")
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error})", expected) from error
    except UnicodeDecodeError as error:
        raise InputError(path, f"not a text file in UTF-8 (at byte {error.start})", expected) from error
    if "\0" in text:
        raise InputError(path, "not a text file", expected)
    return text


def rows(text: str) -> list[list[str]]:
    """The words of every line that is neither empty nor a comment."""
    lines = (line.split() for line in text.lstrip("\ufeff").splitlines())
    return [words for words in lines if words and not words[0].startswith(("#", "%"))]


def to_numbers(words: list[str], where: str, expected: str) -> list[float]:
    """Words as finite numbers; raises InputError with the first that is none."""
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            raise InputError(where, f"found {word[:60]!r}, which is not a number", f"expected {expected}") from None
        if not np.isfinite(numbers[-1]):
            raise InputError(where, f"{word} is not finite", f"expected {expected}")
    return numbers


def text_lines(path: Path) -> list[str]:
    try:
        return regular(path).read_text(encoding="utf-8-sig").split("\n")
    except OSError as error:
        raise InputError(
            path, f"cannot be read ({error.strerror or error})", "expected a file that is there and may be read"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(path, "not a text file", "a binary model's files end in .bin") from error


def is_comment(line: str) -> bool:
    """Whether a line says nothing: empty, or a comment."""
    return not line.strip() or line.lstrip().startswith("#")


def numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines that are neither empty nor a comment."""
    return (
        (n, line) for n, line in enumerate(text_lines(path), 1) if line.strip() and not line.lstrip().startswith("#")
    )


def parse_numbers(tokens: list[str], where: str, expected: str) -> np.ndarray:
    """Tokens as float64; raises InputError with the first that is not a number."""
    try:
        return np.array(tokens, dtype=np.float64)
    except ValueError:
        for token in tokens:
            try:
                float(token)
            except ValueError:
                raise InputError(
                    where, f"found {token[:60]!r}, which is not a number", f"expected {expected}"
                ) from None
        raise


def parse_integer(token: str, where: str, expected: str) -> int:
    try:
        number = int(token)
    except ValueError:
        raise InputError(where, f"found {token[:60]!r}, which is not an integer", f"expected {expected}") from None
    if abs(number) >= 2**63:
        raise InputError(where, f"found {token[:60]}, an integer of more than 63 bits", f"expected {expected}")
    return number

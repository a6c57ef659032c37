"""Words that hang on what they stand beside: a plural on its number, a full stop on how a sentence ends."""

from __future__ import annotations


def counted(count: int, thing: str, several: str = "") -> str:
    """`1 frame`, `2 frames`; `several` is the plural where it takes more than an s."""
    return f"{count} {thing if count == 1 else several or f'{thing}s'}"


def full_stop(text: str) -> str:
    """The text as a sentence, with a full stop unless it ends as one already: a cure may be a question."""
    return text if text.endswith((".", "?", "!", "…")) else f"{text}."

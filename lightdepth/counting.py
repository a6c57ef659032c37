"""Words that hang on what they stand beside: a plural on its number, an article and a full stop on their letters."""

from __future__ import annotations


def counted(count: int, thing: str, several: str = "") -> str:
    """`1 frame`, `2 frames`; `several` is the plural where it takes more than an s."""
    return f"{count} {thing if count == 1 else several or f'{thing}s'}"


def full_stop(text: str) -> str:
    """The text as a sentence, with a full stop unless it ends as one already: a cure may be a question."""
    return text if text.endswith((".", "?", "!", "…")) else f"{text}."


def with_article(thing: str) -> str:
    """`a mask`, `an image`; before a u, `a`: ours are spoken as in `unet`, not as in `unfinished`."""
    return f"{'an' if thing[:1].lower() in 'aeio' else 'a'} {thing}"

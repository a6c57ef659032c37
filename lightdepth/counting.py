"""Numbers of things in words: one has no plural."""

from __future__ import annotations


def counted(count: int, thing: str, several: str = "") -> str:
    """`1 frame`, `2 frames`; `several` is the plural where it takes more than an s."""
    return f"{count} {thing if count == 1 else several or f'{thing}s'}"

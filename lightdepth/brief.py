"""Reprs that fit on a line or two: shapes instead of arrays, counts instead of collections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any


class Brief:
    """A base for dataclasses made with repr=False."""

    def __repr__(self) -> str:
        shown = ", ".join(f"{f.name}={_brief(getattr(self, f.name))}" for f in fields(self) if f.repr)  # type: ignore[arg-type]  # every subclass is a dataclass
        return f"{type(self).__name__}({shown})"


def _brief(value: Any) -> str:
    shape = getattr(value, "shape", None)
    if shape is not None and getattr(value, "ndim", 0) > 0:
        return f"<{'x'.join(map(str, shape))} {value.dtype}>"
    if isinstance(value, Sequence | Mapping) and not isinstance(value, str) and len(value) > 3:
        return f"<{len(value)} {'entries' if isinstance(value, Mapping) else type(next(iter(value))).__name__}>"
    return repr(value)

"""The folder in which this program keeps, for a user, what it can make anew."""

from __future__ import annotations

import os
from pathlib import Path


def own_cache(what: str) -> Path | None:
    """A folder of the user's for one kind of things, whether or not it is there; None for a user without a home."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(home) / "lightdepth" / what

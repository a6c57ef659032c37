"""A published comparison as one file: which sequences stand in its tables, in which order, and what was published.

    name: C3VD, ...
    fps: 50                                                     # where the data set's own times are not the paper's
    groups: [{title: Short sequences, sequences: {t2a: trans_t2_a, ...}, surface: true}, ...]
    published: {trajectory: {ROW: [...]}, surface: {METHOD: {ROW: [...]}}, depth: {METHOD: {rmse_mm: 5.6}}}

Rows hold a number or null for each sequence, and the mean of each group of several behind its sequences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from lightdepth.datasets.catalogue import SequenceName, read_yaml
from lightdepth.datasets.splits import located
from lightdepth.errors import InputError

_Row = list[float | None]


class _Group(BaseModel):
    model_config = ConfigDict(extra="forbid")
    title: str
    sequences: Annotated[
        dict[Annotated[str, Field(pattern=r"^[\w-]+$", max_length=100)], SequenceName], Field(min_length=1)
    ]
    surface: bool = True


class _Published(BaseModel):
    model_config = ConfigDict(extra="forbid")
    trajectory: dict[str, _Row] = {}
    surface: dict[str, dict[str, _Row]] = {}
    depth: dict[str, dict[str, float]] = {}


class _SuiteFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str
    fps: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    groups: Annotated[list[_Group], Field(min_length=1)]
    published: _Published = _Published()


@dataclass(frozen=True)
class Suite:
    """Groups of columns, each with a mean behind it where it has several; `surface_groups` have a true surface. Folders
    by column. Published rows as the module's docstring has them."""

    groups: Sequence[Sequence[str]]
    surface_groups: Sequence[Sequence[str]]
    folders: Mapping[str, str] = field(default_factory=dict)
    fps: float | None = None
    trajectory: Mapping[str, Sequence[float | None]] = field(default_factory=dict)
    surface: Mapping[str, Mapping[str, Sequence[float | None]]] = field(default_factory=dict)
    depth: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


def alone(names: Sequence[str]) -> Suite:
    """Sequences side by side, with nothing published."""
    return Suite((tuple(names),), (tuple(names),))


def read_suite(path: Path) -> Suite:
    """The suite in a file. Raises InputError where a sequence is named twice or a row has not a number for each."""
    from lightdepth.metrics import NAMES  # brings torchmetrics, which takes seconds to import

    found = read_yaml(path, _SuiteFile)
    groups = [tuple(g.sequences) for g in found.groups]
    surface = [tuple(g.sequences) for g in found.groups if g.surface]
    folders: dict[str, str] = {}
    for group in found.groups:
        for column, folder in group.sequences.items():
            if column in folders or folder in folders.values():
                raise InputError(path, f"{column} ({folder}) is there twice", "remove one of the two")
            folders[column] = folder
    rows = [(r, v, groups) for r, v in found.published.trajectory.items()]
    rows += [(f"{m}: {r}", v, surface) for m, of in found.published.surface.items() for r, v in of.items()]
    for row, values, of in rows:
        expected = sum(len(g) + (len(g) > 1) for g in of)
        if len(values) != expected:
            raise InputError(
                path,
                f"published row {row!r} has {len(values)} values",
                f"expected {expected}: each sequence, and the mean of each group",
            )
    for method, errors in found.published.depth.items():
        odd = sorted(set(errors) - set(NAMES))
        if odd:
            raise InputError(path, f"published depth of {method}: {odd[0]}", f"expected one of {', '.join(NAMES)}")
    p = found.published
    return Suite(groups, surface, folders, found.fps, p.trajectory, p.surface, p.depth)


def present(suite: Suite, runs: Path, truth: Path) -> tuple[dict[str, tuple[Path, Path]], dict[str, str]]:
    """By column: what is judged and its sequence, for those that have both; and for the others what is missing.

    Raises InputError when none has both."""
    pairs: dict[str, tuple[Path, Path]] = {}
    missing: dict[str, str] = {}
    for column, folder in suite.folders.items():
        run, sequence = located(runs, folder), located(truth, folder)
        if run is not None and sequence is not None:
            pairs[column] = (run, sequence)
        else:
            where = [str(root) for root, found in ((runs, run), (truth, sequence)) if found is None]
            missing[column] = f"{folder} is not in {' nor in '.join(where)}"
    if not pairs:
        raise InputError(
            "the suite",
            f"no sequence of it is there: {'; '.join(missing.values())}",
            "expected folders named as in the suite",
        )
    return pairs, missing

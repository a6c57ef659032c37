"""The trainings of an ablation, checked before the first of them begins."""

from __future__ import annotations

import copy
from argparse import ArgumentError
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from jsonargparse import ArgumentParser, Namespace

from lightdepth.command_line.gone_settings import without_given
from lightdepth.command_line.presets import shipped
from lightdepth.command_line.settings_yaml import read_settings
from lightdepth.errors import InputError
from lightdepth.regular import regular
from lightdepth.reporting.run import plain

from ..colons import TubeData, colon_seeds
from ..parser import as_yaml
from .rows import JudgedColons, Row, Settings


@dataclass(frozen=True)
class Plan:
    """A row of a seed."""

    row: Row
    """what is changed"""
    seed: int
    """number that draws colons, weights and order"""
    path: Path
    """file that its result goes to"""
    config: Namespace
    """its settings as the parser of `train` has them"""
    stamp: object
    """what the result depends on, in plain values: a file with another stamp is made anew"""


def check(output: Path, rows: Sequence[Row], judged: Sequence[JudgedColons], seeds: Sequence[int]) -> None:
    """Raises InputError where there is nothing to train or to judge on, or two things have one name."""
    if output.exists() and not output.is_dir():
        raise InputError(output, "is a file", "expected a folder to write the run to")
    for what, given in (("rows", rows), ("judged colons", judged), ("seeds", seeds)):
        if not given:
            raise InputError(
                "ablate", f"no {what}", "give --config configs/ablation/lightdepth.yaml or one of your own"
            )
    for what, names in (("rows", [row.file for row in rows]), ("judged colons", [colons.name for colons in judged])):
        twice = sorted({name for name in names if names.count(name) > 1 or not name})
        if twice:
            raise InputError(
                "ablate", f"{what} {', '.join(map(repr, twice))} twice or empty", "every one needs its own name"
            )
    if rows[0].seeds is not None or len(rows[0].told) != 1:
        raise InputError(
            f"row {rows[0].name!r}",
            "seeds or told of its own, though all are compared with this first row",
            "leave them out",
        )


def check_apart(tube: TubeData, judged: Sequence[JudgedColons], seeds: Sequence[int]) -> None:
    """Raises InputError where colons that are judged on are also trained on."""
    for seed in seeds:
        for trained in colon_seeds(tube, seed):
            for colons in judged:
                both = range(max(trained.start, colons.first), min(trained.stop, colons.seeds.stop))
                if both:
                    raise InputError(
                        f"judged colons {colons.name!r}",
                        f"{both[0]} is trained on with seed {seed}",
                        "choose others to judge on",
                    )


def plans_of(
    parser: ArgumentParser,
    output: Path,
    base: Path,
    common: Settings,
    rows: Sequence[Row],
    judged: Sequence[JudgedColons],
    seeds: Sequence[int],
) -> list[Plan]:
    """Every row of every seed, checked before the first of them is trained."""
    plans, defaults = [], parser.get_defaults()
    for row in rows:
        where = f"row {row.name!r}"
        values = _read(shipped(base))
        if row.preset is not None:
            values["model"] = _read(shipped(row.preset)).get("model", {})
        for dotted, value in {**common, **(row.settings or {})}.items():
            if isinstance(defaults.get(dotted), Namespace) and not isinstance(value, dict):
                raise InputError(where, f"{dotted} is a group of options", f"give one of them, as {dotted}.NAME")
            _set(values, dotted, value, where)
        without_given(values)
        for seed in row.seeds or seeds:
            folder = output / f"seed_{seed}" / row.file
            try:
                config = parser.parse_object({**values, "seed": seed, "output": str(folder)})
                if seed == (row.seeds or seeds)[0]:
                    parser.instantiate(config)
            except (ArgumentError, ImportError) as error:  # the second is of a class that settings name
                reason = " ".join(str(error).split())
                raise InputError(where, reason, "expected options of `lightdepth train`") from error
            except InputError as error:
                raise error.within(where) from error
            stamp = plain({"settings": as_yaml(parser, config), "told": row.told, "judged": judged})
            plans.append(Plan(row, seed, folder.with_suffix(".json"), config, stamp))
    plans.sort(key=lambda plan: (list(seeds) + [plan.seed]).index(plan.seed))  # a seed's colons are rendered once
    return plans


def _read(path: Path) -> dict[str, Any]:
    regular(path, "expected a YAML like configs/train/*.yaml")
    try:
        values = read_settings(path)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(
            path, f"cannot be read as a training preset ({error})", "expected a YAML like configs/train/*.yaml"
        ) from error
    if not isinstance(values, dict):
        raise InputError(path, "not a training preset", "expected a YAML like configs/train/*.yaml")
    return values


def _set(values: dict[str, Any], dotted: str, value: Any, where: str) -> None:
    """values["a"]["b"] = value for "a.b"."""
    *groups, last = dotted.split(".")
    for group in groups:
        values = values.setdefault(group, {})
        if not isinstance(values, dict):
            raise InputError(where, f"{dotted}: {group} is an option, not a group of them", "leave out what follows it")
    values[last] = copy.deepcopy(value)

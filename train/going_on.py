"""What a run that goes on is told of the one that it goes on with: other settings, another length."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from lightdepth import plain_yaml
from lightdepth.errors import InputError
from lightdepth.module import LightDepth

from .checkpoints import Start

_LENGTH = ("max_steps", "max_epochs", "min_steps", "min_epochs", "max_time")
"""Of the Trainer: what a run is made longer with, which is what `--resume` is for."""
_WATCHING = ("enable_progress_bar", "enable_model_summary", "profiler", "log_every_n_steps", "logger")
"""Of the Trainer: what changes no weight."""
_MOST = 6
"""Settings that are named; another preset changes dozens."""


def settings_before(folder: Path) -> Mapping[str, Any] | None:
    """The settings that the run in a folder had until now; None where they are gone or cannot be read."""
    try:
        found = plain_yaml.read(folder / "config.yaml")
    except InputError:
        return None
    return found if isinstance(found, Mapping) else None


def warn_of_settings(echo: Callable[[str], None], before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> None:
    """One line with the settings that change what is learned and were others until now."""
    if before is None:
        return
    then, here = dict(_flat(before)), dict(_flat(now))
    changed = [name for name in here if name in then and then[name] != here[name] and _matters(name)]
    if changed:
        listed = ", ".join(f"{_option(name)} was {then[name]} and is {here[name]}" for name in changed[:_MOST])
        listed += f" and {len(changed) - _MOST} more" if len(changed) > _MOST else ""
        echo(f"warning: the steps until now had other settings: {listed}; the result is that of neither alone")


def warn_of_length(echo: Callable[[str], None], model: LightDepth, start: Start, steps: int) -> None:
    """A learning rate that depends on the length of the run was another one until now."""
    planned, schedule = start.planned, model.schedule
    if schedule == "constant" or steps <= 0 or math.isnan(planned) or planned == steps or not start.step:
        return
    echo(
        f"warning: the first {start.step} steps were of a run of {planned:.0f}, and the learning rate of "
        f"--model.schedule {schedule} follows from its length: the result is not that of {steps} steps at once"
    )


def _flat(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Each setting by its dotted name, as text that does not tell a list from a tuple nor 1 from 1.0."""
    for key, value in settings.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping):
            yield from _flat(value, f"{name}.")
        else:
            yield name, yaml.safe_dump(value, default_flow_style=True, width=10**6).split("\n")[0]


def _matters(name: str) -> bool:
    group, _, rest = name.partition(".")
    return not (group == "trainer" and rest in (*_LENGTH, *_WATCHING)) and name != "data.num_workers"


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"

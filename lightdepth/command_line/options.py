"""How the signature of a verb becomes its options.

A parameter is an option. A parameter annotated as `Group[SomeDataclass]` is as many options as the dataclass has
fields, each under its own name, without the name of the parameter: `source: Group[SequenceSource]` gives `data`,
`--format`, `--camera` and so on. Other dataclasses become dotted options (`--fusion.voxel`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

_GROUP = "its fields are options"
_Fields = TypeVar("_Fields")
Group = Annotated[_Fields, _GROUP]


def groups_of(function: Callable[..., Any]) -> dict[str, type]:
    """The dataclasses of a verb's parameters whose fields are options, by parameter."""
    hints = get_type_hints(function, include_extras=True)
    return {name: hint.__origin__ for name, hint in hints.items() if getattr(hint, "__metadata__", ()) == (_GROUP,)}


def add_groups(parser: ArgumentParser, function: Callable[..., Any]) -> None:
    """Adds the options of all groups; the defaults are those of the parameter, where it has one."""
    for name, group in groups_of(function).items():
        parser.add_class_arguments(group, as_positional=True, sub_configs=True)
        default = inspect.signature(function).parameters[name].default
        if default is not inspect.Parameter.empty:
            parser.set_defaults(
                {
                    name: asdict(v) if is_dataclass(v) and not isinstance(v, type) else v
                    for name, v in vars(default).items()
                }
            )


def with_groups(function: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a verb, its groups made of their fields."""
    groups = groups_of(function)
    return {
        name: groups[name](**{field.name: values[field.name] for field in fields(groups[name])})
        if name in groups
        else values[name]
        for name in inspect.signature(function).parameters
    }

"""Verbs called with their options by name, as the command line gives them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import Any

from lightdepth.command_line.options import groups_of, with_groups


def by_options(verb: Callable[..., Any]) -> Callable[..., Any]:
    """The verb with the fields of its groups as arguments of their own. Arguments without a name are, in this order,
    what has no default, the truth, and the verb's own."""
    groups, defaults = groups_of(verb), {}
    own = [name for name in inspect.signature(verb).parameters if name not in groups]
    for name, parameter in inspect.signature(verb).parameters.items():
        if name in groups:
            given = parameter.default
            for field in fields(groups[name]):
                missing = field.default is MISSING and field.default_factory is MISSING
                empty = given is inspect.Parameter.empty
                default = field.default if field.default_factory is MISSING else field.default_factory()
                defaults[field.name] = (MISSING if missing else default) if empty else getattr(given, field.name)
        else:
            defaults[name] = MISSING if parameter.default is inspect.Parameter.empty else parameter.default

    def called(*positional: Any, **named: Any) -> Any:
        needed = [name for name, default in defaults.items() if default is MISSING]
        order = dict.fromkeys([*needed, *(["truth"] if "truth" in defaults else []), *own])
        given = dict(zip(order, positional, strict=False)) | named
        unknown = set(given) - set(defaults)
        assert not unknown, f"no options {sorted(unknown)}"
        return verb(**with_groups(verb, defaults | given))

    return called

"""Kinds of values, in words: what an option takes, and what stands for it in help."""

from __future__ import annotations

import itertools
import types
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

METAVARS = {int: "N", float: "N", Path: "PATH", str: "TEXT", dict: "MAPPING"}


def placeholder(kind: Any) -> str:
    """What stands for a value of a type in the help."""
    parts = get_args(kind)
    if get_origin(kind) is Literal:
        return f"{{{','.join(map(str, parts))}}}"
    if get_origin(kind) is list or (get_origin(kind) is tuple and parts[1:] == (...,)):
        return f"[{placeholder(parts[0])}, ...]"
    if get_origin(kind) is tuple:
        return f"[{', '.join(map(placeholder, parts))}]"
    return METAVARS.get(kind, getattr(kind, "__name__", "VALUE").upper())


def leaves(kind: Any) -> set[Any]:
    """The types that a type is made of, without None and the values of Literals."""
    if get_origin(kind) is Literal or kind in (None, type(None), bool, ...):
        return set()
    parts = get_args(kind)
    return {leaf for part in parts for leaf in leaves(part)} if parts else {kind}


def choices_of_type(kind: Any) -> Iterator[Any]:
    """The types that a type allows, without None."""
    if get_origin(kind) in (Union, types.UnionType):
        for one in get_args(kind):
            yield from choices_of_type(one)
    elif kind is not None and kind is not type(None):
        yield kind


def literals(kind: Any) -> tuple[Any, ...]:
    """The values of a Literal, or of the Literals in a list."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    return tuple(c for part in get_args(kind) for c in literals(part))


def expected(kind: Any) -> str:
    """A type in words: what a value must be."""
    return " or ".join(dict.fromkeys(_in_words(one) for one in choices_of_type(kind)))


def _in_words(kind: Any) -> str:
    plain = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}
    if kind in plain:
        return plain[kind]
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    parts = get_args(kind)
    many = {int: "whole numbers", float: "numbers", str: "words", Path: "paths"}
    if get_origin(kind) in (list, tuple) and parts:
        each = many.get(parts[0], expected(parts[0]))
        if get_origin(kind) is list or parts[1:] == (...,):
            return f"a list of {each}" if parts[0] in many else f"a list, each {each}"
        return f"{len(parts)} {each}, as {placeholder(kind)}"
    if get_origin(kind) is dict or kind is dict:
        return "a mapping of names to values"
    return typing.cast(str, getattr(kind, "__name__", str(kind)))


def list_apart(argv: Sequence[str], first: str) -> str:
    """A list of which each number was typed as a word of its own, from its first on, as one word; "" where none was."""
    at = argv.index(first) if first in argv else len(argv)
    together = list(itertools.takewhile(lambda word: word.replace(".", "", 1).isdecimal(), argv[at:]))
    return f"[{','.join(together)}]" if len(together) > 1 else ""

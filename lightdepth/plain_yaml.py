"""YAML of strangers: plain values only, and no more of them than the text has a right to.

An alias (`*name`) stands for all that its anchor (`&name`) holds: nine lines of aliases, each ten times the one before,
are a thousand million values. So nodes are counted as if every alias were written out, while they are composed and
before anything is made of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

MAX_BYTES = 4_000_000
MAX_NODES = 100_000
"""Values and keys, those that aliases stand for counted each time."""
MAX_DEPTH = 50


class Loader(yaml.SafeLoader):
    """A safe loader that stops at a limit. Readers with words of their own derive from it."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._nodes = self._depth = 0
        self._held: dict[str, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        anchor = event.anchor
        if isinstance(event, yaml.AliasEvent):
            if anchor in self.anchors and anchor not in self._held:
                raise yaml.YAMLError(f"*{anchor} stands inside what it stands for")
            self._count(self._held.get(anchor, 1))
            return super().compose_node(parent, index)
        before = self._nodes
        self._count(1)
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise yaml.YAMLError(f"nested more than {MAX_DEPTH} deep")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if anchor is not None:
            self._held[anchor] = self._nodes - before
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (AttributeError, LookupError, TypeError) as error:  # `!!bool x`, `!!timestamp x`
            problem = f"is no {node.tag.rpartition(':')[2]}"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from error

    def _count(self, more: int) -> None:
        self._nodes += more
        if self._nodes > MAX_NODES:
            raise yaml.YAMLError(f"more than {MAX_NODES} values, with its aliases written out")


def read(path: Path, loader: type[Loader] = Loader) -> Any:
    """What a YAML file holds. Raises OSError, UnicodeDecodeError or yaml.YAMLError."""
    with path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise yaml.YAMLError(f"longer than {MAX_BYTES} bytes")
    return load(content.decode("utf-8-sig"), loader)


def load(text: str, loader: type[Loader] = Loader) -> Any:
    """What a text in YAML holds. Raises yaml.YAMLError, whatever it is that does not fit."""
    check_length(text)
    try:
        return yaml.load(text, loader)
    except (ValueError, OverflowError, RecursionError) as error:  # a date without such a day, a number of 5000 digits
        raise yaml.YAMLError(str(error)) from error


def check(text: str) -> None:
    """Raises yaml.YAMLError where another loader should not be given this text."""
    check_length(text)
    loader = Loader(text)
    try:
        loader.get_single_node()
    except (ValueError, RecursionError) as error:
        raise yaml.YAMLError(str(error)) from error
    finally:
        loader.dispose()


def check_length(text: str) -> None:
    if len(text) > MAX_BYTES:
        raise yaml.YAMLError(f"longer than {MAX_BYTES} characters")

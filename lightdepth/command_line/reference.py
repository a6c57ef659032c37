"""The command line as a page of the documentation: every verb with all its options, taken from the parsers."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from html import escape

from lightdepth.command_line.parsing import Parser
from lightdepth.command_line.verbs import all_verbs, parsers_of
from lightdepth.command_line.words import options
from lightdepth.counting import counted

_BEGINNING = """# Command line

Every verb with all its options, as `--help-all` shows them. Options of a group have a dot in their name, as in
`--fusion.voxel`. Every verb also takes these:

- `--help`: the everyday options, with examples; `--help-all`: all of them.
- `--config FILE`: a YAML file with any of the options; those on the command line take precedence.
- `--print-config`: prints such a file with all settings.
- `--quiet`: only errors, warnings, and what was written where.
- `--json`: the result as one JSON document.
"""
_OF_ALL = ("help", "config", "print_config", "quiet", "json")
_CODE = re.compile(r"`([^`]+)`")


def reference() -> str:
    """Markdown with a heading for each verb, and for each other way to call one."""
    parts = [_BEGINNING]
    for verb, entry in all_verbs().items():
        for way, parser in parsers_of(verb, entry.load()).items():
            parts.append(f"## {f'{verb} {way}'.strip()}\n")
            parts.extend(_of_verb(parser))
    return "\n".join(parts)


def _of_verb(parser: Parser) -> Iterator[str]:
    yield f"<p>{_sentence(parser.description or '')}</p>\n"
    if parser.page.examples:
        yield "\n".join(("```", *parser.page.examples, "```")) + "\n"
    typed = {id(action) for action in options(parser)}
    for group in parser._action_groups:
        shown = [a for a in group._group_actions if id(a) in typed and a.dest not in _OF_ALL]
        if group is parser._optionals:
            yield f"<dl>{_rows(parser, shown)}</dl>\n"
        elif shown:
            title = f"{counted(len(shown), 'option')}: {parser.with_dashes(group.title or '')}"
            yield f"<details><summary>{_sentence(title)}</summary><dl>{_rows(parser, shown)}</dl></details>\n"


def _rows(parser: Parser, shown: list[argparse.Action]) -> str:
    formatter, rows = parser._get_formatter(), []
    for action in shown:
        # argparse's own method: that of jsonargparse needs to know which parser is being printed
        typed = argparse.HelpFormatter._format_action_invocation(formatter, action)
        said = formatter._expand_help(action) if action.help else ""
        name = typed if action.option_strings else action.dest.upper()
        rows.append(
            f"<dt><code>{escape(parser.with_dashes(name))}</code></dt><dd>{_sentence(parser.with_dashes(said))}</dd>"
        )
    return "".join(rows)


def _sentence(text: str) -> str:
    return _CODE.sub(r"<code>\1</code>", escape(" ".join(text.split()), quote=False))

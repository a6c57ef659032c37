r"""Text that strangers wrote (names of frames, what their files say) where it could be taken for a command.

A terminal obeys the escape sequences in a name, and a spreadsheet computes a cell that begins like a formula. A browser
writes backwards from a sign in a name on; and with the end of a line in it, a name makes two lines of one error.
"""

from __future__ import annotations

import re

_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""All but tabs and ends of lines; also what turns the direction of writing round."""

_ENDS = re.compile("[\n\u2028\u2029]")
"""Ends of lines, besides those among the control characters."""

_FORMULA = re.compile("'*[=+@\t\r-]")
"""How a cell begins that a spreadsheet computes; after quotation marks too, so that what is marked is told apart."""


def for_terminal(text: str) -> str:
    r"""The text with control characters written out, as in `\x1b[31m`."""
    return _CONTROLS.sub(lambda found: ascii(found[0])[1:-1], text)


def for_line(text: str) -> str:
    r"""As for_terminal, of what has to stay one line: ends of lines are written out too, as in `\n`."""
    return _ENDS.sub(lambda found: ascii(found[0])[1:-1], for_terminal(text))


def for_table(text: str) -> str:
    """The text as a cell of a table that spreadsheets open: one that looks like a formula gets a quotation mark."""
    return f"'{text}" if _FORMULA.match(text) and not _is_number(text) else text


def from_table(cell: str) -> str:
    """The text that `for_table` made a cell of."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True

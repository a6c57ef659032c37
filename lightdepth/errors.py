"""What a user can do wrong, told apart from what we did wrong.

`InputError` is for the user's files and numbers: its message says what was found, where, and what would be right. The
command line prints it without a traceback and exits with 3. Our own mistakes stay asserts.
"""


class InputError(ValueError):
    """Input that cannot be used: missing, unreadable, or contradicting itself."""


class PartialFailure(RuntimeError):
    """Part of the work failed; the rest was done and written. Exit code 4; `run.json` says what failed."""

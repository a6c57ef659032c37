"""Modules under their old names, for one release."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from importlib.util import find_spec

import pytest

from lightdepth.moved import MOVED


def told(program: str, *flags: str) -> subprocess.CompletedProcess[str]:
    """What a program prints in a process of its own."""
    argv = [sys.executable, *flags, "-c", textwrap.dedent(program)]
    return subprocess.run(argv, capture_output=True, text=True, check=False)


def test_the_table_is_installed_with_the_package_and_loads_nothing_else():
    done = told("import sys, lightdepth; print([f for f in sys.meta_path if type(f).__name__ == '_Moved'] != [])")
    assert done.stdout == "True\n"


def test_an_old_name_gives_the_new_module_and_one_warning_that_names_it():
    done = told(
        """
        import warnings
        import lightdepth
        from lightdepth.moved import install
        install({"lightdepth.ancient": "lightdepth.errors"})
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            from lightdepth.ancient import InputError
            import lightdepth.ancient
        import lightdepth.errors
        assert InputError is lightdepth.errors.InputError and lightdepth.ancient is lightdepth.errors
        for one in said:
            print(one.category.__name__, one.message, one.filename)
        """
    )
    assert done.stdout == (
        "DeprecationWarning lightdepth.ancient is now lightdepth.errors; the next release drops the old name <string>\n"
    ), done.stderr


def test_an_old_module_never_takes_the_place_of_a_public_name():
    done = told(
        """
        import lightdepth
        from lightdepth.moved import install
        install({"lightdepth.read_map": "lightdepth.errors"})
        import lightdepth.read_map
        from lightdepth.read_map import InputError
        print(callable(lightdepth.read_map), InputError.__name__)
        """
    )
    assert done.stdout == "True InputError\n", done.stderr


@pytest.mark.parametrize("old", MOVED)
def test_every_old_name_leads_to_a_module_that_is_there(old):
    assert find_spec(MOVED[old]) is not None, old
    package, _, _ = old.rpartition(".")
    assert find_spec(package) is not None and MOVED[old] not in MOVED

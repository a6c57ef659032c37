"""The library face: public names, and the page that shows each of them at work."""

from __future__ import annotations

import doctest
import pkgutil
import re
from importlib import import_module
from pathlib import Path

import pytest
from colons import colon, slam

from lightdepth.tube.export import write_synthetic

PAGE = Path(__file__).parent.parent / "docs" / "api.md"
PACKAGES = ("lightdepth", "densify")


def test_the_page_does_what_it_says(tmp_path, monkeypatch):
    frames = colon(0, 8).frames
    write_synthetic(frames, slam(frames), tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    test = doctest.DocTestParser().get_doctest("".join(blocks), {}, PAGE.name, str(PAGE), 0)
    said: list[str] = []
    found = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, out=said.append)
    assert found.attempted > 30 and found.failed == 0, "".join(said)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_there_on_the_page_and_no_submodule_takes_its_place(package):
    module = import_module(package)
    submodules = {found.name for found in pkgutil.iter_modules(module.__path__)}
    assert not submodules & set(module.__all__)
    for name in module.__all__:
        assert getattr(module, name) is not None and re.search(rf"\b{name}\b", PAGE.read_text()), name
    assert set(dir(module)) == {*module.__all__, "__version__"}
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        module.nothing  # noqa: B018


def test_the_names_for_type_checkers_are_those_that_are_there():
    for package in PACKAGES:
        source = (Path(import_module(package).__file__)).read_text()
        named = set(re.findall(r"import (\w+) as \1\n", source)) - {"__version__"}
        assert named == set(import_module(package).__all__)


def test_what_is_shown_of_frames_maps_and_results_fits_on_a_few_lines():
    frames = colon(0, 8).frames
    found = slam(frames)
    for shown in (frames[0], found.map, found.map.submaps[0], found.map.submaps[0].keyframes[0]):
        assert len(repr(shown)) < 600, repr(shown)

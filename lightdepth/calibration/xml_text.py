"""XML of calibrations: read safely, and OpenCV's FileStorage as the mappings that its YAML is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import defusedxml.ElementTree
from defusedxml import DefusedXmlException

from lightdepth.errors import InputError
from lightdepth.files.text import read_text

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


def xml_root(path: Path) -> Element:
    """The outermost element. Entities and DTDs are refused."""
    text = read_text(path, "expected an XML of vicalib's or OpenCV's").lstrip("\ufeff")
    try:
        root: Element = defusedxml.ElementTree.fromstring(text, forbid_dtd=True)
    except DefusedXmlException as error:
        raise InputError(path, "has a DTD or entities, which are refused", "expected plain XML") from error
    except SyntaxError as error:
        raise InputError(path, f"not valid XML ({error})", "correct it there") from error
    return root


def opencv_fields(path: Path) -> dict[str, Any] | None:
    """Everything in an `<opencv_storage>` by its tag in small letters; None where the file is another program's."""
    root = xml_root(path)
    if root.tag != "opencv_storage":
        return None
    try:
        return {child.tag.lower(): _value(child) for child in root}
    except RecursionError as error:
        raise InputError(path, "elements nested without end", "expected OpenCV's XML") from error


def _value(element: Element) -> Any:
    """A mapping, a list, a number or a word: a matrix has rows, cols and data, a list's elements are `_`."""
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_value(child) for child in children]
    if children:
        return {child.tag: _words(child) if child.tag == "data" else _value(child) for child in children}
    text = (element.text or "").strip()
    if text.startswith('"'):
        return text.strip('"')
    words = _words(element)
    return words[0] if len(words) == 1 else words


def _words(element: Element) -> list[str]:
    return (element.text or "").split()

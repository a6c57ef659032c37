"""JSON files and their fields, checked against a schema; errors name the file and the field."""

from __future__ import annotations

import json
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from lightdepth.errors import InputError

_Schema = TypeVar("_Schema", bound=BaseModel)


def read_json(path: Path) -> Any:
    """Parsed JSON, with the file named in every error."""
    try:
        return json.loads(Path(path).read_text())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error


def checked_fields(schema: type[_Schema], data: Any, where: str) -> _Schema:
    """The fields of a file as its schema has them; `where` names the file in the InputError of what does not fit."""
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        *above, last = [str(part) for part in first["loc"] if part != "[key]"] or ["the file"]
        field = ".".join([*above, last])
        known = _known(schema, above)
        expected = f"; expected {', '.join(known)}" if known else ""
        if first["type"] == "missing":
            message = f"{field} missing{expected}"
        elif first["type"] == "extra_forbidden":
            close = get_close_matches(last, known, 1, cutoff=0.75)
            message = f"{field} is not known{f' (is {close[0]} meant?)' if close else ''}{expected}"
        else:
            message = f"{field}: {first['msg'].removeprefix('Value error, ')}"
            found = first["input"]
            if isinstance(found, str | int | float | bool | None) and repr(found) not in message:
                message += f"; found {found!r}"
        raise InputError(f"{where}: {message}") from error


def _known(schema: type[BaseModel], above: list[str]) -> list[str]:
    """The fields below the keys `above`; none where these lead to something else than a schema."""
    for key in above:
        inner = schema.model_fields[key].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        schema = inner
    return list(schema.model_fields)

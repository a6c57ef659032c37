"""JSON files and their fields, checked against a schema; errors name the file and the field."""

from __future__ import annotations

import json
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from lightdepth.errors import InputError
from lightdepth.regular import regular

_Schema = TypeVar("_Schema", bound=BaseModel)


def read_json(path: Path) -> Any:
    """Parsed JSON, with the file named in every error."""
    regular(path)
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(
            path, f"cannot be read ({error.strerror or error})", "expected a file that is there and may be read"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(path, f"not UTF-8 (at byte {error.start})", "save it as UTF-8") from error
    except ValueError as error:
        raise InputError(path, f"not valid JSON ({error})", "correct it there") from error
    except RecursionError as error:
        raise InputError(path, "not valid JSON (brackets nested without end)", "correct it there") from error


def checked_fields(schema: type[_Schema], data: Any, where: str) -> _Schema:
    """The fields of a file as its schema has them; `where` names the file in the InputError of what does not fit."""
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        *above, last = [str(part) for part in first["loc"] if part != "[key]"] or ["the file"]
        field = ".".join([*above, last])
        known = _known(schema, above)
        expected = f"expected {', '.join(known)}" if known else "correct it there"
        if first["type"] == "missing":
            raise InputError(where, f"{field} missing", expected) from error
        if first["type"] == "extra_forbidden":
            close = get_close_matches(last, known, 1, cutoff=0.75)
            hint = f" (is {close[0]} meant?)" if close else ""
            raise InputError(where, f"{field} is not known{hint}", expected) from error
        found, message = first["input"], first["msg"].removeprefix("Value error, ")
        said, _, cure = message.partition("; ")
        if not cure:
            plain = isinstance(found, str | int | float | bool | None)
            said, cure = f"found {found!r}" if plain else f"found {type(found).__name__}", said[0].lower() + said[1:]
        raise InputError(where, f"{field}: {said}", cure) from error


def _known(schema: type[BaseModel], above: list[str]) -> list[str]:
    """The fields below the keys `above`; none where these lead to something else than a schema."""
    for key in above:
        inner = schema.model_fields[key].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        schema = inner
    return list(schema.model_fields)

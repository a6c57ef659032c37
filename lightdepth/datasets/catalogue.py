"""dataset.yaml: what is known of a public data set, for machines. Its card, README.md beside it, says it in sentences.

name: C3VD
format: c3vd            # open_sequence's and --format's; left out where no reader is for it
licence: CC BY-NC-SA 4.0
url: https://...
unit: mm                # of the truth that the reader gives; none where there is no truth
sequences: {trans_t2_a: 194, trans_t1_a: null}      # folder below the data's root: frames, null where not known
cameras: {v1: {model: ..., width: ..., ...}}        # as camera.json has it, where one is published
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from lightdepth import plain_yaml
from lightdepth.calibration import camera_from_fields
from lightdepth.camera import CameraModel
from lightdepth.datasets.reading import FORMATS
from lightdepth.errors import InputError
from lightdepth.files.schema import checked_fields
from lightdepth.regular import regular

_Schema = TypeVar("_Schema", bound=BaseModel)


def inside(name: str) -> str:
    """The name of a folder below the data's root, or InputError when it leads anywhere else, or can be of no folder."""
    parts = name.replace("\\", "/").split("/")
    if not name.strip() or name.startswith(("/", "~")) or ".." in parts or ":" in parts[0]:
        raise InputError(repr(name), "leads outside the data's root", "expected the name of a folder below it")
    longest = max(len(part.encode("utf-8", "surrogatepass")) for part in parts)
    if longest > 255 or len(name) > 1000 or "\0" in name:
        said = "a zero" if "\0" in name else f"{longest} bytes in one part" if longest > 255 else f"{len(name)} letters"
        raise InputError(f"{name[:40]!r} ...", f"no folder has such a name: {said}", "expected one that can be there")
    return "/".join(part for part in parts if part not in ("", "."))


def _readable(format: str) -> str:
    if format not in FORMATS:
        raise ValueError(f"no reader for {format!r}; expected one of {', '.join(FORMATS)}, or none")
    return format


SequenceName = Annotated[str, Field(min_length=1), AfterValidator(inside)]


class _DatasetFile(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: Annotated[str, Field(min_length=1)]
    format: Annotated[str, AfterValidator(_readable)] | None = None
    licence: Annotated[str, Field(min_length=1)]
    url: Annotated[str, Field(min_length=1)]
    unit: Literal["mm", "none"]
    sequences: dict[SequenceName, Annotated[int, Field(gt=0)] | None] = {}
    cameras: dict[str, dict[str, Any]] = {}


@dataclass(frozen=True)
class DatasetInfo:
    """A data set: frames by sequence (None where not known), cameras by name, in our pixel convention."""

    name: str
    format: str | None
    licence: str
    url: str
    unit: str
    sequences: Mapping[str, int | None]
    cameras: Mapping[str, CameraModel]


def read_dataset_yaml(path: Path) -> DatasetInfo:
    """What a dataset.yaml says. Raises InputError, naming file and field."""
    found = read_yaml(path, _DatasetFile)
    cameras = {name: camera_from_fields(data, f"{path}: cameras.{name}") for name, data in found.cameras.items()}
    return DatasetInfo(found.name, found.format, found.licence, found.url, found.unit, found.sequences, cameras)


def read_yaml(path: Path, schema: type[_Schema]) -> _Schema:
    """A YAML file of ours, read by a safe loader; InputError names the file, and the field or the line."""
    regular(path)
    try:
        data = plain_yaml.read(path, _Loader)
    except OSError as error:
        raise InputError(
            path, f"cannot be read ({error.strerror or error})", "expected a file that is there and may be read"
        ) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(path, f"not valid YAML ({' '.join(str(error).split())[:200]})", "correct it there") from error
    if not isinstance(data, dict):
        raise InputError(path, "no keys in it", f"expected {', '.join(schema.model_fields)}")
    return checked_fields(schema, data, str(path))


class _Loader(plain_yaml.Loader):
    """A safe loader that refuses a key written twice, which YAML's own would take for the last one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        twice = next((key for i, key in enumerate(keys) if key in keys[:i]), None)
        if twice is not None:
            raise ValueError(f"the key {twice} is there twice; keep one of them")
        return super().construct_mapping(node, deep)

"""read_map: which format a path holds, found by looking."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from lightdepth.calibration.json_files import camera_from_fields
from lightdepth.camera import CameraModel
from lightdepth.errors import InputError
from lightdepth.files.below import folders_in, given
from lightdepth.files.reading import reading
from lightdepth.files.schema import read_json
from lightdepth.maps.colmap import holds_model, read_submap
from lightdepth.maps.convention import COLMAP, EXPORTER, Reader
from lightdepth.maps.endocartoscope import MAPS, read_exported_submap
from lightdepth.maps.stella import first_stamp, read_stella
from lightdepth.maps.tum import (
    POINTS_NEEDED,
    WITHOUT_POINTS,
    begun,
    first_entry,
    holds_points,
    holds_trajectory,
    is_trajectory,
    read_tum_map,
)
from lightdepth.sparse_map import SparseMap, Submap, with_provenance

_ACCEPTED = (
    "expected a COLMAP model (cameras, images, points3D as .txt or .bin), a folder of numbered models "
    f"(sparse/0, sparse/1), a multi-map export ({MAPS}/0, {MAPS}/1), a stella_vslam map (.msg), or a TUM trajectory "
    "with points3D.txt or a PLY, and camera.json"
)


def read_map(path: Path | str, reader: Reader = Reader()) -> SparseMap:
    """A sparse map on disk -> its submaps, by map id.

    Reads a COLMAP model folder (its id is the folder's number, or 0), a folder or its `sparse/` with numbered COLMAP
    models, and the EndoCartoScope / CLiMB tree `3D_maps/<id>` directly below, under `output/` or one run's folder;
    a stella_vslam map (.msg or .json, or the folder with the .msg, several of which, also in 0/, 1/, are submaps); a
    folder with a TUM trajectory and a point cloud. `reader` is what is known besides the files.
    Raises InputError saying what was found, where, and what would be right.
    """
    path = Path(path)
    with reading(path, "a map", _ACCEPTED):
        return _with_provenance(_read_map(path, reader), path)


def _with_provenance(sparse_map: SparseMap, path: Path) -> SparseMap:
    """The map with what camera.json says of its camera, where that lies in the map's folder, as `sparse` writes it: a
    COLMAP model has no place for it."""
    beside = _camera_beside(path.resolve())
    if beside is None:
        return sparse_map

    def known(submap: Submap) -> Submap:
        own = submap.keyframes[0].camera
        same = own.provenance is None and own.name == beside.name and _size(own) == _size(beside)
        if not same or not np.allclose(own.params, beside.params, rtol=1e-6, atol=1e-9):
            return submap
        return with_provenance(submap, beside.provenance)

    return replace(sparse_map, submaps=tuple(map(known, sparse_map.submaps)))


def _camera_beside(path: Path) -> CameraModel | None:
    """The camera of camera.json in a map's folder, or in the one that its numbered models are in, where it says where
    it is from."""
    places = [path]
    while places[-1].name == "sparse" or _is_number(places[-1].name):
        places.append(places[-1].parent)
    file = next((place / "camera.json" for place in places if (place / "camera.json").is_file()), None)
    if file is not None:
        with suppress(InputError):  # nobody asked for this file
            data = read_json(file)
            if isinstance(data, dict) and data.get("source") is not None:
                return camera_from_fields(data, str(file))
    return None


def _size(camera: CameraModel) -> tuple[int, int]:
    return camera.width, camera.height


def _read_map(path: Path, reader: Reader) -> SparseMap:
    if not path.exists():
        raise InputError(path, "no such file or folder", _ACCEPTED)
    if path.is_file() and path.suffix.lower() in (".msg", ".json"):
        return SparseMap((read_stella(path, reader, begun=_begun([path])),), str(path))
    if not path.is_dir():
        raise _why_not_file(path)
    tree = _multimap_tree(path)
    if tree is not None:
        return _read_tree(tree, path, reader)
    messages = _messages(path)
    if holds_model(path) and (path.resolve().parent.name == MAPS or not (messages or holds_trajectory(path))):
        map_id = int(path.resolve().name) if _is_number(path.resolve().name) else 0
        exported = path.resolve().parent.name == MAPS
        convention = reader.convention(path, map_id, EXPORTER if exported else COLMAP)
        if exported:
            return SparseMap((read_exported_submap(path.resolve(), map_id, convention, reader.camera),), str(path))
        return SparseMap((read_submap(path, map_id, convention),), str(path))
    for root in (path, path / "sparse"):
        if root != path and holds_model(root):
            return SparseMap((read_submap(root, 0, reader.convention(root, 0, COLMAP, (path,))),), str(path))
        folders = {i: f for i, f in _numbered(root).items() if holds_model(f)}
        if folders:
            conventions = {i: reader.convention(f, i, COLMAP, (root, path)) for i, f in folders.items()}
            return SparseMap(tuple(read_submap(f, i, conventions[i]) for i, f in folders.items()), str(path))
    if messages:
        begun = _begun(messages.values())
        submaps = tuple(read_stella(file, reader, map_id, begun) for map_id, file in messages.items())
        return SparseMap(submaps, str(path))
    if holds_trajectory(path):
        return SparseMap((read_tum_map(path, reader),), str(path))
    raise _why_not_folder(path)


def _multimap_tree(path: Path) -> Path | None:
    """The 3D_maps folder at, below, or one folder below the path; None when there is none."""
    if path.resolve().name == MAPS:
        return path
    if (path / MAPS).is_dir():
        return path / MAPS
    trees = given(sorted(path.glob(f"*/{MAPS}")), path)
    if len(trees) > 1:
        found = ", ".join(t.parent.name for t in trees)
        raise InputError(
            path, f"several runs with a {MAPS} folder ({found})", f"give one of them, e.g. {trees[0].parent}"
        )
    return trees[0] if trees else None


def _messages(path: Path) -> dict[int, Path]:
    """The stella_vslam maps of a folder, or of its folders 0/, 1/, by map id: the folder's number, else the last in the
    file's name where each has another, else their order."""
    files = sorted(path.glob("*.msg"))
    if not files:
        found = {i: sorted(folder.glob("*.msg")) for i, folder in _numbered(path).items()}
        for i, several in found.items():
            if len(several) > 1:
                names = ", ".join(file.name for file in several)
                raise InputError(path / str(i), f"several maps ({names})", "expected one in each numbered folder")
        return {i: several[0] for i, several in found.items() if several}
    if len(files) == 1:
        return {0: files[0]}
    digits = [re.findall(r"\d+", file.stem)[-1:] for file in files]
    numbers = [int(found[0]) for found in digits if found]
    return dict(sorted(zip(numbers if len(set(numbers)) == len(files) else range(len(files)), files, strict=True)))


def _begun(maps: Iterable[Path]) -> tuple[float, str] | None:
    """The first stamp of the clock of stella_vslam maps: of the trajectories beside them, or of their keyframes."""
    maps = list(maps)
    several = maps if len(maps) > 1 else []  # one alone knows its own
    stamps = [(stamp, file.name) for file in several if (stamp := first_stamp(file)) is not None]
    stamps += [found for folder in sorted({file.parent for file in maps}) if (found := begun(folder)) is not None]
    return min(stamps, default=None)


def _read_tree(tree: Path, source: Path, reader: Reader) -> SparseMap:
    folders = _numbered(tree)
    if not folders:
        raise InputError(tree, "no map in it", f"expected a folder for each map named by its number, {MAPS}/0")
    roots = (tree, tree.resolve().parent)
    submaps = []
    for map_id, folder in folders.items():
        convention = reader.convention(folder, map_id, EXPORTER, roots)
        submaps.append(read_exported_submap(folder, map_id, convention, reader.camera))
    return SparseMap(tuple(submaps), str(source))


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit()


def _numbered(root: Path) -> dict[int, Path]:
    """Sub-folders whose name is an integer, by that integer. Raises InputError when two have the same."""
    folders: dict[int, Path] = {}
    if not root.is_dir():
        return folders
    for folder in sorted(p for p in folders_in(root) if _is_number(p.name)):
        twin = folders.setdefault(int(folder.name), folder)
        if twin is not folder:
            raise InputError(
                root, f"{twin.name} and {folder.name} are both map {int(folder.name)}", "rename one of them"
            )
    return dict(sorted(folders.items()))


def _why_not_file(path: Path) -> InputError:
    if path.suffix == ".osa":
        return InputError(
            path,
            "an ORB-SLAM3 atlas, which only the build that wrote it can read",
            f"export the multi-map tree instead ({MAPS}/<id>/ with cameras.txt, images.txt, points3D.txt)",
        )
    if path.suffix == ".db":
        return InputError(path, "a data base", "if it is stella_vslam's, save the map as .msg instead")
    if path.stem in ("cameras", "images", "points3D"):
        return InputError(path, "one file of a COLMAP model", f"give the folder it is in, {path.parent}")
    if is_trajectory(path) and holds_points(path.parent):
        return InputError(path, "one file of a map", f"give the folder it is in, {path.parent}")
    if _is_trajectory(path):
        return InputError(path, WITHOUT_POINTS, POINTS_NEEDED)
    return InputError(path, "a file of no known map format", _ACCEPTED)


def _why_not_folder(path: Path) -> InputError:
    files = sorted(p for p in path.iterdir() if p.is_file())
    for file in files:
        if file.suffix == ".osa" or (file.suffix in (".txt", ".tum") and _is_trajectory(file)):
            return _why_not_file(file)
    inside = sorted(p for p in path.glob("*/sparse") if (p / "0").is_dir())
    if inside:
        return InputError(path, f"no map in it, but in {', '.join(p.parent.name for p in inside)}", f"give {inside[0]}")
    names = sorted(p.name for p in path.iterdir())
    found = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    return InputError(path, f"no map in it (found {found or 'nothing: the folder is empty'})", _ACCEPTED)


def _is_trajectory(path: Path) -> bool:
    """Whether a file looks like a TUM trajectory, or a CLiMB one with its commas."""
    return is_trajectory(path) or first_entry(path).count(",") >= 8

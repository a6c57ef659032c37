"""read_map: which format a path holds, found by looking."""

from __future__ import annotations

from pathlib import Path

from lightdepth.errors import InputError
from lightdepth.maps.colmap import holds_model, read_submap
from lightdepth.maps.convention import COLMAP, EXPORTER, declared_convention
from lightdepth.maps.endocartoscope import MAPS, read_exported_submap
from lightdepth.sparse_map import SparseMap

_ACCEPTED = (
    "expected a COLMAP model (cameras, images, points3D as .txt or .bin), a folder of numbered models "
    f"(sparse/0, sparse/1), or a multi-map export ({MAPS}/0, {MAPS}/1)"
)


def read_map(path: Path | str) -> SparseMap:
    """A sparse map on disk -> its submaps, by map id.

    Reads a COLMAP model folder (its id is the folder's number, or 0), a folder or its `sparse/` with numbered COLMAP
    models, and the EndoCartoScope / CLiMB tree `3D_maps/<id>` directly below, under `output/` or one run's folder.
    Raises InputError saying what was found, where, and what would be right.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; {_ACCEPTED}")
    if not path.is_dir():
        raise InputError(_why_not_file(path))
    tree = _multimap_tree(path)
    if tree is not None:
        return _read_tree(tree, path)
    if holds_model(path):
        map_id = int(path.resolve().name) if _is_number(path.resolve().name) else 0
        exported = path.resolve().parent.name == MAPS
        convention = declared_convention(path, map_id, EXPORTER if exported else COLMAP)
        read = read_exported_submap if exported else read_submap
        return SparseMap((read(path.resolve() if exported else path, map_id, convention),), str(path))
    for root in (path, path / "sparse"):
        if root != path and holds_model(root):
            return SparseMap((read_submap(root, 0, declared_convention(root, 0, COLMAP, (path,))),), str(path))
        folders = {i: f for i, f in _numbered(root).items() if holds_model(f)}
        if folders:
            conventions = {i: declared_convention(f, i, COLMAP, (root, path)) for i, f in folders.items()}
            return SparseMap(tuple(read_submap(f, i, conventions[i]) for i, f in folders.items()), str(path))
    raise InputError(_why_not_folder(path))


def _multimap_tree(path: Path) -> Path | None:
    """The 3D_maps folder at, below, or one folder below the path; None when there is none."""
    if path.resolve().name == MAPS:
        return path
    if (path / MAPS).is_dir():
        return path / MAPS
    trees = sorted(path.glob(f"*/{MAPS}"))
    if len(trees) > 1:
        found = ", ".join(t.parent.name for t in trees)
        raise InputError(
            f"{path}: several runs with a {MAPS} folder ({found}); give one of them, e.g. {trees[0].parent}"
        )
    return trees[0] if trees else None


def _read_tree(tree: Path, source: Path) -> SparseMap:
    folders = _numbered(tree)
    if not folders:
        raise InputError(f"{tree}: no map in it; expected a folder for each map named by its number, {MAPS}/0")
    roots = (tree, tree.resolve().parent)
    submaps = []
    for map_id, folder in folders.items():
        convention = declared_convention(folder, map_id, EXPORTER, roots)
        submaps.append(read_exported_submap(folder, map_id, convention))
    return SparseMap(tuple(submaps), str(source))


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit()


def _numbered(root: Path) -> dict[int, Path]:
    """Sub-folders whose name is an integer, by that integer. Raises InputError when two have the same."""
    folders: dict[int, Path] = {}
    if not root.is_dir():
        return folders
    for folder in sorted(p for p in root.iterdir() if p.is_dir() and _is_number(p.name)):
        twin = folders.setdefault(int(folder.name), folder)
        if twin is not folder:
            raise InputError(
                f"{root}: {twin.name} and {folder.name} are both map {int(folder.name)}; rename one of them"
            )
    return dict(sorted(folders.items()))


def _why_not_file(path: Path) -> str:
    if path.suffix == ".osa":
        return (
            f"{path}: an ORB-SLAM3 atlas, which only the build that wrote it can read; "
            f"export the multi-map tree instead ({MAPS}/<id>/ with cameras.txt, images.txt, points3D.txt)"
        )
    if path.suffix == ".msg":
        return f"{path}: a stella_vslam map, which is not read; export it as a COLMAP text model"
    if path.stem in ("cameras", "images", "points3D"):
        return f"{path}: one file of a COLMAP model; give the folder it is in, {path.parent}"
    if _is_trajectory(path):
        return (
            f"{path}: a trajectory without points; a dense map needs the map's points and which keyframe saw them: "
            f"give a COLMAP model or the multi-map tree ({MAPS}/<id>/). Or leave the map out and let `sparse` make one"
        )
    return f"{path}: a file of no known map format; {_ACCEPTED}"


def _why_not_folder(path: Path) -> str:
    files = sorted(p for p in path.iterdir() if p.is_file())
    for file in files:
        if file.suffix in (".osa", ".msg") or (file.suffix in (".txt", ".tum") and _is_trajectory(file)):
            return _why_not_file(file)
    names = sorted(p.name for p in path.iterdir())
    found = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    return f"{path}: no map in it (found {found or 'nothing: the folder is empty'}); {_ACCEPTED}"


def _is_trajectory(path: Path) -> bool:
    """Whether the first line that is not a comment looks like TUM's `t tx ty tz qx qy qz qw`, or a CLiMB trajectory."""
    try:
        with path.open(encoding="utf-8") as lines:
            line = next((text for text in lines if text.strip() and not text.lstrip().startswith("#")), "")
    except (OSError, UnicodeDecodeError):
        return False
    if line.count(",") >= 8:
        return True
    try:
        return len([float(word) for word in line.split()]) == 8
    except ValueError:
        return False

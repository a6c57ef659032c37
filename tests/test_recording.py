"""A recording holds the whole run as it was, names no path, and replaces nothing but a recording."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from raising import refused
from view_runs import AT, CANARY, write_frames, write_run

from densify.commands.view import view
from densify.dense_map import read_dense_map
from lightdepth.files.images import write_image

pytest.importorskip("rerun", reason="needs the extra `rerun`")
from rerun.chunk import RrdReader


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    made = write_run(folder / "run", write_frames(folder / CANARY), maps=2)
    (made / "keyframes").mkdir()
    write_image(made / "keyframes" / "000001.jpg", np.full((30, 96, 3), 120, np.uint8))
    return made


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("out") / "new" / "run.rrd"
    view(run, rerun=path)
    return path


def columns(path, entity: str) -> dict[str, list]:
    """What was logged of an entity, by component, over all its chunks; and at which frames, as `frame`."""
    found: dict[str, list] = {}
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity:
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                found.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def test_the_surface_is_there_in_every_colour_and_the_same_to_the_number(run, recorded):
    read = read_dense_map(run / "map_001")
    entities = {chunk.entity_path for chunk in RrdReader(recorded).stream()}
    for name in ("map_000", "map_001"):
        for part in (
            "surface/of_the_images",
            "surface/shape_alone",
            "surface/confidence",
            "points/points_used",
            "path",
        ):
            assert f"/{name}/{part}" in entities
    told = columns(recorded, "/map_001/surface/of_the_images")
    np.testing.assert_allclose(told["Mesh3D:vertex_positions"][0], read.vertices, rtol=1e-6)
    assert np.array_equal(told["Mesh3D:triangle_indices"][0], read.triangles)
    rgba = np.array(told["Mesh3D:vertex_colors"][0], np.uint32)
    assert np.array_equal(np.stack([rgba >> 24, rgba >> 16 & 255, rgba >> 8 & 255], 1), read.colors)
    assert columns(recorded, "/map_000/unit")["TextDocument:text"][0] == ["mm"]


def test_every_keyframe_has_its_place_and_image_at_its_frame_and_what_was_predicted_where_that_was_written(recorded):
    places = columns(recorded, "/map_000/camera")
    assert sorted(places["frame"]) == list(range(len(AT)))
    order = np.argsort(places["frame"])
    moved = np.array(places["Transform3D:translation"])[order, 0]
    np.testing.assert_allclose(moved, [[0, 0, z] for z in AT], atol=1e-6)
    image = columns(recorded, "/map_000/camera/image")
    assert sum(blob is not None for blob in image["EncodedImage:blob"]) == len(AT)
    predicted = columns(recorded, "/map_000/predicted")
    assert sum(blob is not None for blob in predicted["EncodedImage:blob"]) == 1
    said = [text[0] for text in columns(recorded, "/map_000/said")["TextDocument:text"]]
    assert said == ["000000.png", "000001.png", "000002.png", "000003.png, left out of the surface"]


def test_the_recording_names_no_path(run, recorded):
    data = recorded.read_bytes()
    assert data.startswith(b"RRF2") and CANARY.encode() not in data and str(run.parent).encode() not in data


def test_a_recording_is_written_anew_if_that_is_asked_and_nothing_else_is_replaced(run, tmp_path, recorded):
    path = tmp_path / "again.rrd"
    path.write_bytes(recorded.read_bytes()[:1000])
    with refused(where="again.rrd", found="already there", cure="--overwrite"):
        view(run, rerun=path, triangles=2000)
    view(run, rerun=path, triangles=2000, overwrite=True)
    told = columns(path, "/map_000/surface/of_the_images")
    assert 1900 <= len(told["Mesh3D:triangle_indices"][0]) <= 2000
    theirs = tmp_path / "theirs.rrd"
    theirs.write_text("a letter")
    for overwrite in (False, True):
        with refused(found="was not made by this verb"):
            view(run, rerun=theirs, overwrite=overwrite)
    with refused(where="--rerun", found="does not end in .rrd"):
        view(run, rerun=tmp_path / "run.mp4")
    assert theirs.read_text() == "a letter" and not (tmp_path / "run.mp4").exists()


def test_without_the_package_the_install_command_is_said_and_the_browser_s_package_is_not_needed(run, tmp_path):
    """In a process of its own: the modules are loaded here."""
    code = (
        "import sys; sys.modules[{0!r}] = None\n"
        "from lightdepth.cli import main\n"
        "sys.exit(main(['view', {1!r}, '--rerun', {2!r}]))"
    )
    for absent, ending in (("rerun", 3), ("viser", 0)):
        text = code.format(absent, str(run), str(tmp_path / f"{absent}.rrd"))
        done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
        assert done.returncode == ending, done.stderr
        assert (tmp_path / f"{absent}.rrd").is_file() == (ending == 0)
        assert ("pip install 'lightdepth[rerun]'" in done.stderr) == (ending == 3)


def test_on_a_full_disk_a_recording_ends_with_a_sentence_and_leaves_nothing(run, tmp_path):
    """In a process of its own, whose files may not grow beyond 64 KiB; the package's own writer waits without end."""
    code = (
        "import resource, signal, sys\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "from lightdepth.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, 1 << 16))\n"
        "sys.exit(main(['view', {!r}, '--rerun', {!r}]))"
    ).format(str(run), str(tmp_path / "out" / "run.rrd"))
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 5 and "grew beyond the size that is allowed here" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("off", ["0", "OFF"])
def test_where_the_environment_switches_the_package_off_that_is_said(run, tmp_path, monkeypatch, off):
    monkeypatch.setenv("RERUN", off)
    with refused(where="RERUN", found="switches the package off"):
        view(run, rerun=tmp_path / "run.rrd")
    assert list(tmp_path.iterdir()) == []

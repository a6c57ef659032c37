"""The viewer shows what a run's files hold, measures as `lightdepth measure`, and is seen by this machine alone."""

from __future__ import annotations

import ast
import io
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from raising import refused
from view_runs import AT, CANARY, LENGTH, RADIUS, dense_tube, tube, write_frames, write_run

from densify.commands.measure import measure
from densify.dense_map import DenseMap
from lightdepth.errors import InputError, MachineFailure
from lightdepth.files.images import write_image
from lightdepth.files.lock import locked
from lightdepth.files.replacing import unfinished_path
from lightdepth.reporting.scene import Layer

pytest.importorskip("viser", reason="needs the extra `view`")

from densify.viewing.local_server import local_server
from densify.viewing.panel import legend, lines
from densify.viewing.viewer import Viewer
from densify.viewing.watched import WatchedRun
from densify.viewing.work import Viewing


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("view")
    return write_run(folder / "run", write_frames(folder / CANARY), maps=2)


@contextmanager
def viewing(run: Path, data=None, mm_per_unit=None, triangles=50_000, measured=None):
    """A viewer of a run on a server of its own, as the verb makes it."""
    from densify.viewing.ruler import Ruler

    made = Viewing.of(run, data, mm_per_unit, triangles)
    with local_server("127.0.0.1", 0) as here:
        viewer = Viewer(here.server, made.known, Ruler(mm_per_unit or 1.0), measured or (lambda record, words: None))
        viewer.put(made.maps)
        try:
            yield SimpleNamespace(made=made, viewer=viewer, here=here, panel=viewer.panel)
        finally:
            viewer.close()


@pytest.fixture
def shown(run):
    with viewing(run) as found:
        yield found


def click(viewer: Viewer, eye, at) -> None:
    """A click of who is at `eye` on what lies at `at`."""
    event = SimpleNamespace(ray_origin=tuple(eye), ray_direction=tuple(np.subtract(at, eye)))
    viewer.click(event)


def on_tube(angle: float, z: float) -> np.ndarray:
    return np.array([RADIUS * np.cos(angle), RADIUS * np.sin(angle), z])


def drawn_mesh(drawn):
    import trimesh

    (mesh,) = trimesh.load(io.BytesIO(drawn.surface.glb_data), file_type="glb", process=False).geometry.values()
    return mesh


def sent(here) -> str:
    """All that a browser is sent, as text."""
    buffer = here.server._websock_server._broadcast_buffer
    with buffer.buffer_lock:
        messages = list(buffer.message_from_id.values())
    return "\n".join(repr(message.as_serializable_dict([])) for message in messages)


def test_what_was_predicted_of_a_keyframe_stands_below_its_picture_where_that_was_written(tmp_path):
    run = write_run(tmp_path / "run", write_frames(tmp_path / "frames"))
    (run / "keyframes").mkdir()
    write_image(run / "keyframes" / "000001.jpg", np.full((30, 96, 3), 120, np.uint8))
    with viewing(run) as found:
        for row, there in ((0, False), (1, True), (2, False)):
            found.viewer._on_camera("map_000", row)
            assert (found.panel.row.visible, found.panel.row_said.visible) == (there, there)
        assert found.panel.picture.visible and "uncertainty" in found.panel.row_said.content


def test_the_surface_that_is_drawn_is_that_of_the_file_with_its_colours_in_linear_light(shown, run):
    drawn, read = shown.viewer.maps["map_000"], shown.made.maps[0].read
    mesh = drawn_mesh(drawn)
    assert np.allclose(mesh.vertices, read.vertices, atol=1e-5) and np.array_equal(mesh.faces, read.triangles)
    encoded = (np.asarray(mesh.visual.vertex_attributes["color"])[:, :3] / 255) ** (1 / 2.4) * 1.055 - 0.055
    assert np.abs(encoded[:, 1:] - read.colors[:, 1:] / 255).max() < 0.02


def test_a_large_surface_is_drawn_thinner_says_so_and_is_measured_whole(run):
    with viewing(run, triangles=2000) as found:
        drawn = found.viewer.maps["map_000"]
        assert len(drawn_mesh(drawn).faces) <= 2000 < len(drawn.viewed.read.triangles) == 14_400
        assert "of 28800 triangles; lengths are measured on all" in found.panel.note.content
        assert len(found.viewer._ruler.wall(drawn.viewed).triangles) == 14_400


def test_the_map_with_the_best_verdict_is_shown_first(tmp_path):
    maps = [{"map": i, "verdict": {"colour": colour}} for i, colour in enumerate(("amber", "green"))]
    (write_run(tmp_path / "run", maps=2) / "run.json").write_text(json.dumps({"verb": "densify", "maps": maps}))
    with viewing(tmp_path / "run") as found:
        assert [box.value for box in found.viewer.on.values()] == [False, True]


def test_maps_parts_and_colours_are_switched(shown):
    viewer, panel = shown.viewer, shown.panel
    first, second = viewer.maps["map_000"], viewer.maps["map_001"]
    assert [box.value for box in viewer.on.values()] == [True, False]
    assert first.frame.visible and not second.frame.visible and not panel.together.visible
    viewer.on["map_001"].value = True
    viewer._show()
    assert second.frame.visible and panel.together.visible and len(viewer.stations) == 2 * len(AT)
    viewer.on["map_000"].value = False
    viewer._show()
    assert not first.frame.visible and viewer.stations[0] == ("map_001", 0)
    clouds = {title: len(cloud.points) for title, cloud in first.clouds.items()}
    assert clouds == {"Points used": 2, "Points found wrong": 1} and not first.clouds["Points used"].visible
    for title, node in (
        ("Surface", second.surface),
        ("Path", second.path),
        ("Points used", second.clouds["Points used"]),
    ):
        before = node.visible
        panel.parts[title].value = not before
        viewer._show()
        assert node.visible is (not before)
    panel.parts["Cameras"].value = False
    viewer._show()
    assert not any(camera.visible for camera in second.cameras.values())
    before = second.surface.glb_data
    panel.layer.value = "Keyframes that saw it"
    viewer._show()
    assert second.surface.glb_data != before and "9 and more" in panel.legend.content
    assert set(panel.layer.options) == {"Of the images", "Shape alone", "Confidence", "Keyframes that saw it"}


def test_two_clicks_measure_the_way_along_the_wall_of_a_tube_as_the_verb_measure_does(run, capsys):
    """A helix of a quarter turn and 20 mm, seen from the middle of the tube."""
    found = []
    with viewing(run, measured=lambda record, words: found.append((record, words))) as shown:
        shown.panel.measuring.value = True
        shown.viewer._listen()
        click(shown.viewer, (0, 0, 20), on_tube(0.3, 10))
        assert "second place" in shown.panel.measured.content and found == []
        click(shown.viewer, (0, 0, 20), on_tube(0.3 + np.pi / 2, 30))
        assert "along the surface" in shown.panel.measured.content
    ((record, words),) = found
    true = float(np.hypot(RADIUS * np.pi / 2, 20))
    assert record["length"] == pytest.approx(true, rel=0.02) and record["unit"] == "mm" and record["map"] == "map_000"
    assert record["straight"] == pytest.approx(np.sqrt(2 * RADIUS**2 + 20**2), rel=0.02)
    measure(run, points=[tuple(p) for p in record["places"]], map=0)
    assert words.removeprefix("map 0: ") == capsys.readouterr().out.splitlines()[0]


def test_lengths_are_in_millimetres_where_told(tmp_path):
    run = write_run(tmp_path / "run")
    (run / "run.json").write_text(json.dumps({"verb": "live", "unit": "map units"}))
    found = []
    with viewing(run, mm_per_unit=2.0, measured=lambda record, words: found.append(record)) as shown:
        for at in (on_tube(0, 10), on_tube(0, 20)):
            click(shown.viewer, (0, 0, 20), at)
        ends = shown.viewer._marks[2].points.reshape(-1, 3)[[0, -1]]
    assert found[0]["length"] == pytest.approx(20, rel=0.01) and found[0]["unit"] == "mm"
    assert np.allclose(ends, [on_tube(0, 10), on_tube(0, 20)], atol=0.02)  # of the scene, which stays in its own unit
    with refused(found="in mm already"):
        Viewing.of(write_run(tmp_path / "in mm"), None, 2.0, 50_000)


def test_a_click_from_outside_meets_the_wall_that_is_drawn(shown):
    viewer, eye = shown.viewer, np.array([30.0, 0, 20])
    click(viewer, eye, (0, 0, 20))
    assert np.allclose(viewer._places[0].point, (-RADIUS, 0, 20), atol=0.05)
    shown.panel.parts["Near wall"].value = True
    viewer._clear()
    click(viewer, eye, (0, 0, 20))
    assert np.allclose(viewer._places[0].point, (RADIUS, 0, 20), atol=0.05)
    click(viewer, eye, (30, 5, 90))
    assert "No wall there" in shown.panel.measured.content and len(viewer._places) == 1


def test_places_on_two_maps_are_not_measured_between(shown):
    viewer = shown.viewer
    click(viewer, (0, 0, 20), on_tube(0, 10))
    viewer.on["map_000"].value, viewer.on["map_001"].value = False, True
    viewer._show()
    click(viewer, (0, 0, 20), on_tube(0, 20))
    assert [place.map for place in viewer._places] == ["map_001"] and "along" not in shown.panel.measured.content


def test_a_click_on_a_camera_shows_its_picture_and_says_if_it_was_left_out(shown):
    viewer, panel = shown.viewer, shown.panel
    viewer._on_camera("map_000", 3)
    assert panel.keyframe.value == 3 and panel.picture.visible
    assert (panel.picture.image == 40 + 50 * 3).all() and panel.picture.image.shape == (360, 480, 3)
    assert "keyframe 000003.png, left out of the surface" in panel.caption.content
    assert viewer.maps["map_000"].cameras[3].color == (255, 158, 26)
    viewer._on_camera("map_000", 1)
    assert "left out" not in panel.caption.content and viewer.maps["map_000"].cameras[3].color == (140, 140, 140)


def test_cameras_stand_where_keyframes_were_taken_and_get_their_pictures(shown):
    cameras = shown.viewer.maps["map_000"].cameras
    assert [tuple(camera.position) for camera in cameras.values()] == [(0, 0, z) for z in AT]
    wait_until(lambda: all(camera.image is not None for camera in cameras.values()))
    assert [int(camera.image.mean()) for camera in cameras.values()] == [40, 90, 140, 190]


def wait_until(true, seconds: float = 30.0) -> None:
    import time

    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.05)


def test_the_slider_rides_inside_and_the_button_leads_out_again(shown):
    viewer, panel = shown.viewer, shown.panel
    client = SimpleNamespace(atomic=nullcontext, camera=SimpleNamespace(aspect=1.5))
    panel.keyframe.value = 2
    viewer._ride(client)
    assert not hasattr(client.camera, "position") and "000002.png" in panel.caption.content
    panel.inside.value = True
    viewer._ride(client, leave=True)
    assert np.allclose(client.camera.position, (0, 0, AT[2])) and np.allclose(client.camera.up_direction, (0, -1, 0))
    ahead = np.subtract(client.camera.look_at, client.camera.position)
    assert np.allclose(ahead / np.linalg.norm(ahead), (0, 0, 1)) and not viewer.maps["map_000"].path.visible
    viewer._leave(client)
    assert not panel.inside.value and np.linalg.norm(np.subtract(client.camera.position, (0, 0, LENGTH / 2))) > LENGTH
    assert viewer.maps["map_000"].path.visible


def test_nothing_that_is_sent_names_the_patient_and_frames_that_are_gone_are_said_in_a_line(tmp_path):
    frames = write_frames(tmp_path / CANARY)
    run = write_run(tmp_path / "run", frames)
    with viewing(run) as shown:
        assert "keyframe 000000.png" in sent(shown.here)
        assert CANARY not in sent(shown.here) and str(tmp_path) not in sent(shown.here)
    shutil.rmtree(frames)
    with pytest.warns(UserWarning, match=rf"frames are not found \(.*{CANARY}\).*--data"), viewing(run) as shown:
        assert not shown.panel.picture.visible and "cameras have no pictures" in shown.panel.note.content
        assert len(shown.viewer.maps["map_000"].cameras) == len(AT) and CANARY not in sent(shown.here)


def test_a_name_is_shown_as_text_whatever_is_in_it():
    assert "<img" not in lines("keyframe <img src=x onerror=alert(1)>.png") and "&lt;img" in lines("<img>")
    assert "<i>" not in legend(Layer("", None, np.zeros((2, 3), np.uint8), ((0.0, "<i>"),)))


def listening(process: int) -> list:
    connections = psutil.Process(process).net_connections("inet")
    return [connection.laddr for connection in connections if connection.status == psutil.CONN_LISTEN]


def test_the_server_listens_to_this_machine_alone_and_to_no_page_from_elsewhere(shown):
    of_ours = listening(os.getpid())
    assert ("127.0.0.1", shown.here.port) in of_ours and {address.ip for address in of_ours} == {"127.0.0.1"}

    def answer(**headers: str) -> int:
        asked = urllib.request.Request(shown.here.url, headers=headers)
        try:
            with urllib.request.urlopen(asked) as response:
                return response.status
        except urllib.error.HTTPError as error:
            return error.code

    here = f"localhost:{shown.here.port}"
    assert answer() == answer(Host=here, Origin=f"http://{here}") == 200
    assert answer(Origin="http://elsewhere.example") == answer(Host="elsewhere.example") == 403
    socket_of = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    socket_of["Sec-WebSocket-Key"] = "AAAAAAAAAAAAAAAAAAAAAA=="
    assert answer(**socket_of, Origin=f"http://localhost:{shown.here.port + 1}") == 403
    assert shown.here.server.request_share_url() is None


def test_a_port_that_is_taken_and_a_host_of_another_machine_are_refused():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(MachineFailure, match=f"port {port} of 127.0.0.1 is taken"), local_server("127.0.0.1", port):
            pass
    with refused(where="--host", cure="an address of this machine"), local_server("192.0.2.1", 0):
        pass


def test_a_surface_that_is_written_anew_takes_the_place_of_the_old_one(tmp_path):
    run = write_run(tmp_path / "run")
    with viewing(run) as shown:
        before = shown.viewer.maps["map_000"]
        shown.made.follow(shown.viewer)
        assert shown.viewer.maps["map_000"] is before
        shutil.rmtree(run / "map_000")
        dense_tube(0, radius=11.0).write(run / "map_000")
        dense_tube(1).write(run / "map_001")
        shown.made.follow(shown.viewer)
        assert shown.viewer.maps["map_000"] is before  # it may be half written
        shown.made.follow(shown.viewer)
        assert list(shown.viewer.maps) == ["map_000", "map_001"] == list(shown.viewer.on)
        radius = np.linalg.norm(drawn_mesh(shown.viewer.maps["map_000"]).vertices[:, :2], axis=1)
        assert np.allclose(radius, 11, atol=1e-4)
        click(shown.viewer, (0, 0, 20), (1, 0, 20))
        assert np.allclose(shown.viewer._places[0].point, (11, 0, 20), atol=0.05)
        shutil.rmtree(run / "map_001")
        for _ in range(2):
            shown.made.follow(shown.viewer)
        assert list(shown.viewer.maps) == ["map_000"] == list(shown.viewer.on)


def test_a_run_in_the_making_is_followed_from_before_its_first_map_to_its_end(tmp_path):
    frames, run = write_frames(tmp_path / CANARY), tmp_path / "run"
    made = unfinished_path(run)
    made.mkdir()
    begun = {"verb": "live", "version": "0", "arguments": {"data": str(frames), "mm_per_unit": 2.0}, "inputs": {}}
    (made / "begun.json").write_text(json.dumps(begun))
    with locked(run), another_process(), viewing(run) as shown:
        viewer = shown.viewer
        assert viewer.maps == {} and "No surface yet" in shown.panel.note.content
        dense_tube().write(made / "map_000")
        for _ in range(2):
            shown.made.follow(viewer)
        first = viewer.maps["map_000"]
        assert viewer.on["map_000"].value and "The run is at work" in shown.panel.note.content
        assert shown.panel.picture.visible and viewer.known.unit == "mm"
        wait_until(lambda: all(camera.image is not None for camera in first.cameras.values()))
        shutil.copytree(write_run(tmp_path / "other", frames), made, dirs_exist_ok=True, copy_function=newer)
        os.rename(made, run)
        for _ in range(2):
            shown.made.follow(viewer)
        assert viewer.maps["map_000"] is first and viewer.known.unit == "mm" and viewer.known.state == "finished"
        assert shown.panel.picture.visible and "at work" not in shown.panel.note.content
        assert CANARY not in sent(shown.here)


def newer(source: str, target: str) -> None:
    """Copies what is not there yet."""
    if not Path(target).exists():
        shutil.copy2(source, target)


@contextmanager
def another_process():
    """The lock is looked at as another process would: one's own holds nobody off."""
    patch = pytest.MonkeyPatch()
    patch.setattr("lightdepth.files.lock._is_ours", lambda holder: False)
    try:
        yield
    finally:
        patch.undo()


def test_what_is_no_run_with_a_surface_is_refused(tmp_path):
    with refused(where="nowhere", found="no such folder"):
        WatchedRun(tmp_path / "nowhere")
    (tmp_path / "file").write_text("x")
    with refused(where="file", found="not a folder"):
        WatchedRun(tmp_path / "file")
    with refused(found="no map_* folders"):
        WatchedRun(tmp_path)
    (tmp_path / "run.json").write_text('{"verb": "predict"}')
    with refused(found="made by `predict`", cure="expected a run of `lightdepth densify`, `live` or `demo`"):
        WatchedRun(tmp_path)
    unfinished_path(tmp_path / "stopped").mkdir()
    with refused(where="stopped", found="stopped before its first surface"):
        WatchedRun(tmp_path / "stopped")
    (unfinished_path(tmp_path / "stopped") / "begun.json").write_text('{"verb": "train"}')
    with refused(where="stopped", found="made by `train`"):
        WatchedRun(tmp_path / "stopped")
    run = write_run(tmp_path / "run")
    (run / "map_000" / "mesh.ply").unlink()
    with refused(where="map_000", found="mesh.ply missing"):
        WatchedRun(run).first()


def test_the_errors_that_evaluate_left_are_a_way_to_colour_the_surface(tmp_path):
    from densify.evaluation.pictures import write_error_mesh
    from densify.evaluation.records import ErrorMesh

    run = write_run(tmp_path / "run")
    (run / "evaluation").mkdir()
    vertices, triangles = tube()
    distance = np.linspace(0, 5, len(vertices))
    write_error_mesh(ErrorMesh("map_000", vertices, triangles, distance), run / "evaluation" / "map_000_error.ply")
    (viewed,) = WatchedRun(run).first()
    layer = viewed.surface.layers[-1]
    assert layer.title == "Error" and np.abs(layer.values / 51 - distance).max() < 0.02


def test_the_library_of_the_viewer_is_imported_by_its_verb_alone_when_it_is_called():
    root = Path(__file__).resolve().parents[1]
    found = set()
    for path in (p for package in ("lightdepth", "densify", "train") for p in (root / package).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "viser" in text or "densify.viewing" in text:
            found.add(str(path.relative_to(root)))
    assert {name for name in found if "/viewing/" not in name} == {"densify/commands/view.py"}
    tree = ast.parse((root / "densify/commands/view.py").read_text(encoding="utf-8"))
    assert not any(
        "viewing" in ast.unparse(node) for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)
    )


def heeds_ctrl_c() -> None:
    """What a shell runs in the background ignores SIGINT, and so would the tests' own children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("words", [["--json"], ["--quiet"]])
def test_the_verb_says_where_to_look_and_how_from_elsewhere_and_ends_on_ctrl_c(run, words):
    argv = [sys.executable, "-m", "lightdepth", "view", str(run), "--port", "0", *words]
    aside = {"env": os.environ | {"LIGHTDEPTH_HEARTBEAT": "off"}, "start_new_session": True, "preexec_fn": heeds_ctrl_c}
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **aside) as process:
        said = process.stderr if "--json" in words else process.stdout
        opened, tunnel = said.readline(), said.readline()
        try:
            url = opened.split()[-1]
            port = int(url.rpartition(":")[2])
            with urllib.request.urlopen(url) as page:
                assert b"viser" in page.read().lower()
            assert {address.ip for address in listening(process.pid)} == {"127.0.0.1"}
        finally:
            process.send_signal(signal.SIGINT)
        try:
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert f" ssh -L {port}:localhost:{port} HOST, then open http://localhost:{port} there\n" in tunnel
    assert process.returncode == 130 and "lightdepth view: stopped by SIGINT; nothing was written" in err
    assert "Traceback" not in err and "viser" not in out + err
    if "--json" in words:
        found = json.loads(out)
        assert found["result"] == {"url": url, "port": port, "maps": ["map_000", "map_001"], "lengths": []}
        assert found["exit_code"] == 130 and found["next"].startswith("lightdepth measure RUN")
    else:
        assert out == ""


def test_a_local_server_names_an_address_that_it_answers_at():
    for host, told in (("127.1", "127.0.0.1"), ("localhost", "localhost"), ("127.0.0.2", "127.0.0.2")):
        with local_server(host, 0) as here, urllib.request.urlopen(here.url) as page:
            assert here.url == f"http://{told}:{here.port}" and here.is_local and page.status == 200


def test_every_address_is_told_by_the_name_of_the_machine_and_answers_in_both_families():
    for host in ("0", "0.0.0.0", "::"):
        try:
            with local_server(host, 0) as here:
                assert here.host == socket.gethostname() and not here.is_local
                with urllib.request.urlopen(f"http://127.0.0.1:{here.port}") as page:
                    assert page.status == 200
        except InputError:
            assert host == "::" and not socket.has_ipv6  # a machine without it


def test_a_request_that_names_two_hosts_or_two_origins_is_refused(shown):
    for twice in ("Host: elsewhere.example", f"Origin: http://localhost:{shown.here.port}\r\nOrigin: http://elsewhere"):
        with socket.create_connection(("127.0.0.1", shown.here.port), 10) as asked:
            asked.sendall(f"GET / HTTP/1.1\r\nHost: localhost:{shown.here.port}\r\n{twice}\r\n\r\n".encode())
            assert asked.recv(100).startswith(b"HTTP/1.1 403 ")


def test_a_run_that_another_took_the_place_of_has_the_unit_and_the_frames_of_the_other(tmp_path):
    run = write_run(tmp_path / "run")
    (run / "run.json").write_text('{"verb": "densify", "unit": "map units"}')
    with viewing(run) as shown:
        assert shown.viewer.known.unit == "map units" and not shown.panel.picture.visible
        shutil.rmtree(run)
        write_run(run, write_frames(tmp_path / CANARY))
        for _ in range(2):
            shown.made.follow(shown.viewer)
        assert shown.viewer.known.unit == "mm" and shown.panel.picture.visible
    run = write_run(tmp_path / "other")
    (run / "run.json").write_text('{"verb": "densify", "unit": "map units"}')
    with viewing(run, mm_per_unit=2.0) as shown, refused(found="in mm already"):
        shutil.rmtree(run)
        write_run(run)
        for _ in range(2):
            shown.made.follow(shown.viewer)


def test_a_run_that_is_gone_or_was_stopped_is_said_to_be(tmp_path):
    run = write_run(tmp_path / "run")
    with viewing(run) as shown:
        shutil.rmtree(run)
        for _ in range(3):
            shown.made.follow(shown.viewer)
        assert shown.viewer.maps == {} and "no longer in its place" in shown.panel.note.content
    made = unfinished_path(tmp_path / "stopped")
    dense_tube().write(made / "map_000")
    with viewing(tmp_path / "stopped") as shown:
        assert "The run was stopped" in shown.panel.note.content and "at work" not in shown.panel.note.content


def test_a_surface_that_became_empty_is_no_longer_drawn(tmp_path):
    run = write_run(tmp_path / "run", maps=2)
    with viewing(run) as shown:
        shutil.rmtree(run / "map_000")
        dense, none = dense_tube(), np.zeros((0, 3))
        empty = DenseMap(dense.submap, none, none.astype(int), none, dense.alignments, 0.5, "mm")
        empty.write(run / "map_000")
        for _ in range(2):
            shown.made.follow(shown.viewer)
        assert list(shown.viewer.maps) == ["map_001"]


def test_what_was_measured_stays_while_other_maps_come(tmp_path):
    run = write_run(tmp_path / "run")
    with viewing(run) as shown:
        for at in (on_tube(0, 10), on_tube(0, 20)):
            click(shown.viewer, (0, 0, 20), at)
        dense_tube(1).write(run / "map_001")
        for _ in range(2):
            shown.made.follow(shown.viewer)
        assert len(shown.viewer.maps) == 2 and "along the surface" in shown.panel.measured.content
        assert len(shown.viewer._places) == 2


def test_a_map_that_is_half_written_when_the_viewer_starts_is_shown_when_it_is_whole(tmp_path):
    run = tmp_path / "run"
    made = unfinished_path(run)
    dense_tube().write(made / "map_000")
    whole = (made / "map_000" / "mesh.ply").read_bytes()
    (made / "map_000" / "mesh.ply").write_bytes(whole[:5000])
    with viewing(run) as shown:
        assert shown.viewer.maps == {}
        (made / "map_000" / "mesh.ply").write_bytes(whole)
        for _ in range(2):
            shown.made.follow(shown.viewer)
        assert list(shown.viewer.maps) == ["map_000"]


def test_a_map_that_goes_while_a_picture_is_read_leaves_the_others_theirs(shown, monkeypatch):
    viewer, pictures = shown.viewer, shown.viewer.known.pictures
    wait_until(lambda: all(c.image is not None for drawn in viewer.maps.values() for c in drawn.cameras.values()))
    read, asked = pictures.small, []

    def small(number: int):
        if not asked:
            asked.append(number)
            viewer.put([], ["map_000"])
        return read(number)

    monkeypatch.setattr(pictures, "small", small)
    again = [viewer.maps[name].viewed for name in ("map_000", "map_001")]
    viewer.put(again)
    wait_until(lambda: asked and "map_000" not in viewer.maps)
    wait_until(lambda: all(camera.image is not None for camera in viewer.maps["map_001"].cameras.values()))
    assert viewer._filling.is_alive()


def test_a_map_folder_is_shown_from_within_it(run, monkeypatch):
    monkeypatch.chdir(run / "map_001")
    assert [viewed.name for viewed in WatchedRun(Path(".")).first()] == ["map_001"]


@pytest.mark.parametrize("spoil", ["vertex", "triangle"])
def test_a_surface_whose_numbers_cannot_be_is_refused(tmp_path, spoil):
    run, dense = tmp_path / "run", dense_tube()
    vertices, triangles = dense.vertices.copy(), dense.triangles.copy()
    if spoil == "vertex":
        vertices[5, 1] = np.nan
    else:
        triangles[7, 1] = len(vertices)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property float {a}" for a in "xyz")]
    lines += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(str, vertex)) for vertex in vertices]
    lines += [" ".join(map(str, (3, *triangle))) for triangle in triangles]
    write_run(run)
    (run / "map_000" / "mesh.ply").write_text("\n".join(lines) + "\n")
    with refused(where="mesh.ply", cure="copy it again"):
        WatchedRun(run).first()


def test_a_run_whose_frames_have_a_name_that_cannot_be_is_shown_without_them(tmp_path):
    run = write_run(tmp_path / "run")
    (run / "run.json").write_text(json.dumps({"verb": "densify", "arguments": {"data": "a/" * 3000}}))
    with pytest.warns(UserWarning, match="frames are not found"):
        assert Viewing.of(run, None, None, 50_000).known.notes

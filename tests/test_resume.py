"""Verbs that are stopped and resumed: no finished part is made again, and the end is that of a run nothing stopped."""

from __future__ import annotations

import csv
import itertools
import shutil
import warnings
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from colons import colon, slam
from raising import refused
from same_results import differences
from test_sfm import PINHOLE, film
from verbs import by_options
from videos import CAMERA, picture

import densify.commands.densify
import densify.densified
import densify.page
import lightdepth.reporting.scene
from densify.bench.scenes import Scene
from densify.commands import bench
from densify.commands.sparse import sparse as sparse_verb
from densify.fusion.volume import FusionConfig
from densify.judging.config import JudgeConfig
from lightdepth.checkpoint import save_model
from lightdepth.cli import main
from lightdepth.commands.import_frames import import_frames as import_frames_verb
from lightdepth.commands.predict import predict as predict_verb
from lightdepth.datasets import write_folder
from lightdepth.errors import AlreadyFinished, PartialFailure
from lightdepth.files.packed import read_packed, write_packed
from lightdepth.frame import Frame
from lightdepth.losses import LossConfig
from lightdepth.maps import write_multimap
from lightdepth.models import DeclineModel
from lightdepth.network import NetworkConfig, build_network
from lightdepth.photometry import PhotometricCalibration
from lightdepth.reporting import batches
from lightdepth.reporting.run import Run
from lightdepth.sfm import keeping
from lightdepth.sfm.config import SfmConfig
from lightdepth.sparse_map import Submap
from lightdepth.tube import ShapeConfig, TubeConfig
from lightdepth.tube.export import write_synthetic
from train.commands.adapt import adapt as adapt_verb
from train.commands.select import select as select_verb
from train.selecting.covisibility import NodeRules
from train.selecting.matching import SiftMatcher

predict, import_frames = by_options(predict_verb), by_options(import_frames_verb)
sparse, adapt, select = by_options(sparse_verb), by_options(adapt_verb), by_options(select_verb)
densify_verb = by_options(densify.commands.densify.densify)


class Stopped(BaseException):
    """As a signal stops a run."""


@pytest.fixture
def each_alone(monkeypatch):
    """Every frame is a part, and every run warns as if it were a process of its own."""
    monkeypatch.setattr(batches, "SECONDS", 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        yield


@pytest.fixture
def stopping(monkeypatch) -> Callable[[int | None], list[str]]:
    """Called with a number, lets the run stop after so many parts; the list that it gives back holds their names."""
    finished: list[str] = []
    left = [None]
    real = Run.finish_part

    def finish_part(run: Run, part: str, *given, **named) -> None:
        real(run, part, *given, **named)
        finished.append(part)
        if left[0] is not None:
            left[0] -= 1
            if not left[0]:
                raise Stopped

    def after(parts: int | None) -> list[str]:
        left[0] = parts
        return finished

    monkeypatch.setattr(Run, "finish_part", finish_part)
    return after


def stopped_everywhere(
    verb: Callable[..., None], tmp_path: Path, stopping, every: int = 1, anew: bool = True
) -> list[str]:
    """Stops a verb after each so many parts until it is through, and compares; the names of all parts."""
    finished = stopping(None)
    verb(tmp_path / "whole")
    parts = list(finished)
    finished.clear()
    for attempt in itertools.count():
        stopping(every)
        try:
            verb(tmp_path / "out", resume=attempt > 0)
        except Stopped:
            continue
        break
    assert sorted(finished) == sorted(parts) and attempt == len(parts) // every
    assert list(differences(tmp_path / "whole", tmp_path / "out")) == []
    assert not (tmp_path / "out" / ".state").exists()
    if anew:  # there is nothing to resume
        stopping(None)
        verb(tmp_path / "other", resume=True)
        assert list(differences(tmp_path / "whole", tmp_path / "other")) == []
    return parts


@pytest.fixture(scope="session")
def few_frames(tmp_path_factory) -> Path:
    """Frames of a colon, of which one cannot be read."""
    folder = tmp_path_factory.mktemp("few") / "data"
    write_folder([Frame(f"{n:06d}", picture(n) / 255.0, CAMERA, time=n / 10) for n in range(5)], folder)
    torn = next(p for p in sorted(folder.rglob("*.png")) if p.stem == "000002")
    torn.write_bytes(torn.read_bytes()[:300])
    return folder


def test_predict_goes_on_behind_the_last_finished_frame(few_frames, tmp_path, stopping, each_alone, monkeypatch):
    seen = []
    real = DeclineModel.__call__
    monkeypatch.setattr(DeclineModel, "__call__", lambda model, frame: seen.append(frame.name) or real(model, frame))

    def verb(output: Path, **given) -> None:
        with suppress(PartialFailure):
            predict(few_frames, output, checkpoint="decline", **given)

    parts = stopped_everywhere(verb, tmp_path, stopping)
    assert len(parts) == 5
    assert seen == [f"{n:06d}" for n in (0, 1, 3, 4)] * 3  # whole, stopped and resumed, other


def test_import_goes_on_with_the_measures_and_pictures_that_it_has(few_frames, tmp_path, stopping, each_alone):
    def verb(output: Path, **given) -> None:
        import_frames(few_frames, output, every=1, **given)

    parts = stopped_everywhere(verb, tmp_path, stopping, every=3)
    assert [p for p in parts if p.startswith("measures")] == [f"measures from {n}" for n in range(5)]
    assert len([p for p in parts if p.startswith("pictures")]) >= 3


ALL_ARE_KEPT = NodeRules(min_views=1, min_frames=1, min_matches=4, min_spread=0.0)


def test_select_goes_on_at_the_node_that_it_came_to(tmp_path, stopping, each_alone, monkeypatch):
    """Three colons after each other; one frame comes twice, and one cannot be read."""
    seen = [f for seed in (0, 1, 2) for f in colon(seed, 40).frames[:4]]
    seen.insert(6, seen[5])
    write_folder([replace(f, name=f"{n:06d}") for n, f in enumerate(seen)], tmp_path / "data")
    torn = next(p for p in sorted((tmp_path / "data").rglob("*.png")) if p.stem == "000009")
    torn.write_bytes(torn.read_bytes()[:300])
    matched = []
    real = SiftMatcher.keep
    monkeypatch.setattr(SiftMatcher, "keep", lambda own, frame: matched.append(frame.name) or real(own, frame))

    def verb(output: Path, **given) -> None:
        output.mkdir(exist_ok=True)
        select(tmp_path / "data", output / "list.txt", sift_nodes=ALL_ARE_KEPT, **given)

    parts = stopped_everywhere(verb, tmp_path, stopping)
    assert len(parts) > 3 and parts[-1] == "verdicts"
    nodes = [row["node"] for row in csv.DictReader((tmp_path / "out" / "list.csv").open())]
    assert len(set(nodes) - {""}) == len(parts) - 1 < 11, "some nodes are of several frames"
    # What a node begins with is looked at again by the run that goes on there, but nothing before it.
    assert len(matched) == 11 * 3 + len(parts) - 1
    assert sorted(p.name for p in (tmp_path / "out").glob(".*")) == []
    with pytest.raises(AlreadyFinished):
        verb(tmp_path / "out", resume=True)
    with refused("other frames or settings"):
        select(tmp_path / "data", tmp_path / "out" / "list.txt", resume=True)
    with refused("already there"):
        verb(tmp_path / "out")


def test_select_tells_of_a_run_that_was_stopped(tmp_path, stopping, each_alone):
    write_folder(colon(0, 4).frames, tmp_path / "data")
    chosen = partial(select, tmp_path / "data", sift_nodes=ALL_ARE_KEPT)
    stopping(1)
    with pytest.raises(Stopped):
        chosen(tmp_path / "list.txt")
    assert sorted(p.name for p in tmp_path.glob("*list*")) == [".list.txt.unfinished"]
    stopping(None)
    with refused("beside it is an unfinished run of select"):
        chosen(tmp_path / "list.txt")
    with refused("not resumed, --sift-nodes.min-spread was 0.0 and is 0.1"):
        chosen(tmp_path / "list.txt", sift_nodes=replace(ALL_ARE_KEPT, min_spread=0.1), resume=True)
    with refused("not resumed, --no-frames was False and is True"):
        chosen(tmp_path / "list.txt", no_frames=True, resume=True)
    chosen(tmp_path / "list.txt", overwrite=True)
    assert (tmp_path / "list.txt").is_file() and not (tmp_path / ".list.txt.unfinished").exists()
    (tmp_path / ".other.txt.unfinished").mkdir()
    (tmp_path / ".other.txt.unfinished" / "mine").write_text("")
    with refused("was not made by this program"):
        chosen(tmp_path / "other.txt")


def test_a_finished_selection_is_known_again_by_what_it_was_made_of(tmp_path):
    write_folder(colon(0, 4).frames, tmp_path / "data")
    whole = partial(select, sift_nodes=ALL_ARE_KEPT)
    again = partial(whole, resume=True)
    whole(tmp_path / "data", tmp_path / "list.txt")
    (tmp_path / "elsewhere").symlink_to(tmp_path / "data")
    for same in ("data", "elsewhere"):
        with pytest.raises(AlreadyFinished):
            again(tmp_path / same, tmp_path / "list.txt")
    for other in ({"with_folder": True}, {"no_frames": True}, {"bit_depth": 9}):
        with refused("other frames or settings"):
            again(tmp_path / "data", tmp_path / "list.txt", **other)
    text = (tmp_path / "list.txt").read_text()
    (tmp_path / "list.txt").write_text(text[: text.rindex("\n", 0, -1) + 1])
    with refused("was changed since"):
        again(tmp_path / "data", tmp_path / "list.txt")
    (tmp_path / "list.txt").write_text(text)
    (tmp_path / "list.csv").unlink()
    with refused("list.csv beside it is gone"):
        again(tmp_path / "data", tmp_path / "list.txt")
    (tmp_path / "list.csv").write_text("")
    first = min((tmp_path / "data" / "frames").iterdir())
    first.write_bytes(max((tmp_path / "data" / "frames").iterdir()).read_bytes())
    with refused("other frames or settings"):
        again(tmp_path / "data", tmp_path / "list.txt")


def test_what_came_to_stand_beside_a_list_meanwhile_is_not_replaced(tmp_path, monkeypatch):
    write_folder(colon(0, 4).frames, tmp_path / "data")

    def beside(*_) -> bytes:
        select(tmp_path / "data", tmp_path / "list.md", sift_nodes=ALL_ARE_KEPT, no_frames=True)
        return b""

    monkeypatch.setattr("train.commands.select._sheet", beside)
    with refused("list.csv", "already there"):
        select(tmp_path / "data", tmp_path / "list.txt", sift_nodes=ALL_ARE_KEPT)
    assert sorted(p.name for p in tmp_path.glob("*list*")) == ["list.csv", "list.html", "list.md"]


def test_a_list_whose_hidden_neighbours_could_not_be_called_after_it_is_refused(tmp_path):
    write_folder(colon(0, 4).frames, tmp_path / "data")
    with refused("241 bytes"):
        select(tmp_path / "data", tmp_path / ("x" * 237 + ".txt"))
    assert [p.name for p in tmp_path.iterdir()] == ["data"]


class Summed:
    """A view that draws nothing but the sum of its arrays, which tells as well whether they are the same."""

    def __init__(self, *arrays: np.ndarray) -> None:
        self.arrays = arrays

    @classmethod
    def of(cls, *arrays: np.ndarray, **_: np.ndarray) -> Summed:
        return cls(*arrays)

    def cutout(self, *colors: np.ndarray) -> np.ndarray:
        every = b"".join(a.tobytes() for a in (*self.arrays, *colors) if a is not None)
        return np.full((1, 1, 3), zlib.crc32(every) / 2**32)


@pytest.mark.parametrize(("every", "judging"), [(3, False), pytest.param(1, True, marks=pytest.mark.slow)])
def test_densify_goes_on_with_the_light_and_the_submaps_that_it_has(
    tmp_path, stopping, each_alone, monkeypatch, every, judging
):
    """Two submaps that meet, so that what is read back is joined, judged and written, pictures too."""
    frames = colon(0).frames[:6]
    write_synthetic(frames, slam(frames, maps=2, shared_keyframes=2), tmp_path / "data")
    (tmp_path / "data" / "light.json").unlink()
    monkeypatch.setattr(densify.page, "MeshView", Summed)
    monkeypatch.setattr(lightdepth.reporting.scene, "MeshView", Summed)
    done, coarse = [], FusionConfig(voxels_per_distance=20.0)
    real = densify.densified.densify_or_empty
    monkeypatch.setattr(
        densify.densified, "densify_or_empty", lambda submap, *given: done.append(submap.id) or real(submap, *given)
    )

    def verb(output: Path, **given) -> None:
        densify_verb(
            tmp_path / "data",
            output,
            map=tmp_path / "data" / "slam",
            checkpoint="decline",
            fusion=coarse,
            judge=JudgeConfig(on=judging),
            **given,
        )

    parts = stopped_everywhere(verb, tmp_path, stopping, every, anew=False)
    assert parts == ["light", "map 0", "map 1", "joined"] and done == [0, 1, 0, 1]


@pytest.mark.slow
def test_sparse_goes_on_with_the_features_and_matches_that_it_has(tmp_path, stopping, each_alone, monkeypatch):
    monkeypatch.setattr(keeping, "SECONDS", 0.0)
    write_folder(film(PINHOLE, 9), tmp_path / "data")

    def verb(output: Path, **given) -> None:
        sparse(tmp_path / "data", output, sfm=SfmConfig(max_features=1000), **given)

    parts = stopped_everywhere(verb, tmp_path, stopping, anew=False)
    assert parts == ["matching"] * 4 + ["sparse map"]


@pytest.mark.slow
def test_adapt_goes_on_with_the_judgement_and_the_training_that_it_has(tmp_path, stopping, each_alone):
    frames = [replace(f, true_distance=None, true_world_from_cam=None) for f in colon(0).frames]
    write_folder(frames, tmp_path / "data")
    write_multimap(slam(colon(0).frames).map, tmp_path / "map")
    (tmp_path / "data" / "light.json").unlink()
    card = {"trained_on": "nothing.", "rows": 32, "loss": asdict(LossConfig(reflectance=None))}
    save_model(build_network(NetworkConfig(width=4)), tmp_path / "start.safetensors", card)

    def verb(output: Path, **given) -> None:
        steps = {"steps": 3, "batch_size": 2, "size": (40, 32), "keep_worse": True, "replay": 0.0, "points": 1.0}
        adapt(tmp_path / "data", output, str(tmp_path / "start.safetensors"), map=tmp_path / "map", **steps, **given)

    parts = stopped_everywhere(verb, tmp_path, stopping, anew=False)
    assert parts == ["light", "start", "training"]


@pytest.mark.slow
def test_bench_goes_on_with_the_cells_that_it_has(tmp_path, stopping, each_alone, monkeypatch):
    tiny = Scene("tiny", 0, 40, 5, travel_mm=8.0)
    monkeypatch.setattr(Scene, "colon", TubeConfig(ShapeConfig(length=90.0, step=1.2)))
    monkeypatch.setattr(bench, "scenes", lambda size, first: [tiny, replace(tiny, name="other", seed=1)])

    def verb(output: Path, **given) -> None:
        # By our own fusion: on two cores Open3D's, the paper's, writes vertices in another order every time.
        options = {"checkpoints": ("decline",), "wrong_shares": (0.0, 0.3), "cases": ("loop",)}
        by_options(bench.run)(output, image_size=(64, 52), recipes=("full",), **options, **given)

    parts = stopped_everywhere(verb, tmp_path, stopping, every=2, anew=False)
    assert len(parts) == 6


def test_a_run_is_resumed_as_it_was_begun_and_a_finished_one_is_left_alone(few_frames, tmp_path, stopping, capsys):
    data = shutil.copytree(few_frames, tmp_path / "data")
    words = ["import", str(data), "-o", str(tmp_path / "out"), "--no-find-text"]
    stopping(1)
    with pytest.raises(Stopped):
        main(words)
    assert main(words) == 3 and "import --resume goes on" in capsys.readouterr().err
    assert main([*words, "--crop", "auto", "--resume"]) == 3 and "--crop was" in capsys.readouterr().err
    frame = next((data / "frames").iterdir())
    before = frame.read_bytes()
    frame.write_bytes(before + b" ")
    assert main([*words, "--resume"]) == 3 and "the data has changed" in capsys.readouterr().err
    frame.write_bytes(before)
    stopping(None)
    assert main([*words, "--resume"]) == 0
    left = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
    capsys.readouterr()
    assert main([*words, "--resume"]) == 0 and "already finished" in capsys.readouterr().out
    assert left == {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}


def test_values_of_our_own_kinds_are_kept_without_loss(tmp_path):
    submap = slam(colon(0).frames).map.submaps[0]
    light = PhotometricCalibration(0.1 + 0.2, 0.0, source="measured")
    value = Outer(submap, {3: (np.inf, -0.0, np.nan)}, (light, None), np.float32([[1e-45, np.nan]]).T, "é", None)
    write_packed(tmp_path / "a.npz", value, {Submap: submap})
    read = read_packed(tmp_path / "a.npz", Outer, {Submap: submap})
    assert read.submap is submap and repr(read.numbers) == repr(value.numbers) and read.lights == (light, None)
    assert read.array.tobytes() == value.array.tobytes() and read.array.dtype == np.float32 and read.text == "é"
    write_packed(tmp_path / "b.npz", submap)
    whole = read_packed(tmp_path / "b.npz", Submap)
    assert whole.keyframes[0].camera == submap.keyframes[0].camera
    np.testing.assert_array_equal(whole.points, submap.points)


@dataclass(frozen=True)
class Outer:
    submap: Submap
    numbers: dict[int, tuple[float, ...]]
    lights: tuple[PhotometricCalibration, PhotometricCalibration | None]
    array: np.ndarray
    text: str
    nothing: np.ndarray | None

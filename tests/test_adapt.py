import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from colons import colon, slam
from raising import refused
from verbs import by_options

from lightdepth.checkpoint import load_model, read_card, save_model
from lightdepth.datasets import write_folder
from lightdepth.errors import InputError, PartialFailure
from lightdepth.frame import to_batch
from lightdepth.losses import LossConfig
from lightdepth.maps import write_multimap
from lightdepth.models import NetworkModel
from lightdepth.network import NetworkConfig, build_network
from lightdepth.photometry import PhotometricCalibration
from train.adapting.card import source_colons, target_loss
from train.adapting.judging import Judgement, verdict
from train.adapting.module import Adaptation, anchor_loss, let_learn, merge_low_rank
from train.adapting.wall_judge import PointError, WallErrors
from train.colons import TubeData
from train.commands.adapt import adapt as adapt_verb
from train.datamodule import FrameData, FrameDataModule
from train.loader import collate

adapt = by_options(adapt_verb)

SIZE = (40, 32)


def network(norm: str = "group", seed: int = 0):
    torch.manual_seed(seed)
    made = build_network(NetworkConfig(width=4, norm=norm))
    with torch.no_grad():
        made.body.head.weight.normal_(std=0.05)  # not the closed form itself
    return made


@pytest.fixture(scope="module")
def start(tmp_path_factory) -> Path:
    """A checkpoint that has learned nothing."""
    path = tmp_path_factory.mktemp("start") / "start.safetensors"
    tube = {"scenes": 9, "val_scenes": 2, "frames": 2, "lenses": ["pinhole"], "mu": [0.0, 0.5], "family": "plain"}
    card = {"trained_on": "nothing.", "rows": 32, "loss": asdict(LossConfig(reflectance=None)), "tube": tube}
    save_model(network(), path, card)
    return path


@pytest.fixture(scope="module")
def sequences(tmp_path_factory) -> Path:
    """`plain` without truth, `truth` with it, `unlit` without a light of its own and a map of it in `slam`."""
    root = tmp_path_factory.mktemp("sequences")
    frames = colon(count=10).frames
    bare = [replace(f, true_distance=None, true_world_from_cam=None) for f in frames]
    write_folder(bare, root / "plain")
    write_folder(frames, root / "truth")
    write_folder(bare, root / "unlit")
    (root / "unlit" / "light.json").unlink()
    write_multimap(slam(frames).map, root / "slam")
    return root


def adapted(start: Path, data: Path, run: Path, **options) -> dict:
    """The record of a run of a few steps."""
    adapt(data, run, str(start), **{"steps": 6, "batch_size": 2, "size": SIZE, "learning_rate": 3e-3, **options})
    return json.loads((run / "run.json").read_text())


def weights(path: Path) -> dict[str, torch.Tensor]:
    model = load_model(path)
    assert isinstance(model, NetworkModel)
    return {name: value.cpu() for name, value in model.network.state_dict().items()}


def test_without_a_judge_the_network_is_held_near_its_start_and_called_not_judged(start, sequences, tmp_path):
    record = adapted(start, sequences / "plain", tmp_path / "run", steps=16, judge="none")
    assert record["criterion"] == "none" and record["word"] == "not judged" and not record["better"]
    assert record["anchor"] == 20 and record["written"]
    assert record["after"]["loss"] < record["before"]["loss"]
    assert record["frames"] == {"train": 8, "val": 2} and record["before"]["truth"] is None
    assert {p.name for p in (tmp_path / "run").iterdir()} == {
        *("config.yaml", "log.txt", "light.json", "model.safetensors", "model.md", "report.html", "run.json"),
        "inputs.json",
    }
    card = read_card(tmp_path / "run" / "model.safetensors")
    assert card["adapted_from"] == "start" and card["rows"] == SIZE[1]
    for name in ("report.html", "log.txt", "model.md", "run.json"):
        said = (tmp_path / "run" / name).read_text()
        assert "Not judged" in said and "better or equal" not in said, name
    assert load_model(tmp_path / "run" / "model.safetensors")(colon(count=10).frames[0]).distance.shape == (80, 96)


def test_where_no_map_can_be_made_nothing_judges_and_the_reason_is_said(start, sequences, tmp_path, monkeypatch):
    def fails(*_):
        raise InputError("the frames", "no sparse map could be made", "more frames")

    monkeypatch.setattr("train.adapting.target.made_sparse", fails)
    record = adapted(start, sequences / "plain", tmp_path / "run", steps=2)
    assert record["word"] == "not judged" and "no map could be made of the frames" in record["verdict"]
    with refused(found="no sparse map could be made"):
        adapted(start, sequences / "plain", tmp_path / "taught", points=1.0)


def test_a_map_is_made_to_judge_frames_that_have_neither_truth_nor_map(start, sequences, tmp_path, monkeypatch):
    found = slam(colon(count=10).frames).map
    monkeypatch.setattr("train.adapting.target.made_sparse", lambda *_: found)
    record = adapted(start, sequences / "plain", tmp_path / "run", steps=2, keep_worse=True)
    assert record["criterion"] == "map" and record["word"] != "not judged" and record["anchor"] == 50
    by_truth = adapted(start, sequences / "truth", tmp_path / "true", steps=2, keep_worse=True)
    assert by_truth["criterion"] == "truth" and by_truth["anchor"] == 0
    for run, what in (("run", "The same blocks of wall decided"), ("true", "The same held-out frames decided")):
        for name in ("report.html", "model.md"):
            assert what in (tmp_path / run / name).read_text(encoding="utf-8"), name


def test_a_map_that_is_too_poor_to_judge_lets_the_network_be_held_near_its_start(start, sequences, tmp_path):
    whole = slam(colon(count=10).frames).map
    first = whole.submaps[0]
    few = replace(first, point_ids=first.point_ids[:12], points=first.points[:12])
    write_multimap(replace(whole, submaps=(few,)), tmp_path / "slam")
    record = adapted(start, sequences / "plain", tmp_path / "run", map=tmp_path / "slam", steps=2)
    assert record["word"] == "not judged" and record["anchor"] == 20 and "too few points" in record["verdict"]
    assert "the map teaches nothing" in (tmp_path / "run" / "log.txt").read_text()


@pytest.mark.parametrize(
    ("value", "said", "cure"),
    [(0.0, "none of the 6 frames has a pixel", "are they black"), (1.0, "100% white", "lit tissue")],
)
def test_frames_that_show_nothing_are_refused(start, tmp_path, value, said, cure):
    frames = colon(count=6).frames
    empty = [replace(f, image=np.full_like(f.image, value), true_distance=None) for f in frames]
    write_folder(empty, tmp_path / "data")
    with refused(found=said, cure=cure):
        adapted(start, tmp_path / "data", tmp_path / "run")


def test_a_network_that_got_worse_is_not_written_unless_asked_for_and_its_verdict_is_told_once(
    start, sequences, tmp_path, monkeypatch, capsys
):
    original = Adaptation.batch_loss

    def astray(self, batch):
        total, *rest = original(self, batch)
        return (-total, *rest)

    monkeypatch.setattr(Adaptation, "batch_loss", astray)
    run = tmp_path / "run"
    with pytest.raises(
        PartialFailure, match=r"model\.safetensors: not written, nothing better than start was found"
    ) as raised:
        adapted(start, sequences / "truth", run)
    record = json.loads((run / "run.json").read_text())
    assert record["criterion"] == "truth" and not record["better"] and not record["written"]
    said = capsys.readouterr().out + str(raised.value)
    assert said.count(record["verdict"]) == said.count("AbsRel of the held-out frames") == 1
    assert record["failures"] == [
        {"what": "model.safetensors", "reason": "not written, nothing better than start was found"}
    ]
    assert not list(run.glob("model*")) and "--keep-worse" in (run / "report.html").read_text()
    kept = adapted(start, sequences / "truth", run, keep_worse=True, overwrite=True)
    assert not kept["better"] and kept["written"] and (run / "model.safetensors").is_file()


def wall(error: float, spread: float = 0.0, frames: float | None = None, count: int = 20) -> WallErrors:
    """Points, one to a block, whose errors are `error`, every other one larger and smaller by `spread`."""
    points = {(0, i): PointError(i, error + spread * (-1) ** i, 1.0) for i in range(count)}
    return WallErrors(points, {} if frames is None else {7: frames})


def judgement(truth=None, at_wall=None, loss=1.0, inconsistency=0.1) -> Judgement:
    return Judgement({"loss": loss, "inconsistency": inconsistency}, truth, at_wall)


def test_truth_judges_before_the_map_and_the_loss_judges_nothing():
    by_truth = verdict(judgement(0.1, wall(0.2)), judgement(0.2, wall(0.1)), "")
    assert (by_truth.criterion, by_truth.word, by_truth.accepted) == ("truth", "worse", False)
    assert str(by_truth).endswith("0.1 -> 0.2 (+100.0 %): worse")
    by_map = verdict(judgement(None, wall(0.2), 3.0), judgement(None, wall(0.1), 4.0), "")
    assert (by_map.criterion, by_map.word, by_map.accepted) == ("map", "better", True)
    by_nothing = verdict(judgement(loss=3.0), judgement(loss=1.0), "nobody looked")
    assert (by_nothing.criterion, by_nothing.word, by_nothing.better) == ("none", "not judged", False)
    assert str(by_nothing).startswith("Not judged: nobody looked.") and by_nothing.accepted
    assert not verdict(judgement(0.1), judgement(float("nan")), "").accepted
    assert "nan" not in str(verdict(judgement(0.0), judgement(0.0), ""))


def test_a_map_calls_better_only_what_its_blocks_agree_on():
    start = judgement(None, wall(0.2, frames=0.2))
    for after, word in (
        (wall(0.19, frames=0.2), "better"),
        (wall(0.19, 0.15, frames=0.2), "not better"),  # chance does as well
        (wall(0.21, frames=0.2), "worse"),
        (wall(0.19, frames=0.21), "not better"),  # held-out frames say no
    ):
        found = verdict(start, judgement(None, after), "")
        assert found.word == word and found.accepted == (word == "better"), str(found)
    few = verdict(judgement(None, wall(0.2, count=4)), judgement(None, wall(0.1, count=4)), "")
    assert few.word == "not judged" and "too few points" in str(few)


def test_a_network_that_became_inconsistent_is_not_accepted():
    by_map = verdict(judgement(None, wall(0.2)), judgement(None, wall(0.1), inconsistency=0.31), "")
    assert by_map.word == "not better" and "3.1 times the start's" in str(by_map)
    by_nothing = verdict(judgement(), judgement(inconsistency=0.13), "nobody looked")
    assert by_nothing.word == "not judged" and not by_nothing.accepted and "not accepted" in str(by_nothing)
    assert not verdict(judgement(), judgement(inconsistency=float("nan")), "nobody looked").accepted


def test_a_map_finds_the_light_that_nobody_gave_and_its_points_judge(start, sequences, tmp_path):
    record = adapted(start, sequences / "unlit", tmp_path / "run", map=sequences / "slam", keep_worse=True, steps=2)
    assert record["criterion"] == "map" and 0 < record["before"]["map"] < 1 and 0 < record["after"]["map"] < 1
    fit = record["light_fit"]
    assert set(fit) == {"summary", "fitted", "uncertainty", "errors", "used", "seconds"}
    assert fit["summary"].startswith("fitted on the map: gamma") and fit["uncertainty"]["mu"] > 0
    assert fit["used"] == (record["light"] != asdict_json(PhotometricCalibration()))
    written = json.loads((tmp_path / "run" / "light.json").read_text())
    assert written["gamma"] == pytest.approx(record["light"]["gamma"])
    given = adapted(
        start,
        sequences / "unlit",
        tmp_path / "given",
        light="gamma=2,mu=1",
        map=sequences / "slam",
        keep_worse=True,
        steps=1,
    )
    assert "light_fit" not in given and given["light"]["mu"] == 1


def asdict_json(value) -> dict:
    return json.loads(json.dumps(asdict(value)))


def test_the_light_that_the_map_told_is_what_training_sees(start, sequences, tmp_path, monkeypatch):
    seen = []
    original = Adaptation.batch_loss

    def spy(self, batch):
        seen.append(batch.light.gamma.flatten().tolist())
        return original(self, batch)

    found = PhotometricCalibration(gamma=1.3, mu=0.7, source="measured")
    monkeypatch.setattr("train.adapting.target.fit_assumed_light", lambda *_: found)
    monkeypatch.setattr(Adaptation, "batch_loss", spy)
    adapted(start, sequences / "unlit", tmp_path / "run", map=sequences / "slam", keep_worse=True, steps=2)
    assert len(seen) == 2 and np.allclose(seen, 1.3)


def trained(network_, what: str, steps: int = 3, rank: int = 4, **options) -> Adaptation:
    """A few steps on two frames of a colon, without Lightning."""
    model = NetworkModel(network_, SIZE[1], "start")
    module = Adaptation(model, LossConfig(reflectance=0.0), 1e-2, SIZE[1], what=what, rank=rank, **options)
    batch = collate([to_batch(frame, SIZE) for frame in colon(count=10).frames[:2]])
    optimizer = torch.optim.AdamW([p for p in module.network.parameters() if p.requires_grad], lr=1e-2)
    module.train()
    for _ in range(steps):
        optimizer.zero_grad()
        module.batch_loss(batch)[0].backward()
        optimizer.step()
    return module.eval()


@pytest.mark.parametrize("norm", ["group", "batch"])
@pytest.mark.parametrize(
    ("what", "learns"),
    [
        ("decoder", lambda name: name.startswith(("body.decoder", "body.head"))),
        ("norms", lambda name: "norm" in name or name.startswith("body.stem.1")),
        (
            "low_rank",
            lambda name: name.endswith("weight") and "norm" not in name and not name.startswith("body.stem.1"),
        ),
    ],
)
def test_what_does_not_learn_stays_equal_to_the_bit(what, learns, norm):
    before = {name: value.clone() for name, value in network(norm).state_dict().items()}
    module = trained(network(norm), what)
    merge_low_rank(module.network)
    after = module.network.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed and all(learns(name) for name in changed)
    assert {n.split(".")[1] for n in changed} >= ({"decoder"} if what == "decoder" else {"encoder", "decoder"})


def test_low_rank_additions_end_as_plain_weights_that_compute_the_same():
    before = {name: value.clone() for name, value in network().state_dict().items()}
    module = trained(network(), "low_rank", rank=2, generator=torch.Generator().manual_seed(0))
    batch = to_batch(colon(count=10).frames[0], SIZE)
    apart, _ = module(batch)
    merge_low_rank(module.network)
    assert module.network.state_dict().keys() == before.keys()
    assert torch.allclose(module(batch)[0], apart, rtol=1e-5)
    name = "body.encoder.1.conv1.weight"
    added = (module.network.state_dict()[name] - before[name]).flatten(1)
    assert torch.linalg.matrix_rank(added, rtol=1e-4) == 2


def test_an_exported_low_rank_model_is_a_plain_checkpoint(start, sequences, tmp_path):
    adapted(
        start, sequences / "plain", tmp_path / "run", judge="none", what="low_rank", rank=1, steps=2, keep_worse=True
    )
    before, after = weights(start), weights(tmp_path / "run" / "model.safetensors")
    assert before.keys() == after.keys()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert "body.encoder.0.conv1.weight" in changed and not any("norm" in name for name in changed)


def test_only_what_is_named_counts_as_learning():
    assert let_learn(network(), "norms") < let_learn(network(), "decoder") < let_learn(network(), "all")
    with refused(cure="rank of at least 1"):
        let_learn(network(), "low_rank", 0)


def test_the_anchor_holds_shape_and_not_scale():
    before = torch.rand(2, 1, 6, 8) + 0.5
    mask = torch.ones_like(before, dtype=torch.bool)
    assert anchor_loss(before * torch.tensor([2.0, 0.3]).reshape(2, 1, 1, 1), before, mask) < 1e-6
    bent = before.clone()
    bent[:, :, :, :2] *= 1.5  # a quarter of the pixels, so that the median is that of the others
    assert anchor_loss(bent, before, mask) == pytest.approx(np.log(1.5) / 4, rel=1e-5)
    assert anchor_loss(bent, before, bent == before) < 1e-6


def test_an_anchored_network_stays_nearer_to_its_start():
    batch = to_batch(colon(count=10).frames[0], SIZE)
    first = network().eval()(batch.image, batch.mask, batch.rays, batch.light)[0].detach()

    def moved(anchor):
        last = trained(network(), "all", 12, anchor=anchor)(batch)[0].detach()
        return float(anchor_loss(last, first, batch.mask))

    assert moved(20.0) < 0.5 * moved(0.0)


def test_replay_fills_the_second_half_of_every_batch_with_colons_of_the_source(sequences):
    tube = TubeData(scenes=1, frames=3, lenses=("pinhole",))
    data = FrameDataModule(
        FrameData([str(sequences / "plain")], tube=tube, halves=True, size=SIZE, batch_size=3, held_out=0.2)
    )
    data.setup()
    for epoch in range(2):
        names = [data.names(epoch, i) for i in range(len(data.train_dataloader()))]
        assert len(names) == 4 and all(["colon" in n for n in batch] == [False, False, True] for batch in names)
        assert len({n for batch in names for n in batch[:2]}) == 8  # every frame once
    batches = list(data.train_dataloader())
    assert all(b.true_valid.flatten(1).any(1).tolist() == [False, False, True] for b in batches)
    with refused(cure="batch_size of at least 2"):
        FrameDataModule(FrameData(halves=True, batch_size=1))


@pytest.mark.parametrize("replay", [False, True])
def test_the_target_s_truth_is_never_looked_at_and_the_replayed_colons_is(replay):
    loss = LossConfig(reflectance=0.0, supervised=1.0)
    module = Adaptation(NetworkModel(network(), SIZE[1], "start"), loss, 1e-3, SIZE[1], replay=replay)
    batch = collate([to_batch(frame, SIZE) for frame in colon(count=10).frames[:2]])

    def with_truth_of(row):
        bent = batch.true_distance.clone()
        bent[row, :, :, ::2] *= 1.5
        return float(module.batch_loss(batch._replace(true_distance=bent))[0].detach())

    plain = float(module.batch_loss(batch)[0].detach())
    assert with_truth_of(0) == plain
    assert (with_truth_of(1) != plain) == replay


def test_a_run_with_replay_and_anchor_uses_colons_of_the_start_s_kind(start, sequences, tmp_path):
    record = adapted(
        start, sequences / "plain", tmp_path / "run", judge="none", replay=1, anchor=0.5, keep_worse=True, steps=3
    )
    assert record["frames"]["train"] == 8 + 2
    assert read_card(tmp_path / "run" / "model.safetensors")["replayed"]["lenses"] == ["pinhole"]
    assert source_colons(read_card(start), 3) == TubeData(3, frames=2, lenses=("pinhole",), mu=(0.0, 0.5))


def test_the_loss_is_the_card_s_made_fit_for_frames_without_truth():
    card = {
        "loss": asdict(LossConfig(gain="one", supervised=1.0, self_supervised=0.0, photometric=0.0, smoothness=7.0))
    }
    loss = target_loss(card, True, False)
    assert (loss.gain, loss.supervised, loss.self_supervised, loss.photometric) == ("free", 0.0, 1.0, 1.0)
    assert loss.smoothness == 7.0 and target_loss(card, True, True).supervised == 1.0
    calibrated = {"loss": asdict(LossConfig(reflectance=None))}
    assert target_loss(calibrated, True, False).reflectance is None
    assert target_loss(calibrated, False, False).reflectance == LossConfig().reflectance
    assert target_loss({}, True, False) == LossConfig()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"checkpoint": "decline"}, "has no weights to adapt"),
        ({"steps": 0}, "expected a number"),
        ({"anchor": -1.0}, "anchor … -1.0"),
        ({"held_out": 1.0}, "above 0 and below 1"),
        ({"replay": 1, "batch_size": 1}, "batch_size of at least 2"),
        ({"data": Path("nowhere")}, "nowhere"),
        ({"map": Path("nowhere")}, "nowhere"),
        ({"more": (Path("nowhere"),)}, "nowhere"),
    ],
)
def test_what_cannot_be_used_is_said_and_nothing_is_left_behind(start, sequences, tmp_path, options, said):
    arguments = {"data": sequences / "plain", "checkpoint": str(start), "size": SIZE, **options}
    with refused(said):
        adapt(output=tmp_path / "run", **arguments)
    assert not list(tmp_path.iterdir())


def test_a_map_that_teaches_keeps_quiet_about_the_frames_that_judge(start, sequences, tmp_path):
    options = {"map": sequences / "slam", "light": "gamma=2,mu=1", "keep_worse": True, "held_out": 0.3, "steps": 3}
    taught = adapted(start, sequences / "unlit", tmp_path / "taught", points=5.0, overlap=1.0, **options)
    alone = adapted(start, sequences / "unlit", tmp_path / "alone", points=0.0, **options)
    assert (taught["anchor"], alone["anchor"]) == (2.5, 20)  # a map sees what the loss does at its points alone
    assert taught["before"]["loss"] == alone["before"]["loss"] and taught["after"]["loss"] != alone["after"]["loss"]
    log = (tmp_path / "taught" / "log.txt").read_text()
    assert (
        "the map teaches: 7 keyframes" in log and "the map teaches" not in (tmp_path / "alone" / "log.txt").read_text()
    )
    assert "5 (points), 1 (overlap)" in (tmp_path / "taught" / "report.html").read_text()


def test_a_map_does_not_teach_where_none_may_be_made(start, sequences, tmp_path):
    with refused(where="--points, --overlap", found="1.0, 0.0 without --map and with --judge none"):
        adapted(start, sequences / "unlit", tmp_path / "run", points=1.0, judge="none")

"""The ablation: rows trained alike but for one change, judged on colons that none saw, kept when they are done."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from raising import refused
from scenes import cylinder

import train.ablation.judge as judging
import train.ablation.run as ablation
from lightdepth.camera import Pinhole
from lightdepth.checkpoint import save_model
from lightdepth.cli import parse
from lightdepth.errors import PartialFailure
from lightdepth.frame import to_batch
from lightdepth.losses import LossConfig
from lightdepth.network import NetworkConfig, build_network
from lightdepth.photometry import PhotometricCalibration
from train.ablation.plan import plans_of
from train.ablation.rows import JudgedColons, Row
from train.ablation.table import METRICS, AblationTable, Result, clear, lines, markdown, write_table
from train.colons import TubeData, with_reflectance
from train.commands.ablate import ablate
from train.datamodule import FrameData, FrameDataModule
from train.parser import training_parser

ROOT = Path(__file__).parents[1]
CONFIGS = sorted((ROOT / "configs" / "ablation").glob("*.yaml"))
CAMERA = Pinhole(40, 32, 22.0, 22.0, 18.0, 17.0)
SETTINGS = {
    "data.size": [40, 32],
    "data.batch_size": 2,
    "data.tube.scenes": 1,
    "data.tube.val_scenes": 1,
    "data.tube.frames": 2,
    "data.tube.lenses": ["pinhole"],
    "model.network.width": 4,
    "trainer.max_steps": 2,
    "trainer.accelerator": "cpu",
    "fit.monitor": "last",
}
ROWS = (Row("ours", curve=True), Row("no smoothness", "weight 0", settings={"model.loss.smoothness": 0.0}))
JUDGED = (JudgedColons("of another make", "variant", "weak", 5, 1),)


def run(output: Path, rows=ROWS, judged=JUDGED, seeds=(3,), **options) -> None:
    base = ROOT / "configs" / "train" / "tube_smoke.yaml"
    ablate(output, base, options.pop("settings", SETTINGS), rows, judged, seeds, **options)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Two rows of one seed, on colons that are really rendered."""
    folder = tmp_path_factory.mktemp("ablation")
    run(folder / "run", table=folder / "docs" / "ablation.md")
    return folder


@pytest.fixture
def cheap(monkeypatch):
    """Colons and trainings that cost nothing: a cylinder under the light of its seed, and a network as it starts."""

    def scene(tube, seed, index, size):
        light = PhotometricCalibration(gain=100.0, reflectance=0.1 * (seed % 7))
        frame = cylinder(CAMERA).frame(light=light)
        return [to_batch(frame, size) for _ in range(tube.frames)]

    monkeypatch.setattr("train.datamodule.tube_scene", scene)
    monkeypatch.setattr("train.ablation.judge.tube_scene", scene)
    monkeypatch.setattr(judging, "variant_frames", lambda *_: [cylinder(CAMERA).frame()])
    monkeypatch.setattr(ablation, "fit", untrained)


def untrained(model, data, folder, *_, **__) -> dict[str, float]:
    folder.mkdir(parents=True, exist_ok=True)
    save_model(model.network, folder / "model.safetensors", {"rows": 32})
    return {}


@pytest.fixture
def trained(monkeypatch) -> list[str]:
    """The names of the rows that are trained from here on."""
    names, real = [], ablation._trained

    def recorded(parser, plan, *rest):
        names.append(plan.row.name)
        return real(parser, plan, *rest)

    monkeypatch.setattr(ablation, "_trained", recorded)
    return names


def test_a_run_leaves_a_table_with_every_row_and_every_number_behind_it(finished):
    text = (finished / "docs" / "ablation.md").read_text()
    assert text == (finished / "run" / "ablation.md").read_text()
    assert "| ours |" in text and "| no smoothness | weight 0 |" in text and "not to be edited" in text
    assert "30000" in text and "of another make: seeds 5, 2 frames each" in text  # what was trained and judged on
    with (finished / "run" / "ablation.csv").open() as file:
        numbers = list(csv.DictReader(file))
    assert len(numbers) == len(ROWS) * len(METRICS)
    assert all(float(n["ratio"]) == pytest.approx(float(n["error"]) / float(n["closed_form"]), 1e-3) for n in numbers)
    assert json.loads((finished / "run" / "run.json").read_text())["trainings"] == 2
    left = sorted(p.name for p in (finished / "run" / "seed_3").iterdir())
    assert left == ["no_smoothness", "no_smoothness.json", "ours", "ours.json"]
    assert (finished / "run" / "seed_3" / "ours" / "model.safetensors").is_file()


def test_what_is_done_is_kept_and_only_what_changed_or_broke_is_trained_anew(finished, tmp_path, cheap, trained):
    copy = tmp_path / "run"
    shutil.copytree(finished / "run", copy)
    run(copy)
    assert trained == []
    changed = replace(ROWS[1], settings={"model.loss.smoothness": 1.0})
    run(copy, rows=(ROWS[0], changed))
    assert trained == ["no smoothness"]
    (copy / "seed_3" / "ours.json").write_text('{"stamp": ')
    run(copy, rows=(ROWS[0], changed))
    assert trained == ["no smoothness", "ours"]
    run(copy, rows=(ROWS[0], changed), overwrite=True)
    assert trained == ["no smoothness", "ours", "ours", "no smoothness"]


def test_an_interrupted_run_goes_on_with_the_row_that_it_was_at(tmp_path, cheap, trained, monkeypatch):
    def interrupted(model, *rest, **options):
        if model.loss_config.smoothness == 0:
            raise KeyboardInterrupt
        return untrained(model, *rest, **options)

    monkeypatch.setattr(ablation, "fit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "run")
    assert not (tmp_path / "run" / "run.json").exists()
    monkeypatch.setattr(ablation, "fit", untrained)
    run(tmp_path / "run")
    assert trained == ["ours", "no smoothness", "no smoothness"] and (tmp_path / "run" / "run.json").exists()


def test_the_rows_of_a_seed_share_its_colons(tmp_path, cheap, monkeypatch):
    import train.datamodule as datamodule

    drawn = []

    def noted(real):
        return lambda tube, seed, *rest: drawn.append(seed) or real(tube, seed, *rest)

    for name in ("tube_scene", "val_scene"):
        monkeypatch.setattr(datamodule, name, noted(getattr(datamodule, name)))
    other = Row("other colons", settings={"data.tube.family": "realistic"}, seeds=(3,))
    run(tmp_path / "run", rows=(*ROWS, other), seeds=(3, 4))
    assert drawn == [30000, 1030000] * 2 + [40000, 1040000]


def test_a_row_that_fails_is_in_the_table_and_the_others_are_done(tmp_path, cheap, monkeypatch):
    def failing(model, *rest, **options):
        if model.loss_config.smoothness == 0:
            raise PartialFailure("it went nowhere")
        return untrained(model, *rest, **options)

    monkeypatch.setattr(ablation, "fit", failing)
    with pytest.raises(PartialFailure, match="1 training failed, the first: no smoothness: it went nowhere"):
        run(tmp_path / "run")
    text = (tmp_path / "run" / "ablation.md").read_text()
    assert "- no smoothness, seed 3: it went nowhere" in text and "| ours |" in text
    assert json.loads((tmp_path / "run" / "run.json").read_text())["failures"]


@pytest.mark.parametrize("record", ['{"mine": 1}', '{"verb": "predict", "versions": {}}'])
def test_a_record_that_is_of_no_ablation_is_not_replaced(tmp_path, record):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text(record)
    with refused("run.json that no ablation made", cure="another -o"):
        run(tmp_path / "run")
    assert (tmp_path / "run" / "run.json").read_text() == record


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"rows": (ROWS[0], Row("bad", settings={"model.loss.smothness": 1}))},
            "row 'bad' … not accept option 'loss.smothness'",
        ),
        ({"rows": (ROWS[0], Row("bad", settings={"model.loss.gain": "two"}))}, "row 'bad' … model.loss.gain"),
        ({"rows": (ROWS[0], Row("bad", settings={"model.network.inputs": ["blue"]}))}, "row 'bad' … blue"),
        ({"rows": (ROWS[0], Row("bad", settings={"model.loss": 3}))}, "model.loss is a group of options"),
        ({"rows": (ROWS[0], Row("bad", settings={"seed.x": 3}))}, "row 'bad' … seed"),
        ({"rows": (ROWS[0], Row("bad", preset=Path("none.yaml")))}, "none.yaml … cannot be read"),
        ({"rows": (*ROWS, Row("Ours!"))}, "'ours' twice"),
        ({"rows": ()}, "no rows … give --config"),
        ({"rows": (Row("ours", seeds=(9,)),)}, "all are compared with this first row"),
        ({"judged": (JudgedColons("seen", "plain", "weak", 29990, 20),)}, "'seen' … 30000 is trained on with seed 3"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_what_cannot_be_used_is_said_before_anything_is_trained(changes, said, tmp_path):
    with refused(said):
        run(tmp_path / "run", **changes)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.name)
def test_every_shipped_ablation_has_rows_that_train_takes(path, tmp_path, monkeypatch, installed_weights):
    monkeypatch.chdir(ROOT)
    if "kind: dpt" in path.read_text():
        pytest.importorskip("transformers", reason="pip install 'lightdepth[dpt]' to run this")
    assert path.read_text().startswith("# ")
    given = parse(ablate, "ablate", ["--config", str(path), "-o", str(tmp_path)])
    parser = training_parser()
    parser.exit_on_error = False
    names = ("base", "settings", "rows", "judged", "seeds")
    plans = plans_of(parser, tmp_path, *(given[name] if name != "seeds" else (11,) for name in names))
    assert len(plans) == len(given["rows"]) > 10 and len(given["seeds"]) >= 3
    assert {c.make for c in given["judged"]} == {"realistic", "variant"}
    assert {c.strength for c in given["judged"]} == {"weak", "strong"}
    base = plans[0].stamp["settings"]
    assert all(plan.stamp["settings"] != base for plan in plans[1:])  # every row changes something


def result(row: str, seed: int, ratio: float, told: str = "true", failed: str = "") -> Result:
    closed = {"colons": dict.fromkeys(METRICS, 2.0)}
    errors = {} if failed else {told: {"colons": dict.fromkeys(METRICS, 2.0 * ratio)}}
    return Result(row, seed, 10, 100, 60.0, [(5, 1.0), (10, 0.5)], errors, closed, failed)


def table_of(**ratios: tuple[float, ...]) -> AblationTable:
    rows = tuple(Row(name.replace("_", " "), part="dropped") for name in ratios)
    results = [result(n.replace("_", " "), s, r) for n, values in ratios.items() for s, r in enumerate(values)]
    return AblationTable("base", rows, JUDGED, results, TubeData(scenes=2), (40, 32), 4)


def test_a_difference_is_clear_where_its_mean_is_larger_than_its_spread_over_the_seeds():
    ratios = {
        "base": (0.8, 0.9, 1.0),
        "worse": (0.9, 1.0, 1.11),
        "better": (0.7, 0.8, 0.9),
        "perhaps": (0.81, 1.0, 1.2),
        "same": (0.9, 0.9, 1.0),
        "once": (1.5,),
    }
    table = table_of(**ratios)
    verdicts = {line.name: line.verdict() for line in lines(table)[1:]}
    assert verdicts == {
        "worse": "worse",
        "better": "better",
        "perhaps": "worse in every seed",
        "same": "no clear difference",
        "once": "one seed",
    }
    text = markdown(table)
    assert "| worse |  | 1.003 (.900-1.110) | **+.103** | worse |" in text
    assert "what they leave out earns its place: worse (+.103).\n" in text
    assert "do not agree on a difference; what they leave out did not help: same (+.033).\n" in text
    assert "by less than the seeds differ, so that what they leave out may help: perhaps (+.103).\n" in text
    assert "what they leave out did harm here: better (-.100).\n" in text and "one seed: once (+.700)." in text
    assert not clear(np.array([0.5]))


def test_a_table_of_trainings_on_sequences_names_no_colons():
    table = table_of(base=(0.8,))
    text = markdown(replace(table, tube=replace(table.tube, scenes=0)))
    assert "the sequences of its settings" in text and f"{table.tube.frames} frames each, " not in text


@pytest.mark.parametrize("base", [result("base", 3, 0.8), result("base", 9, 0.8, failed="it went nowhere")])
def test_a_row_without_a_seed_in_common_with_the_first_is_shown_with_nothing_to_compare(base, tmp_path):
    rows = (Row("base"), Row("other", part="reference", seeds=(9,)))
    table = AblationTable("base", rows, JUDGED, [base, result("other", 9, 0.9)], TubeData(scenes=2), (40, 32), 4)
    write_table(table, tmp_path, None)
    text = (tmp_path / "ablation.md").read_text()
    assert "| other |  | .900 |  | no seed that the first row has |" in text
    assert "other (" not in text and ("| base |  | .800 |  |  |" in text) == (not base.failed)
    (found,) = (line for line in json.loads((tmp_path / "ablation.json").read_text()) if line["row"] == "other")
    assert found["difference"] == [] and found["overall"] == [0.9]


def test_the_overall_number_is_the_geometric_mean_over_colons_and_metrics(tmp_path):
    table = table_of(base=(0.8,))
    closed = {"a": dict.fromkeys(METRICS, 1.0), "b": dict.fromkeys(METRICS, 4.0)}
    errors = {"true": {"a": dict.fromkeys(METRICS, 0.5), "b": dict.fromkeys(METRICS, 8.0)}}
    judged = (replace(JUDGED[0], name="a"), replace(JUDGED[0], name="b"))
    table = replace(table, judged=judged, results=[replace(table.results[0], closed_form=closed, errors=errors)])
    write_table(table, tmp_path, None)
    (summary,) = json.loads((tmp_path / "ablation.json").read_text())
    assert summary["overall"] == [1.0] and summary["ratios"] == [[0.5] * 3, [2.0] * 3]


def colon_of(reflectance: float):
    return to_batch(cylinder(CAMERA).frame(light=PhotometricCalibration(gain=100.0, reflectance=reflectance)))


def test_the_reflectance_that_a_network_is_told_is_a_wrong_one_or_the_one_of_least_loss(cheap):
    class Spy:
        def __init__(self):
            self.told = []

        def __call__(self, image, mask, rays, light):
            self.told.append(round(float(light.reflectance.mean()), 3))
            # Right only when told .4: elsewhere a flat distance.
            right = colon_of(0.4).true_distance.clamp(min=1)
            distance = right if self.told[-1] == 0.4 else right.mean().expand_as(right)
            return distance.expand(len(image), -1, -1, -1), image[:, :2]

    judge = judging.Judge((JudgedColons("c", "plain", "weak", 4, 1),), TubeData(frames=1), (40, 32))
    loss, found = LossConfig(reflectance=0.0, cosine_exponent=1.0, smoothness=0.0, facing=0.0, chroma=0.0), {}
    for told in ("true", "wrong", "estimated"):
        network = Spy()
        found[told] = judge(network, loss, told)["c"]["abs_rel"]
        assert network.told[-1] == pytest.approx({"true": 0.4, "wrong": 0.7, "estimated": 0.4}[told], abs=1e-3)
    assert found["true"] == found["estimated"] == pytest.approx(0, abs=1e-6) and found["wrong"] > 0.1


def test_far_depth_and_the_rim_of_a_wide_lens_are_not_judged():
    colon = colon_of(0.0)
    right, z = colon.true_distance.clamp(min=1), colon.rays[:, 2:3].clone()
    z[..., :3], far = 0.1, torch.zeros_like(colon.mask)
    far[..., -4:] = True
    rays = torch.cat([colon.rays[:, :2], z], 1)
    seen = colon._replace(rays=rays, true_distance=torch.where(far, 300.0, right))
    wrong = torch.where(far | (z < 0.15), 7 * right, right)
    assert judging._errors([wrong], [seen])["rmse_mm"] == pytest.approx(0, abs=1e-4)
    inside = torch.where(torch.arange(40) == 20, 7 * right, right)
    assert judging._errors([inside], [seen])["rmse_mm"] > 1


def test_reflectance_goes_into_the_network_that_asks_for_it_and_into_no_other():
    torch.manual_seed(0)
    batch = colon_of(0.1)
    other = with_reflectance(batch, torch.full_like(batch.light.reflectance, 0.6))
    for inputs, changes in ((("rgb", "reflectance"), True), (("rgb",), False)):
        network = build_network(NetworkConfig(inputs=inputs, output="free", width=8)).eval()
        torch.nn.init.normal_(network.body.head.weight, std=0.1)
        first, second = (network(b.image, b.mask, b.rays, b.light)[0] for b in (batch, other))
        assert torch.equal(first, second) != changes


def test_a_wrong_and_a_random_reflectance_reach_what_is_trained_on(cheap):
    def seen(training: bool, **options) -> list[float]:
        data = FrameDataModule(
            FrameData(tube=TubeData(scenes=7, val_scenes=1, frames=1), size=(40, 32), augment=False, **options)
        )
        data.setup()
        data.trainer = type("T", (), {"training": training, "global_step": 5, "global_rank": 0, "world_size": 1})()
        batches = data.val_dataloader() if not training else data.train_dataloader()
        return [float(v) for b in batches for v in data.on_after_batch_transfer(b, 0).light.reflectance.flatten()]

    assert sorted(seen(True)) == pytest.approx([0.1 * k for k in (0, 1, 3, 6)], abs=0.31)
    own, off = seen(True), seen(True, reflectance_error=0.4)
    assert off == pytest.approx([min(v + 0.4, 0.95) for v in own]) and max(off) == pytest.approx(0.95)
    assert seen(False, reflectance_error=-0.9) == [0.0]  # validation is told the same wrong thing
    drawn = seen(True, random_reflectance=(0.3, 0.5))
    assert len(set(drawn)) == len(drawn) and all(0.3 <= v <= 0.5 for v in drawn)
    assert seen(False, random_reflectance=(0.3, 0.5)) == seen(False)
    with refused(where="random_reflectance"):
        FrameDataModule(FrameData(random_reflectance=(0.5, 0.2)))

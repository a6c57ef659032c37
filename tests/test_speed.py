"""`bench speed`: loads are what is counted, floors lie below times, and its file tells what runs cost."""

from __future__ import annotations

import ast
import inspect
import json
import math
import textwrap
from functools import partial, total_ordering
from pathlib import Path

import numpy as np
import pytest
import torch
from pages import check_self_contained
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from densify import agreement
from densify.commands.bench import measure_speed
from densify.costs import fitted, read_speed
from densify.fusion import rectify, volume
from densify.speed import loads
from densify.speed import machine as machine_room
from densify.speed.given import Given, write_colon
from densify.speed.machine import Load, Machine, Rates, measured_machine, side_by_side
from densify.speed.references import lmeds_by_partition
from densify.speed.stages import STAGES, Stage
from densify.speed.work import stages_of, timed_stage
from lightdepth.checkpoint import ModelSource, load_model
from lightdepth.decline import masked_blur
from lightdepth.robust import lmeds_scale

CPU = torch.device("cpu")
SIZE = (64, 52)


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> Given:
    """Four small keyframes, and the network that comes with the program."""
    folder = tmp_path_factory.mktemp("speed") / "colon"
    write_colon(folder, SIZE, 4)
    return Given(folder, load_model("lightdepth-self", details=False))


def one(name: str) -> Stage:
    """The stage of that name."""
    (found,) = (stage for stage in STAGES if stage.name == name)
    return found


def load_of(name: str, given: Given) -> Load:
    return one(name).load(given)


def test_a_floor_is_the_longer_of_what_is_moved_and_what_is_done():
    rates = Rates(10.0, {"float32": 100.0, "comparison": 50.0})
    assert rates.floor(Load({"float32": 200.0, "comparison": 100.0}, 10.0)) == pytest.approx(4.0)
    assert rates.floor(Load({"float32": 200.0}, 100.0)) == pytest.approx(10.0)


def test_no_stage_is_done_sooner_than_a_machine_that_nobody_has_would_do_it_and_each_has_a_reference(given):
    # The rates of this machine are no bounds here: they are measured at another moment, and other work may be beside.
    rates = Rates(1e12, dict.fromkeys(("float32", "bfloat16", "float64", "comparison"), 1e14))
    for stage in stages_of(given.model):
        found = timed_stage(stage, given, [Machine("cpu", 1, rates, rates)], 0.0)
        assert 0 < found.floor.clock <= found.least.clock <= found.median.clock, stage.name
        assert 0 < found.floor.core <= found.median.core, stage.name
        assert found.reference_median.clock > 0 and found.rounds >= 3
        assert found.bytes > 0


def test_a_stage_that_runs_where_the_model_does_has_the_floor_of_that_machine(given):
    rates = dict.fromkeys(("float32", "bfloat16", "float64", "comparison"), 1e12)
    quick, slow = Rates(1e12, rates), Rates(1.0, rates)
    machines = [Machine("cpu", 1, quick, quick), Machine("another", 1, slow, slow)]
    found = {name: timed_stage(one(name), given, machines, 0.0) for name in ("closed form", "sampling")}
    assert found["closed form"].device == "another" and found["closed form"].floor.clock == found["closed form"].bytes
    assert found["sampling"].device == "cpu" and found["sampling"].floor.clock < 1e-3


def test_the_network_s_operations_are_those_of_its_layers(given):
    counted = [0]

    def count(layer: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        assert isinstance(layer, nn.Conv2d)
        each = layer.in_channels // layer.groups * layer.kernel_size[0] * layer.kernel_size[1]
        counted[0] += 2 * each * output.numel()

    network, batch = given.model.network, given.batch  # made before layers are counted
    hooks = [layer.register_forward_hook(count) for layer in network.modules() if isinstance(layer, nn.Conv2d)]
    load = load_of("network, float32", given)
    for hook in hooks:
        hook.remove()
    blurred = loads.blur(batch.image[0, 0].numel(), kernel_of(batch.image.shape[-2]))
    assert load.operations == {"float32": counted[0] + blurred}
    weights = sum(p.numel() for p in network.parameters())
    assert load.bytes - load_of("network, bfloat16", given).bytes == 2 * weights


def kernel_of(rows: int) -> int:
    return 2 * int(3 * 0.018 * rows + 0.5) + 1


def test_the_closed_form_s_blur_is_counted_as_pytorch_counts_it():
    values, mask = torch.rand(1, 1, 40, 50), torch.ones(1, 1, 40, 50, dtype=torch.bool)
    with FlopCounterMode(display=False) as counter:
        masked_blur(values, mask, 1.5)
    assert loads.blur(40 * 50, 11) == counter.get_total_flops()


@total_ordering
class Compared:
    """A number that counts how often it is compared."""

    count = 0

    def __init__(self, value: float) -> None:
        self.value = value

    def __lt__(self, other: Compared) -> bool:
        Compared.count += 1
        return self.value < other.value


@pytest.mark.parametrize("n", [256, 1000])
def test_a_sort_takes_hardly_more_comparisons_than_it_is_counted_as(n):
    Compared.count = 0
    sorted(map(Compared, np.random.default_rng(0).permutation(n)))
    load = loads.lmeds(n).operations["comparison"]
    assert load == pytest.approx(math.log2(math.factorial(n))) and load <= Compared.count <= 1.06 * load


def test_the_tuned_loop_finds_the_same_scale_as_the_exact_search():
    rng = np.random.default_rng(1)
    predicted = rng.uniform(10, 50, 60)
    mapped = 2 * predicted * np.exp(0.05 * rng.normal(size=60))
    assert lmeds_by_partition(mapped, predicted) == pytest.approx(lmeds_scale(mapped, predicted).median)


def test_a_round_of_agreement_is_counted_by_the_rows_that_it_solves(given, monkeypatch):
    seen: list[agreement._Rows] = []
    kept = agreement._step

    def step(rows, *others, **named):
        seen.extend(rows)
        return kept(rows, *others, **named)

    monkeypatch.setattr(agreement, "_step", step)
    one("agreement, a round").run(given)
    counted = 0.0
    for row in seen:
        columns = sum(block.shape[1] for block in row.blocks.values())
        counted += len(row.residual) * (columns * (columns + 1) + 2 * columns)
    unknowns = given.unknowns * len(given.alone)
    counted += unknowns**3 / 3 + 2 * unknowns**2
    assert len(seen) > len(given.alone)  # overlaps are there
    assert load_of("agreement, a round", given).operations["float64"] == pytest.approx(counted, rel=0.1)


def arithmetic(function: object, loop: int) -> int:
    """Operations of the n-th loop over v of a compiled loop, indices left out."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(getattr(function, "py_func", function)))))
    loops = [n for n in ast.walk(tree) if isinstance(n, ast.For) and ast.unparse(n.target) == "v"]
    body = loops[loop]
    indices = {id(inner) for n in ast.walk(body) if isinstance(n, ast.Subscript) for inner in ast.walk(n.slice)}
    found = 0
    for node in ast.walk(body):
        if id(node) in indices:
            continue
        found += isinstance(node, ast.BinOp | ast.AugAssign | ast.IfExp)
        found += isinstance(node, ast.Call) and ast.unparse(node.func) in ("np.sqrt", "np.rint")
    return found


def test_a_voxel_s_operations_are_those_of_the_loops():
    assert arithmetic(rectify._look_up, 0) == loads.LOOK_UP
    assert arithmetic(volume._add_view, 1) == loads.PLANE


def test_a_mesh_s_bytes_are_those_of_its_arrays(given):
    mesh = given.volume.extract_mesh()
    vertices = sum(a.nbytes for a in (mesh.vertices, mesh.colors, mesh.weights, mesh.views))
    assert (
        loads.VERTEX * len(mesh.vertices) == vertices and loads.TRIANGLE * len(mesh.triangles) == mesh.triangles.nbytes
    )


def test_works_take_turns_and_a_first_time_is_not_counted():
    order: list[str] = []
    first, second = side_by_side([lambda: order.append("a"), lambda: order.append("b")], 0.0, CPU)
    assert len(first) == len(second) == 3 and order == ["a", "b"] * 4


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A whole run, as small as it gets."""
    folder = tmp_path_factory.mktemp("run") / "speed"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(machine_room, "measured_machine", partial(measured_machine, copied=2**22, side=512))
        measure_speed(folder, ModelSource("decline"), (SIZE,), keyframes=4, seconds=0.01)
    return folder


def test_a_run_says_every_stage_whole_runs_and_costs(run):
    found = json.loads((run / "speed.json").read_text(encoding="utf-8"))
    (at,) = found["sizes"]
    assert at["size"] == list(SIZE)
    assert [stage["name"] for stage in at["stages"]] == [s.name for s in STAGES if not s.network]
    assert [each["keyframes"] for each in found["runs"]] == [4, 8, 4]
    assert found["runs"][2]["size"] == [2 * side for side in SIZE]
    for each in found["runs"]:
        assert {"read", "predict", "align", "judge", "agree", "integrate", "extract"} <= set(each["steps"])
        assert sum(each["steps"].values()) < each["seconds"] and each["bytes"] > 1e5
    assert found["cost"]["a hospital's year"]["processor_hours"] == pytest.approx(
        1e4 * found["cost"]["a screening procedure"]["processor_hours"]
    )
    assert fitted(read_speed(run / "speed.json").runs, lambda each: each.besides).of(4, 0.01) > 0
    text = (run / "speed.md").read_text(encoding="utf-8")
    assert "over the floor" in text and "a hospital's year" in text and "VoxelBlockGrid" in text
    assert check_self_contained(run / "report.html").tags.count("table") == 3

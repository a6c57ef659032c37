"""What strangers hand in does nothing: no code of theirs runs, and nothing outside the output is touched."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from importlib import metadata
from inspect import signature
from typing import Any, get_args, get_type_hints

import pytest
import yaml
from raising import refused, warned

from densify.exporting.colmap import stem
from lightdepth import plain_yaml
from lightdepth.cli import main
from lightdepth.command_line.verbs import GROUP, verb_parser
from lightdepth.datasets.catalogue import inside
from lightdepth.datasets.splits import located
from lightdepth.reporting.report import Report
from train.parser import training_parser

CODE = "open({!r}, 'w').close()\nclass Thing: pass\n"


@pytest.fixture
def canary(tmp_path, monkeypatch):
    """A file that no stranger's may make; importing the module `stranger`, or any function of it, makes it."""
    path = tmp_path / "canary"
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "stranger.py").write_text(CODE.format(str(path)))
    monkeypatch.syspath_prepend(tmp_path / "modules")
    monkeypatch.chdir(tmp_path)
    yield path
    assert not path.exists()
    assert not [found for found in tmp_path.rglob("outside*") if "inside" not in found.parts]


CONFIGS = {
    "a callback that calls": (
        "train",
        "trainer: {callbacks: {class_path: lightning.pytorch.callbacks.LambdaCallback, "
        "init_args: {on_fit_start: stranger.Thing}}}",
    ),
    "a logger elsewhere": (
        "train",
        "trainer: {logger: {class_path: lightning.pytorch.loggers.CSVLogger, init_args: {save_dir: ../outside}}}",
    ),
    "a profiler elsewhere": (
        "train",
        "trainer: {profiler: {class_path: SimpleProfiler, init_args: {dirpath: ../outside}}}",
    ),
    "a strategy of another's": ("train", "trainer: {strategy: {class_path: stranger.Thing}}"),
    "a strategy by its name": ("train", "trainer: {strategy: deepspeed}"),
    "a class in place of a group": ("train", "model: {network: {class_path: stranger.Thing}}"),
    "a class's name in place of a group": ("train", "fit: {diagnosis: stranger.Thing}"),
    "a folder of the trainer's own": ("train", "trainer: {default_root_dir: outside}"),
    "a class in a group of densify": ("densify", "sfm: {class_path: stranger.Thing}"),
    "a class's name in densify": ("densify", "sfm: stranger.Thing"),
    "a class in a list": ("ablate", "rows: [{class_path: stranger.Thing}]"),
    "a class's name in a list": ("ablate", "rows: [stranger.Thing]"),
    "a class where any value goes": ("ablate", "settings: {a: {class_path: stranger.Thing}}\nrows: [{name: a}]"),
    "a tag of Python's": ("predict", "checkpoint: !!python/object/apply:os.system ['touch canary']"),
    "an object of Python's": ("convert-camera", "!!python/object/new:stranger.Thing {}"),
}


@pytest.mark.parametrize("case", CONFIGS)
def test_no_code_is_run_and_no_module_imported_for_a_strangers_settings(case, canary, tmp_path):
    verb, text = CONFIGS[case]
    (tmp_path / "c.yaml").write_text(text)
    words = [] if verb in ("train", "ablate") else ["D"]
    try:
        code = main([verb, *words, "--config", str(tmp_path / "c.yaml"), "-o", str(tmp_path / "inside"), *QUICK[verb]])
    except SystemExit as stopped:
        code = stopped.code
    assert code in (2, 3)


QUICK: dict[str, list[str]] = {
    "train": ["--data.sequences", "[nowhere]"],
    "densify": [],
    "predict": [],
    "ablate": [],
    "convert-camera": [],
}


def _kinds(kind: Any, seen: set[Any]) -> set[Any]:
    """The types that a type is made of, those of the fields of its dataclasses among them."""
    parts = get_args(kind)
    if is_dataclass(kind) and kind not in seen:
        seen.add(kind)
        hints = get_type_hints(kind)
        return {k for field in fields(kind) for k in _kinds(hints[field.name], seen)}
    return {k for part in parts for k in _kinds(part, seen)} if parts else {kind}


def test_no_option_of_any_verb_takes_a_class_a_function_or_just_anything():
    plain = {bool, int, float, str, type(None), ...}
    for entry in metadata.entry_points(group=GROUP):
        function = entry.load()
        if entry.name == "bench":
            continue  # its parts are made of the same settings
        parser = training_parser() if list(signature(function).parameters) == ["argv"] else None
        parser = parser or verb_parser(function, entry.name)
        for action in parser._actions:
            for kind in _kinds(getattr(action, "_typehint", None) or str, set()):
                known = (
                    kind in plain or not isinstance(kind, type) or issubclass(kind, (str, int)) or is_dataclass(kind)
                )
                assert known or kind.__module__ in ("pathlib", "pathlib._local"), (entry.name, action.dest, kind)
                assert kind is not Any and kind is not object, (entry.name, action.dest)


def test_a_file_of_settings_says_neither_where_a_run_goes_nor_what_is_replaced_there(canary, tmp_path, capsys):
    (tmp_path / "outside.txt").write_text("mine")
    settings = {"output": str(tmp_path / "outside"), "overwrite": True, "resume": True, "config": "outside.yaml"}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump({**settings, "seed": 7}))
    (tmp_path / "inside").mkdir()
    (tmp_path / "outside.txt").rename(tmp_path / "inside" / "run.json")
    with warned("output, overwrite, resume, config"):
        assert main(["train", "--config", "c.yaml", "-o", "inside"]) == 3  # the run there is kept
    assert "holds a complete run" in capsys.readouterr().err
    assert (tmp_path / "inside" / "run.json").read_text() == "mine"


def test_the_settings_of_the_run_that_is_resumed_run_no_code_either(canary, tmp_path):
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "config.yaml").write_text("model: {network: stranger.Thing}\n")
    with pytest.raises(SystemExit) as stopped:
        main(["train", "--resume", "-o", "inside"])
    assert stopped.value.code == 2


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]\n" for i in range(9)
)
MERGED = "a0: &a0 {k0: 1}\n" + "".join(
    f"a{i + 1}: &a{i + 1} {{k{i + 1}: 1, <<: [{', '.join([f'*a{i}'] * 10)}]}}\n" for i in range(9)
)
BOMBS = {
    "aliases of aliases": BOMB,
    "merged aliases": MERGED,
    "an alias inside itself": "a: &a [*a]\n",
    "nested deep": "a: " + "[" * 100_000,
    "nested in blocks": "".join(" " * i + "a:\n" for i in range(200)),
    "many values": "a: [" + "1," * 3000 + "]",
    "long": "a: " + "x" * (plain_yaml.MAX_BYTES + 1),
}


@pytest.mark.parametrize("case", BOMBS)
def test_yaml_that_stands_for_more_than_it_is_is_refused_wherever_it_is_read(case, tmp_path, capsys, monkeypatch):
    text = BOMBS[case]
    if case == "many values":
        monkeypatch.setattr(plain_yaml, "MAX_NODES", 2000)  # more take seconds
    for read in (plain_yaml.load, plain_yaml.check):
        with pytest.raises(yaml.YAMLError):
            read(text)
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        main(["predict", "D", "-o", "O", "--config", str(tmp_path / "c.yaml")])
    assert stopped.value.code == 2
    assert main(["convert-camera", str(tmp_path / "c.yaml"), "-o", str(tmp_path / "camera.json")]) == 3
    assert main(["ablate", "-o", str(tmp_path / "O"), "--base", str(tmp_path / "c.yaml")]) == 3
    said = capsys.readouterr().err
    assert "Traceback" not in said and len(said) < 3000


@pytest.mark.parametrize("value", ["!!bool x", "!!timestamp x", "!!int x", "!!binary é", "!!pairs 1", "2001-99-99"])
def test_yaml_that_says_another_kind_than_it_is_is_refused_wherever_it_is_read(value, tmp_path, capsys):
    with pytest.raises(yaml.YAMLError):
        plain_yaml.load(f"a: {value}")
    (tmp_path / "c.yaml").write_text(f"seed: {value}\n", encoding="utf-8")
    for verb in ("synth", "predict"):
        with pytest.raises(SystemExit) as ended:
            main([verb, "-o", str(tmp_path / "run"), "--config", str(tmp_path / "c.yaml")])
        assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_value_on_the_command_line_is_bounded_as_a_file_is(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["densify", "D", "-o", "O", "--merging", BOMB])
    assert stopped.value.code == 2 and len(capsys.readouterr().err) < 3000


def test_a_split_reads_no_folder_that_a_link_out_of_its_root_leads_to(canary, tmp_path):
    for folder in ("root/a", "elsewhere/b"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "root" / "b").symlink_to(tmp_path / "elsewhere" / "b")
    (tmp_path / "root" / "c").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "root" / "d").symlink_to(tmp_path / "root" / "a")
    (tmp_path / "data").symlink_to(tmp_path / "root")  # the root itself is the user's to name
    assert located(tmp_path / "data", "d") == tmp_path / "data" / "d"
    for name in ("b", "c", "c/b"):
        with refused(str(tmp_path / "elsewhere"), where=name):
            located(tmp_path / "data", name)
    for name in ("../elsewhere", "a/../../elsewhere", "/etc", "~", "C:x", "..\\elsewhere"):
        with refused("leads outside"):
            inside(name)


HOSTILE_NAMES = [
    "../../outside_1",
    "/outside_1",
    "..\\outside_1",
    "-o",
    "$(touch canary)_1",
    "<script>x</script>_1",
    "a\nb_1",
]


@pytest.mark.parametrize("name", HOSTILE_NAMES)
def test_a_name_in_a_map_is_a_name_and_neither_a_path_nor_a_tag(name, canary, tmp_path):
    written = tmp_path / "inside" / f"{stem(Named(name))}.png"
    assert written.resolve().parent == (tmp_path / "inside").resolve()
    page = Report(name)
    page.text(name)
    page.figures([(b"", f'{name}" onload="x')])
    page.table([name], [[name]])
    page.write(tmp_path / "report.html")
    assert (
        "<script" not in (tmp_path / "report.html").read_text()
        and '" onload' not in (tmp_path / "report.html").read_text()
    )


@dataclass
class Named:
    name: str


XML = {
    "entities in entities": '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 9)).replace("&a0;", "&a;")
    + "]><opencv_storage><a>&a8;</a></opencv_storage>",
    "a file": '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><opencv_storage><a>&a;</a></opencv_storage>',
    "another's definitions": '<!DOCTYPE x SYSTEM "http://192.0.2.1/x.dtd"><opencv_storage/>',
    "vicalib": '<!DOCTYPE rig [<!ENTITY a SYSTEM "canary">]><rig><camera>&a;</camera></rig>',
}


@pytest.mark.parametrize("case", XML)
def test_xml_opens_no_file_and_grows_by_no_entity(case, canary, tmp_path, capsys):
    (tmp_path / "camera.xml").write_text(XML[case])
    assert main(["convert-camera", str(tmp_path / "camera.xml"), "-o", str(tmp_path / "camera.json")]) == 3
    said = capsys.readouterr().err
    assert "root:" not in said and len(said) < 1000 and not (tmp_path / "camera.json").exists()

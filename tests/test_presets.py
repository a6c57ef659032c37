"""Settings that come with the program, and settings that are gone from it."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path

import pytest
import yaml

from lightdepth.cli import main, parse
from lightdepth.command_line import gone_settings
from lightdepth.command_line.options import groups_of
from lightdepth.command_line.presets import FOLDERS, preset_help, presets, shipped, with_preset

ROOT = Path(__file__).resolve().parents[1]


class Wrong(Exception):
    """What stands in for a parser's end of the program."""


def refuse(message: str) -> None:
    raise Wrong(message)


def verb(data: str = "nothing", number: int = 0, many: tuple[int, ...] = (1,), output: Path = Path("out")) -> None:
    """A verb with few options."""


@pytest.fixture
def configs(monkeypatch, tmp_path) -> Path:
    """A folder of presets for the verb above, which is called `try`."""
    (tmp_path / "try").mkdir()
    (tmp_path / "try" / "first.yaml").write_text("number: 1\nmany: [1, 2]\ndata: preset\n")
    monkeypatch.setattr("lightdepth.command_line.presets._CONFIGS", tmp_path)
    monkeypatch.setitem(FOLDERS, "try", "try")
    return tmp_path


def test_every_verb_with_presets_has_some_and_names_them_in_its_help():
    assert all(presets(v) for v in FOLDERS) and presets("densify") == {}
    assert {"paper", "lightdepth", "tube_smoke"} <= set(presets("train"))
    assert "paper, synthetic, tube_smoke" in preset_help("train")


def test_the_presets_are_the_files_of_the_repository_s_configs():
    for name, folder in FOLDERS.items():
        assert {p.resolve() for p in presets(name).values()} == set((ROOT / "configs" / folder).glob("*.yaml"))


def test_a_config_counts_more_than_a_preset_and_an_option_more_than_both_in_any_order(configs):
    (configs / "own.yaml").write_text("number: 2\ndata: config\n")
    own = ["--config", str(configs / "own.yaml")]
    for argv in (["--data", "option", *own, "--preset", "first"], ["--preset=first", *own, "--data=option"]):
        found = parse(verb, "try", argv)
        assert (found["data"], found["number"], tuple(found["many"])) == ("option", 2, (1, 2))
    assert parse(verb, "try", ["--preset", "first"])["data"] == "preset"


def test_an_unknown_preset_is_one_line_with_the_nearest_name():
    with pytest.raises(Wrong, match=r"^--preset papr: no such preset of train; is paper meant\?$"):
        with_preset("train", ["--preset", "papr"], refuse)
    with pytest.raises(Wrong, match="expected one of both, c3vd, endomapper"):
        with_preset("train", ["--preset=?"], refuse)
    with pytest.raises(Wrong, match="--config takes a file"):
        with_preset("train", ["--preset", "configs/train/paper.yaml"], refuse)
    with pytest.raises(Wrong, match="expected the name of a preset after it"):
        with_preset("train", ["-o", "x", "--preset"], refuse)


@pytest.mark.parametrize("name", ["train", "ablate"])
def test_an_unknown_preset_is_wrong_usage_and_touches_nothing(name, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([name, "--preset", "lightdeph", "-o", str(tmp_path / "out")])
    assert stopped.value.code == 2 and not any(tmp_path.iterdir())
    assert capsys.readouterr().err.count("is lightdepth meant?") == 1


def test_a_verb_without_presets_does_not_take_the_option():
    assert with_preset("densify", ["--preset", "x"], refuse) == ["--preset", "x"]


def test_a_path_into_configs_is_found_from_any_folder_and_a_file_of_one_s_own_wins(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    asked = Path("configs/train/paper.yaml")
    assert shipped(asked).read_bytes() == (ROOT / asked).read_bytes()
    assert shipped(Path("configs/train/none.yaml")) == Path("configs/train/none.yaml")
    asked.parent.mkdir(parents=True)
    asked.write_text("mine")
    assert shipped(asked).read_text() == "mine"


@pytest.fixture
def gone(monkeypatch) -> None:
    monkeypatch.setitem(gone_settings.GONE_SETTINGS, "try", {"old": "it did nothing", "part.worn": "always on"})


def test_settings_that_are_gone_are_left_out_with_one_warning_that_names_them(gone, tmp_path):
    (tmp_path / "c.yaml").write_text(yaml.safe_dump({"number": 5, "old": 1, "part": {"worn": 2}, "many": [3]}))
    for argv in (["--config", str(tmp_path / "c.yaml")], [f"--config={tmp_path / 'c.yaml'}"]):
        with pytest.warns(UserWarning) as said:
            argv = gone_settings.without_gone("try", argv)
        assert [str(w.message) for w in said] == [
            f"{tmp_path / 'c.yaml'}: settings that no longer exist are ignored: "
            "old (it did nothing); part.worn (always on)"
        ]
        assert "old" not in argv[-1] and "number: 5" in argv[-1]


def test_a_config_with_a_setting_that_is_gone_is_parsed(gone, tmp_path):
    (tmp_path / "c.yaml").write_text("number: 5\nold: 1\n")
    with pytest.warns(UserWarning, match="old"):
        assert parse(verb, "try", ["--config", str(tmp_path / "c.yaml"), "--data", "x"])["number"] == 5


def test_a_setting_that_never_was_is_wrong_usage(gone, tmp_path, capsys):
    (tmp_path / "c.yaml").write_text("numbr: 5\n")
    with pytest.raises(SystemExit) as stopped:
        parse(verb, "try", ["--config", str(tmp_path / "c.yaml")])
    assert stopped.value.code == 2 and "numbr" in capsys.readouterr().err


def test_a_config_without_settings_that_are_gone_stays_a_file(gone, tmp_path):
    (tmp_path / "c.yaml").write_text("number: 5\npart: 3\n")
    argv = ["--config", str(tmp_path / "c.yaml"), "--config", str(tmp_path / "none.yaml")]
    assert gone_settings.without_gone("try", argv) == argv


def test_settings_that_are_gone_are_no_options_of_today():
    from importlib import metadata

    for name, keys in gone_settings.GONE_SETTINGS.items():
        (entry,) = metadata.entry_points(group="lightdepth.commands", name=name)
        run = entry.load()
        fields = {f.name for group in groups_of(run).values() for f in dataclasses.fields(group)}
        assert not set(keys) & (fields | (set(inspect.signature(run).parameters) - set(groups_of(run))))

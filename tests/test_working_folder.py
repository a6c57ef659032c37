import os
import subprocess
import sys

import pytest

from lightdepth.files.working import working_folder


def left_by_a_dead_process(place):
    code = (
        "import os, sys; from pathlib import Path; from lightdepth.files.working import working_folder\n"
        "with working_folder(Path(sys.argv[1])) as folder:\n    (folder / 'frames').mkdir(); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", code, str(place)], check=False)
    (left,) = place.iterdir()
    return left


def test_what_a_killed_run_left_goes_with_the_next_and_nothing_else_does(tmp_path):
    left = left_by_a_dead_process(tmp_path)
    (left / "frames" / "0.png").write_bytes(b"0")
    number = left.name.split("-")[3]
    theirs = [
        tmp_path / name for name in (".lightdepth-work-mine", f".lightdepth-work-00000000-{number}-another-machine-s")
    ]
    for folder in theirs:
        folder.mkdir()
    (tmp_path / "kept").mkdir()
    link = tmp_path / f"{left.name}0"
    link.symlink_to(tmp_path / "kept")
    with working_folder(tmp_path) as outer, working_folder(tmp_path) as inner:
        assert outer != inner and outer.is_dir() and inner.is_dir()  # those of a living process stay
        assert not left.exists()
    assert set(tmp_path.iterdir()) == {*theirs, tmp_path / "kept", link}


def test_it_goes_when_something_is_raised_in_it_and_lies_where_passing_files_do_by_default(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(KeyError), working_folder() as folder:
        assert folder.parent == tmp_path and os.stat(folder).st_mode & 0o077 == 0
        raise KeyError
    assert not any(tmp_path.iterdir())

"""Libraries that need a hand before they can be imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from raising import refused

from lightdepth import native


def test_cv2_is_imported_before_pycolmap():
    code = (
        "import sys; from lightdepth import native; native.pycolmap(); names = list(sys.modules);"
        "assert names.index('cv2') < names.index('pycolmap')"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_pycolmap_leaves_sigterm_to_whoever_had_it():
    code = (
        "import signal; from lightdepth import native; heard = [];"
        "signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number));"
        "native.pycolmap(); signal.raise_signal(signal.SIGTERM); assert heard == [signal.SIGTERM]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_the_module_imports_none_of_the_heavy_ones():
    code = (
        "import sys; import lightdepth.native;"
        "assert not {'cv2', 'pycolmap', 'open3d', 'torch', 'numpy'} & set(sys.modules), sorted(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_modules_are_loaded_once():
    assert native.pycolmap() is native.pycolmap()
    assert native.pycolmap().__name__ == "pycolmap"


def test_missing_system_libraries_are_named_by_their_package(monkeypatch):
    monkeypatch.setattr(native, "SYSTEM_LIBRARIES", {"libc.so.6": "libc6", "libnowhere.so.1": "libnowhere1"})
    assert native.missing_system_libraries() == ["libnowhere1"]


def test_an_open3d_that_cannot_be_loaded_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with refused(cure="apt-get install libusb-1.0-0 libgl1"):
        native.open3d.__wrapped__()


def test_what_warp_compiles_is_kept_in_the_users_own_folder_and_nowhere_where_others_may_write(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    own = tmp_path / "lightdepth" / "warp"
    assert native._kept_in() == own and own.stat().st_mode & 0o777 == 0o700
    own.chmod(0o777)
    passing = native._kept_in()
    assert passing != own and passing.is_dir() and not native.open_to_others(passing)


def test_a_user_without_a_home_has_what_warp_compiles_for_one_process(tmp_path):
    """Nor is a folder made where the process happens to be."""
    code = (
        "from pathlib import Path; Path.home = classmethod(lambda cls: (_ for _ in ()).throw(RuntimeError()));"
        "from lightdepth import native; print(native._kept_in())"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME", "WARP_CACHE_PATH")}
    made = subprocess.run([sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, check=True)
    assert not Path(made.stdout.decode().strip()).exists() and not any(tmp_path.iterdir())

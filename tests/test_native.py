"""Libraries that need a hand before they can be imported."""

from __future__ import annotations

import subprocess
import sys

from raising import refused

from lightdepth import native


def test_cv2_is_imported_before_pycolmap():
    code = (
        "import sys; from lightdepth import native; native.pycolmap(); names = list(sys.modules);"
        "assert names.index('cv2') < names.index('pycolmap')"
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

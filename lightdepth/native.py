"""Libraries that need a hand before they can be imported: the one place for such tricks."""

from __future__ import annotations

import atexit
import ctypes
import os
import shutil
import signal
import stat
import tempfile
import threading
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from lightdepth.errors import InputError

SYSTEM_LIBRARIES = {  # what Open3D links against: file wanted by the loader -> Debian package
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}


def missing_system_libraries() -> list[str]:
    """Debian packages of the shared libraries that Open3D needs and the loader does not find."""
    missing = []
    for library, package in SYSTEM_LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    return missing


@cache
def open3d() -> ModuleType:
    """The open3d module. libusb-1.0, which Open3D 0.20 links against and slim systems lack, comes from its pip package.

    Raises InputError with the system packages to install when Open3D cannot be loaded.
    """
    try:
        import libusb_package

        path = libusb_package.get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # a system libusb may do; if not, the import below says what is missing
    # In a notebook it would start a window system for browsers, which nothing here draws with, and say so.
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    try:
        import open3d
    except (ImportError, OSError) as error:
        packages = " ".join(["libusb-1.0-0", *SYSTEM_LIBRARIES.values()])
        raise InputError(
            "Open3D", f"it cannot be loaded ({error})", f"on Debian or Ubuntu: apt-get install {packages}"
        ) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


@cache
def pycolmap() -> ModuleType:
    """The pycolmap module. cv2 comes first: two copies of zlib otherwise abort the process at the first PNG written.

    It takes SIGTERM for a crash: a trace of the stack, and the end. Who had it before gets it back."""
    import cv2  # noqa: F401
    import pycolmap

    before = signal.getsignal(signal.SIGTERM)  # as Python knows it, which was not asked
    if before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    pycolmap.logging.minloglevel = 2
    return pycolmap


def open_to_others(folder: Path) -> bool:
    """Whether somebody else could put something into a folder, or owns it."""
    if os.name == "nt" or not folder.exists():
        return False
    found = folder.stat()
    return found.st_uid not in (os.getuid(), 0) or bool(found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def user_cache() -> Path | None:
    """Where what is made once for a user is kept; None for a user without a home."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(home) / "lightdepth"


def _kept_in() -> Path:
    """The folder for what Warp compiles and then runs: the user's own, where nobody else may write to it; else one that
    goes with the process."""
    home = user_cache()
    with suppress(OSError):
        if home is not None:
            folder = home / "warp"
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if os.access(folder, os.W_OK) and not open_to_others(folder):
                return folder
    passing = tempfile.mkdtemp(prefix="lightdepth-warp-")
    atexit.register(shutil.rmtree, passing, ignore_errors=True)
    return Path(passing)


def has_warp() -> bool:
    """Whether NVIDIA Warp is installed (extra [gpu])."""
    return find_spec("warp") is not None


@cache
def warp() -> ModuleType:
    """The warp module, quiet. Raises InputError where it is not installed."""
    try:
        import warp
    except ImportError as error:
        raise InputError(
            "NVIDIA Warp, which casts rays and fuses surfaces on a GPU",
            f"it cannot be loaded ({error})",
            "install it: pip install 'lightdepth[gpu]'; or stay on the CPU (--device cpu)",
        ) from error
    if "WARP_CACHE_PATH" not in os.environ:
        warp.config.kernel_cache_dir = str(_kept_in())
    warp.config.log_level = warp.LOG_ERROR  # or it greets, and warns where there is no GPU
    warp.init()  # type: ignore[no-untyped-call]  # Warp has no annotation for it
    return warp

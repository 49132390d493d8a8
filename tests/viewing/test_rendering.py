"""A machine that can't render says so, in place of VTK's segmentation fault."""

import os
import subprocess
import sys

import pytest

from iga_drake.viewing import rendering
from iga_drake.viewing.rendering import RenderingError, check_egl


def test_here_egl_can_be_used():
    check_egl()


def test_no_vendor_of_egl_is_refused_before_anything_renders(tmp_path):
    environment = {**os.environ, "__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path)}
    code = "from iga_drake.viewing.rendering import headless_renderer; headless_renderer()"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 1  # an exception, no signal
    assert "RenderingError: cameras can't render" in done.stderr
    assert "finds no device" in done.stderr and "libgl1-mesa-dri" in done.stderr


def test_no_library_of_egl_is_refused(monkeypatch):
    monkeypatch.setattr(rendering.ctypes.util, "find_library", lambda _: "libEGL-missing.so.1")
    with pytest.raises(RenderingError, match=r"libEGL-missing\.so\.1 is missing"):
        check_egl()

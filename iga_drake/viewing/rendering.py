"""Drake's VTK renderer without a display: through EGL, which is looked for before it is used."""

import ctypes
import ctypes.util
from typing import Any

from pydrake.geometry import MakeRenderEngineVtk, RenderEngine, RenderEngineVtkParams

from iga_drake.errors import IgaDrakeError

_INSTALL = (
    "install EGL and a driver for it (Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri; "
    "with an NVIDIA card its driver's libnvidia-gl), or mend __EGL_VENDOR_LIBRARY_DIRS"
)


class RenderingError(IgaDrakeError):
    """This machine can't render without a display."""


def headless_renderer(**parameters: Any) -> RenderEngine:
    """Drake's VTK render engine with `parameters` of `RenderEngineVtkParams`, on EGL.

    Raises `RenderingError` where EGL has neither a device nor a display.
    """
    check_egl()
    return MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL", **parameters))


def check_egl() -> None:
    """Raises `RenderingError` where EGL is missing or drives nothing, which VTK would answer with a
    segmentation fault."""
    name = ctypes.util.find_library("EGL") or "libEGL.so.1"
    try:
        egl = ctypes.CDLL(name)
    except OSError as error:
        raise RenderingError(f"cameras can't render: {name} is missing: {_INSTALL}") from error
    if not (_devices(egl) or _has_display(egl)):
        raise RenderingError(f"cameras can't render: {name} finds no device: {_INSTALL}")


def _devices(egl: ctypes.CDLL) -> int:
    """The number of devices that EGL's extension for them counts; 0 without the extension."""
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    if not address:
        return 0
    query = ctypes.CFUNCTYPE(
        ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int)
    )(address)
    count = ctypes.c_int(0)
    return count.value if query(0, None, ctypes.byref(count)) else 0


def _has_display(egl: ctypes.CDLL) -> bool:
    """Whether EGL's default display can be used."""
    egl.eglGetDisplay.restype = ctypes.c_void_p
    egl.eglGetDisplay.argtypes = [ctypes.c_void_p]
    egl.eglInitialize.argtypes = [ctypes.c_void_p] * 3
    display = egl.eglGetDisplay(None)
    return bool(display) and bool(egl.eglInitialize(display, None, None))

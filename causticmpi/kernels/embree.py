"""Embree: its C library builds the tree, and its entry points are called from inside compiled kernels.

The library is the one that the `embreex` wheel ships. Entry points are declared by name, so that kernels that call them
can be cached on disk (a function pointer could not). One thread and one device a process: ranks are the parallelism.
"""

import contextlib
import ctypes
import functools
import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import binding as llvm
from numba import types

from causticmpi.kernels.jit import inline
from causticmpi.kernels.vec import INFINITY, ONE, ZERO

_TYPE_TRIANGLE, _TYPE_SPHERE = 0, 50
_BUFFER_INDEX, _BUFFER_VERTEX = 0, 1
_FORMAT_UINT3, _FORMAT_FLOAT3, _FORMAT_FLOAT4 = 0x5003, 0x9003, 0x9004
_QUALITY_HIGH, _SCENE_ROBUST = 2, 1 << 2
_PROPERTY_VERSION, _PROPERTY_NATIVE_16 = 0, 34
_FLAG_COHERENT = 1 << 16
MISS = np.uint32(0xFFFFFFFF)
TRIANGLES, SPHERES = 0, 1
"""Geometry ids inside an Embree scene."""


def _library_path() -> Path:
    spec = find_spec("embreex")
    if spec is None or spec.origin is None:
        raise ImportError("embreex is not installed: pip install embreex")
    found = sorted((Path(spec.origin).parents[1] / "embreex.libs").glob("libembree4*.so*"))
    if not found:
        raise ImportError("the embreex package holds no Embree 4 library: pip install --force-reinstall embreex")
    return found[0]


_PATH = str(_library_path())
LIBRARY = ctypes.CDLL(_PATH)
llvm.load_library_permanently(_PATH)
for _name, _result, _arguments in (
    ("rtcNewDevice", ctypes.c_void_p, [ctypes.c_char_p]),
    ("rtcGetDeviceError", ctypes.c_int, [ctypes.c_void_p]),
    ("rtcGetDeviceProperty", ctypes.c_ssize_t, [ctypes.c_void_p, ctypes.c_int]),
    ("rtcNewScene", ctypes.c_void_p, [ctypes.c_void_p]),
    ("rtcSetSceneBuildQuality", None, [ctypes.c_void_p, ctypes.c_int]),
    ("rtcSetSceneFlags", None, [ctypes.c_void_p, ctypes.c_int]),
    ("rtcNewGeometry", ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_int]),
    (
        "rtcSetSharedGeometryBuffer",
        None,
        [ctypes.c_void_p, ctypes.c_int, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]
        + [ctypes.c_size_t, ctypes.c_size_t, ctypes.c_size_t],
    ),
    ("rtcSetGeometryBuildQuality", None, [ctypes.c_void_p, ctypes.c_int]),
    ("rtcCommitGeometry", None, [ctypes.c_void_p]),
    ("rtcAttachGeometryByID", None, [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint]),
    ("rtcReleaseGeometry", None, [ctypes.c_void_p]),
    ("rtcCommitScene", None, [ctypes.c_void_p]),
    ("rtcReleaseScene", None, [ctypes.c_void_p]),
):
    getattr(LIBRARY, _name).restype = _result
    getattr(LIBRARY, _name).argtypes = _arguments

_MEMORY_MONITOR = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_bool)
LIBRARY.rtcSetDeviceMemoryMonitorFunction.argtypes = [ctypes.c_void_p, _MEMORY_MONITOR, ctypes.c_void_p]
LIBRARY.rtcSetDeviceMemoryMonitorFunction.restype = None

rtc_intersect1: Any = types.ExternalFunction("rtcIntersect1", types.void(types.intp, types.intp, types.intp))
rtc_occluded1: Any = types.ExternalFunction("rtcOccluded1", types.void(types.intp, types.intp, types.intp))
rtc_intersect16: Any = types.ExternalFunction(
    "rtcIntersect16", types.void(types.intp, types.intp, types.intp, types.intp)
)
rtc_occluded16: Any = types.ExternalFunction(
    "rtcOccluded16", types.void(types.intp, types.intp, types.intp, types.intp)
)


class _Device:
    """The one Embree device of this process. `bytes`: memory its scenes hold now."""

    def __init__(self) -> None:
        self.bytes = 0

        def monitor(_: object, amount: int, __: bool) -> bool:
            self.bytes += amount
            return True

        self._monitor = _MEMORY_MONITOR(monitor)  # kept alive: Embree calls it
        with one_core():
            self.handle = LIBRARY.rtcNewDevice(b"threads=1,set_affinity=0")
        if not self.handle:
            raise RuntimeError(f"Embree gave no device (error {LIBRARY.rtcGetDeviceError(None)})")
        LIBRARY.rtcSetDeviceMemoryMonitorFunction(self.handle, self._monitor, None)
        self.native16 = bool(LIBRARY.rtcGetDeviceProperty(self.handle, _PROPERTY_NATIVE_16))
        version = LIBRARY.rtcGetDeviceProperty(self.handle, _PROPERTY_VERSION)
        self.version = f"{version // 10000}.{version // 100 % 100}.{version % 100}"


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Let the process see a single core for a while.

    Embree's task scheduler (TBB) otherwise starts a worker thread in spite of threads=1, and after a second device that
    worker spins for ever, taking a whole core from the ranks (embree 4.4.0, tests/test_embree.py).
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


@functools.cache
def device() -> _Device:
    """The device, made on first use."""
    return _Device()


class EmbreeScene:
    """An Embree scene over shared vertex, index and sphere buffers, which must outlive it.

    vertices (V, 3) float32, triangles (T, 3) int32, spheres (S, 4) float32, all C-contiguous. Embree reads up to 16
    bytes past the last vertex: arrays are copied here if their owner did not pad them (`padded=False`).
    watertight: no ray slips between the triangles of a closed mesh. Without it some 4 in 10^7 do, and tracing is 30 %
    faster (measured; other renderers choose so too).
    handle: address for the kernels; bytes: memory Embree holds for its trees (private to the process).
    """

    def __init__(
        self,
        vertices: np.ndarray,
        triangles: np.ndarray,
        spheres: np.ndarray,
        padded: bool = False,
        watertight: bool = False,
    ) -> None:
        before = device().bytes
        self._device = device().handle
        self.native16, self.version = device().native16, device().version
        scene = self._scene = LIBRARY.rtcNewScene(self._device)
        LIBRARY.rtcSetSceneBuildQuality(scene, _QUALITY_HIGH)
        if watertight:
            LIBRARY.rtcSetSceneFlags(scene, _SCENE_ROBUST)
        self._buffers = [a if padded else _padded(a) for a in (vertices, triangles, spheres)]
        shared_vertices, shared_triangles, shared_spheres = self._buffers
        if len(triangles):
            geometry = LIBRARY.rtcNewGeometry(self._device, _TYPE_TRIANGLE)
            self._share(geometry, _BUFFER_VERTEX, _FORMAT_FLOAT3, shared_vertices, 12)
            self._share(geometry, _BUFFER_INDEX, _FORMAT_UINT3, shared_triangles, 12)
            self._attach(geometry, TRIANGLES)
        if len(spheres):
            geometry = LIBRARY.rtcNewGeometry(self._device, _TYPE_SPHERE)
            self._share(geometry, _BUFFER_VERTEX, _FORMAT_FLOAT4, shared_spheres, 16)
            self._attach(geometry, SPHERES)
        with one_core():
            LIBRARY.rtcCommitScene(scene)
        error = LIBRARY.rtcGetDeviceError(self._device)
        if error:
            raise RuntimeError(f"Embree could not build the scene (error {error})")
        self.handle = int(scene)
        self.bytes = device().bytes - before

    @staticmethod
    def _share(geometry: int, kind: int, layout: int, array: np.ndarray, stride: int) -> None:
        LIBRARY.rtcSetSharedGeometryBuffer(geometry, kind, 0, layout, array.ctypes.data, 0, stride, len(array))

    def _attach(self, geometry: int, identifier: int) -> None:
        LIBRARY.rtcSetGeometryBuildQuality(geometry, _QUALITY_HIGH)
        LIBRARY.rtcCommitGeometry(geometry)
        LIBRARY.rtcAttachGeometryByID(self._scene, geometry, identifier)
        LIBRARY.rtcReleaseGeometry(geometry)

    def close(self) -> None:
        """Release the scene; kernels must not use `handle` any more."""
        if self._scene:
            LIBRARY.rtcReleaseScene(self._scene)
            self._scene = None


def _padded(array: np.ndarray) -> np.ndarray:
    """A copy of a C-contiguous array followed by 64 readable bytes."""
    array = np.ascontiguousarray(array)
    raw = np.zeros(array.nbytes + 64, np.uint8)
    raw[: array.nbytes] = array.reshape(-1).view(np.uint8)
    return raw[: array.nbytes].view(array.dtype).reshape(array.shape)


def aligned_words(words: int) -> np.ndarray:
    """So many float32, all 0, from the beginning of a cache line on."""
    raw = np.zeros(words * 4 + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + words * 4].view(np.float32)


def ray_buffer(extra: int = 0) -> np.ndarray:
    """Aligned workspace for one RTCRayHit (float32 words 0 … 31), a valid mask (32 … 47), RTCIntersectArguments (48 …
    63), one RTCRayHit16 (64 … 447) and `extra` words of the caller's own."""
    buffer = aligned_words(RAY16 + 16 * 24 + extra)
    integers = buffer.view(np.uint32)
    integers[9] = MISS  # mask of the single ray: hit everything
    integers[VALID : VALID + LANES] = MISS  # all lanes valid: lanes out of use get a negative reach instead
    integers[COHERENT : COHERENT + 2] = _FLAG_COHERENT, MISS  # all features; no context, no callbacks
    integers[RAY16 + 9 * 16 : RAY16 + 10 * 16] = MISS
    return buffer


LANES = 16
VALID, COHERENT, RAY16 = 32, 48, 64
"""First words of the valid mask, of the arguments for coherent rays and of the 16-wide ray in `ray_buffer`."""
TNEAR, DIR, TFAR, PRIM, GEOM = 3, 4, 8, 17, 18
"""Word offsets of RTCRayHit; in the 16-wide ray word w of lane i lies at RAY16 + 16 w + i."""


@inline
def intersect(handle, triangle_count, rays, origin, direction, tfar):
    """Nearest hit of one ray in (0, tfar): (primitive, t); primitive is -1 for a miss.

    rays: `ray_buffer()`; t in multiples of the direction's length.
    """
    words = rays.view(np.uint32)
    rays[0], rays[1], rays[2], rays[3] = origin[0], origin[1], origin[2], ZERO
    rays[4], rays[5], rays[6], rays[7] = direction[0], direction[1], direction[2], ZERO
    rays[TFAR] = tfar
    words[GEOM] = MISS
    rtc_intersect1(handle, rays.ctypes.data, 0)
    geometry = words[GEOM]
    if geometry == MISS:
        return np.int64(-1), tfar
    return np.int64(words[PRIM]) + np.int64(geometry) * triangle_count, rays[TFAR]


@inline
def intersect_packet(handle, rays):
    """Nearest hits of the 16 rays in `rays`; a lane whose far end lies before 0 is out of use. Read them by
    `lane_hit`."""
    words = rays.view(np.uint32)
    for i in range(LANES):
        words[RAY16 + 16 * GEOM + i] = MISS
    rtc_intersect16(rays.ctypes.data + 4 * VALID, handle, rays.ctypes.data + 4 * RAY16, 0)


COARSE = 1 << 17
"""Up to so many triangles, the rays through 16 neighbouring pixels mostly meet the same ones."""


@inline
def intersect_neighbours(handle, triangle_count, rays):
    """`intersect_packet`, to the same bits, for the rays of a tile of pixels.

    In a coarse scene the packet goes through the tree as one: 1.3 (a box of two spheres) to 3 times as fast (meshes of
    12,000 and 33,000 triangles). In a fine one its rays part at once: half as fast (700,000 triangles; all measured).
    """
    words = rays.view(np.uint32)
    for i in range(LANES):
        words[RAY16 + 16 * GEOM + i] = MISS
    arguments = rays.ctypes.data + 4 * COHERENT if triangle_count <= COARSE else 0
    rtc_intersect16(rays.ctypes.data + 4 * VALID, handle, rays.ctypes.data + 4 * RAY16, arguments)


@inline
def lane_hit(triangle_count, rays, lane):
    """What lane `lane` hit: (primitive, t), primitive -1 for a miss."""
    words = rays.view(np.uint32)
    geometry = words[RAY16 + 16 * GEOM + lane]
    if geometry == MISS:
        return np.int64(-1), INFINITY
    primitive = np.int64(words[RAY16 + 16 * PRIM + lane]) + np.int64(geometry) * triangle_count
    return primitive, rays[RAY16 + 16 * TFAR + lane]


@inline
def lane_origin(rays, lane):
    """Origin of a lane of the packet."""
    return rays[RAY16 + lane], rays[RAY16 + 16 + lane], rays[RAY16 + 32 + lane]


@inline
def lane_direction(rays, lane):
    """Direction of a lane of the packet."""
    first = RAY16 + 16 * DIR + lane
    return rays[first], rays[first + 16], rays[first + 32]


@inline
def visible(handle, rays, origin, target):
    """Whether nothing lies between two points, both already moved off their surfaces."""
    rays[0], rays[1], rays[2], rays[3] = origin[0], origin[1], origin[2], ZERO
    rays[4] = target[0] - origin[0]
    rays[5] = target[1] - origin[1]
    rays[6] = target[2] - origin[2]
    rays[7] = ZERO
    rays[TFAR] = ONE
    rtc_occluded1(handle, rays.ctypes.data, 0)
    return rays[TFAR] >= ZERO

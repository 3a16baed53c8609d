"""Record the rays that kernels really send to Embree, in order.

Run as a process of its own, before any kernel is loaded: `python -m causticmpi.bench.record CONFIG OUT.npz`. LLVM is
told that the entry points of Embree live at our recorders, which note each query and pass it on; so kernels need no
hooks.
"""

import ctypes
import sys
from typing import Any

import numba
import numpy as np
from llvmlite import binding as llvm
from numba import types

from causticmpi.kernels import embree
from causticmpi.kernels.embree import LANES, LIBRARY

SINGLE_WORDS, PACKET_WORDS = 24, 12 * LANES
"""float32 words kept per query: an RTCRayHit (the last word tells occlusion queries), an RTCRay16."""
MOST_SINGLE, MOST_PACKETS, MOST_EYE_PACKETS = 4_000_000, 150_000, 40_000
MOST_PHOTONS = 200_000
"""Caustic points whose rays are recorded."""


def _as_pointer(typingctx: Any, address: Any) -> Any:
    """An address as a pointer to float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.CPointer(types.float32)))

    return types.CPointer(types.float32)(types.intp), generate


_pointer: Any = numba.extending.intrinsic(_as_pointer)


def _symbol(name: str, arguments: int) -> Any:
    function = getattr(LIBRARY, name)
    function.argtypes = [ctypes.c_ssize_t] * arguments
    function.restype = None
    return function


class Recorder:
    """Keeps the first queries of each kind; `counts` is how many of them there are."""

    def __init__(self) -> None:
        self.single = np.zeros((MOST_SINGLE, SINGLE_WORDS), np.float32)
        self.packets = np.zeros((MOST_PACKETS, PACKET_WORDS), np.float32)
        self.eye_packets = np.zeros((MOST_EYE_PACKETS, PACKET_WORDS), np.float32)
        self.counts = np.zeros(3, np.int64)
        self._callbacks = [
            self._replace("rtcIntersect1", 0.0),
            self._replace("rtcOccluded1", 1.0),
            self._replace16("rtcOccluded16", self.packets, 1),
            self._replace16("rtcIntersect16", self.eye_packets, 2),
        ]

    def _replace(self, name: str, kind: float) -> Any:
        real = _symbol(name, 3)
        log, most = self.single.ctypes.data, MOST_SINGLE
        counter = self.counts.ctypes.data

        @numba.cfunc(types.void(types.intp, types.intp, types.intp))
        def record(scene, ray, arguments):
            count = numba.carray(_pointer(counter), (6,)).view(np.int64)
            if count[0] < most:
                row = numba.carray(_pointer(log + count[0] * 4 * SINGLE_WORDS), (SINGLE_WORDS,))
                source = numba.carray(_pointer(ray), (12,))
                for i in range(12):
                    row[i] = source[i]
                row[SINGLE_WORDS - 1] = kind
                count[0] += 1
            real(scene, ray, arguments)

        llvm.add_symbol(name, record.address)
        return record

    def _replace16(self, name: str, rows: np.ndarray, slot: int) -> Any:
        real = _symbol(name, 4)
        log, most = rows.ctypes.data, len(rows)
        counter = self.counts.ctypes.data

        @numba.cfunc(types.void(types.intp, types.intp, types.intp, types.intp))
        def record(valid, scene, ray, arguments):
            count = numba.carray(_pointer(counter), (6,)).view(np.int64)
            if count[slot] < most:
                row = numba.carray(_pointer(log + count[slot] * 4 * PACKET_WORDS), (PACKET_WORDS,))
                source = numba.carray(_pointer(ray), (PACKET_WORDS,))
                for i in range(PACKET_WORDS):
                    row[i] = source[i]
                count[slot] += 1
            real(valid, scene, ray, arguments)

        llvm.add_symbol(name, record.address)
        return record


def main(config_file: str, out: str) -> None:
    """Record one pass of `pt` and the first part of a pass of `iws` into `out`: arrays `single`, `eye_packets` (nearest
    hit), `packets` (shadow) and `photons`."""
    recorder = Recorder()
    from causticmpi.bench.subjects import Subject

    subject = Subject(config_file)
    subject.path_tracing()
    single, eye = recorder.single[: recorder.counts[0]].copy(), recorder.eye_packets[: recorder.counts[2]].copy()
    subject.gather(subject.pixels[: len(subject.pixels) // 2 // 16 * 16])
    recorder.counts[0] = 0
    subject.photons(MOST_PHOTONS)
    photons = recorder.single[: recorder.counts[0]]
    np.savez(out, single=single, eye_packets=eye, packets=recorder.packets[: recorder.counts[1]], photons=photons)


if __name__ == "__main__":
    assert embree.device().native16 is not None
    main(sys.argv[1], sys.argv[2])

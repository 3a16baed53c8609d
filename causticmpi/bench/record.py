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
"""float32 words kept per query: an RTCRayHit, an RTCRay16."""
MOST_SINGLE, MOST_PACKETS = 4_000_000, 200_000
MOST_PHOTONS = 50_000
"""Caustic points whose rays are recorded."""
NEAREST, SHADOW, COHERENT = 0, 1, 2
"""Kinds of query: rtcIntersect, rtcOccluded, and rtcIntersect with arguments, which say that rays are coherent."""
QUERIES = ("packets", "kinds", "single", "single_kinds")
"""Suffixes of all queries of a part of the renderer in the file."""


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
    """Keeps the first queries in packets; `kinds` says of which kind each is, `counts[0]` how many there are; so for
    single rays."""

    def __init__(self) -> None:
        self.packets = np.zeros((MOST_PACKETS, PACKET_WORDS), np.float32)
        self.kinds = np.zeros(MOST_PACKETS, np.int8)
        self.counts = np.zeros(1, np.int64)
        self.single = np.zeros((MOST_SINGLE, SINGLE_WORDS), np.float32)
        self.single_kinds = np.zeros(MOST_SINGLE, np.int8)
        self.single_count = np.zeros(1, np.int64)
        self._callbacks = [
            self._replace_single("rtcIntersect1", NEAREST),
            self._replace_single("rtcOccluded1", SHADOW),
            self._replace("rtcIntersect16", NEAREST),
            self._replace("rtcOccluded16", SHADOW),
        ]

    def _replace_single(self, name: str, kind: int) -> Any:
        real = _symbol(name, 3)
        log, kinds, counter = self.single.ctypes.data, self.single_kinds.ctypes.data, self.single_count.ctypes.data

        @numba.cfunc(types.void(types.intp, types.intp, types.intp))
        def record(scene, ray, arguments):
            count = numba.carray(_pointer(counter), (2,)).view(np.int64)
            if count[0] < MOST_SINGLE:
                row = numba.carray(_pointer(log + count[0] * 4 * SINGLE_WORDS), (SINGLE_WORDS,))
                source = numba.carray(_pointer(ray), (12,))
                for i in range(12):
                    row[i] = source[i]
                numba.carray(_pointer(kinds), (MOST_SINGLE // 4,)).view(np.int8)[count[0]] = kind
                count[0] += 1
            real(scene, ray, arguments)

        llvm.add_symbol(name, record.address)
        return record

    def _replace(self, name: str, kind: int) -> Any:
        real = _symbol(name, 4)
        log, kinds, counter = self.packets.ctypes.data, self.kinds.ctypes.data, self.counts.ctypes.data

        @numba.cfunc(types.void(types.intp, types.intp, types.intp, types.intp))
        def record(valid, scene, ray, arguments):
            count = numba.carray(_pointer(counter), (2,)).view(np.int64)
            if count[0] < MOST_PACKETS:
                row = numba.carray(_pointer(log + count[0] * 4 * PACKET_WORDS), (PACKET_WORDS,))
                source = numba.carray(_pointer(ray), (PACKET_WORDS,))
                for i in range(PACKET_WORDS):
                    row[i] = source[i]
                of_kind = numba.carray(_pointer(kinds), (MOST_PACKETS // 4,)).view(np.int8)
                of_kind[count[0]] = COHERENT if arguments else kind
                count[0] += 1
            real(valid, scene, ray, arguments)

        llvm.add_symbol(name, record.address)
        return record

    def take(self) -> tuple[np.ndarray, np.ndarray]:
        """Packets and kinds recorded since the last call of this or `take_all`."""
        count = int(self.counts[0])
        self.counts[0] = self.single_count[0] = 0
        return self.packets[:count].copy(), self.kinds[:count].copy()

    def take_all(self, name: str) -> dict[str, np.ndarray]:
        """So too, with single rays and their kinds, as `recorded_queries` takes them."""
        count = int(self.single_count[0])
        single, single_kinds = self.single[:count].copy(), self.single_kinds[:count].copy()
        packets, kinds = self.take()
        if count == MOST_SINGLE or len(kinds) == MOST_PACKETS:
            raise RuntimeError(f"more rays of {name} than there is room for")
        found: list[np.ndarray] = [packets, kinds, single, single_kinds]
        return {f"{name}_{part}": array for part, array in zip(QUERIES, found, strict=True)}


def main(config_file: str, out: str) -> None:
    """Record queries of `pt` (`path_packets`, `path_kinds`, in order), the virtual lights' shadow rays (`packets`),
    and all QUERIES of `photons`, `iws`, `iws+cf` and `light` into `out`."""
    recorder = Recorder()
    from causticmpi.bench.subjects import Subject

    subject = Subject(config_file)
    subject.path_tracing()
    path_packets, path_kinds = recorder.take()
    subject.gather()
    packets, kinds = recorder.take()
    subject.photons(MOST_PHOTONS)
    parts = recorder.take_all("photons")
    subject.eye_paths("iws"), subject.eye_paths("iws+cf"), subject.light_paths()  # preprocess and compiling aside
    for name, run in (
        ("iws", lambda: subject.eye_paths("iws")),
        ("iws+cf", lambda: subject.eye_paths("iws+cf")),
        ("light", subject.light_paths),
    ):
        recorder.take()
        run()
        parts |= recorder.take_all(name)
    shadows = packets[kinds == SHADOW]
    parts |= {"path_packets": path_packets, "path_kinds": path_kinds, "packets": shadows}
    np.savez(out, **parts)  # type: ignore[arg-type]


if __name__ == "__main__":
    assert embree.device().native16 is not None
    main(sys.argv[1], sys.argv[2])

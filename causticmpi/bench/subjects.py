"""What is timed: each kernel of the renderer on one scene, and Embree alone on recorded rays."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from causticmpi.bench.preprocess import MILLION, preprocess_of
from causticmpi.bench.record import COHERENT, NEAREST, QUERIES, SHADOW
from causticmpi.config.load import load_config, scene_path
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import prepare_forecast, prepare_method, share_scene
from causticmpi.distributed.world import SerialWorld
from causticmpi.estimators import full_radiance
from causticmpi.kernels import embree
from causticmpi.kernels.embree import (
    GEOM,
    LANES,
    MISS,
    RAY16,
    TFAR,
    VALID,
    ray_buffer,
    rtc_intersect1,
    rtc_intersect16,
    rtc_occluded1,
    rtc_occluded16,
)
from causticmpi.kernels.jit import kernel
from causticmpi.kernels.pixels import pixel_order
from causticmpi.preprocess.photons import CausticPoints, shoot_photons
from causticmpi.render.methods import PathTracing, WeakSingularities
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array


@kernel
def _see_and_gather(scene, camera, work, pixels, pass_index, lights, count, bound):
    """First vertices and their virtual lights, for whole tiles. Returns (rays to see, shadow rays)."""
    seen, shadows = 0, 0
    for first in range(0, pixels.shape[0], LANES):
        used, rays = full_radiance.see_tile(scene, camera, work, pixels, first, 1, pass_index, False, True)
        seen += rays
        if used > 0 and count > 0:
            shadows += full_radiance.gather_lights(scene, work, lights, count, np.float32(bound))
    return seen, shadows


@kernel
def _replay_rows(handle, queries):
    """Embree alone on recorded single rays, in place. Returns hits, so that nothing is optimized away."""
    hits = 0
    words = queries.view(np.uint32)
    for i in range(queries.shape[0]):
        words[i, GEOM] = MISS
        rtc_intersect1(handle, queries.ctypes.data + i * 128, 0)
        hits += words[i, GEOM] != MISS
    return hits


@kernel
def _replay_mixed(handle, queries, kinds):
    """The same, of both kinds."""
    hits = 0
    words = queries.view(np.uint32)
    for i in range(queries.shape[0]):
        words[i, GEOM] = MISS
        if kinds[i] == NEAREST:
            rtc_intersect1(handle, queries.ctypes.data + i * 128, 0)
        else:
            rtc_occluded1(handle, queries.ctypes.data + i * 128, 0)
        hits += words[i, GEOM] != MISS
    return hits


@kernel
def _replay_single(handle, rays, packets, kinds):
    """Embree alone on the nearest-hit rays of recorded packets, one by one. Returns rays."""
    words = rays.view(np.uint32)
    queries = 0
    for i in range(packets.shape[0]):
        if kinds[i] == SHADOW:
            continue
        for lane in range(LANES):
            if packets[i, 16 * TFAR + lane] < 0:
                continue
            for word in range(9):
                rays[word] = packets[i, 16 * word + lane]
            words[GEOM] = MISS
            rtc_intersect1(handle, rays.ctypes.data, 0)
            queries += 1
    return queries


@kernel
def _replay_paths(handle, rays, packets, kinds):
    """Embree alone on recorded packets of both kinds, in order. Returns rays in use."""
    words = rays.view(np.uint32)
    valid, packet = rays.ctypes.data + 4 * VALID, rays.ctypes.data + 4 * RAY16
    coherent = rays.ctypes.data + 4 * embree.COHERENT
    used = 0
    for i in range(packets.shape[0]):
        for word in range(packets.shape[1]):
            rays[RAY16 + word] = packets[i, word]
        for lane in range(LANES):
            used += packets[i, 16 * TFAR + lane] > 0
            words[RAY16 + 16 * GEOM + lane] = MISS
        if kinds[i] != SHADOW:
            rtc_intersect16(valid, handle, packet, coherent if kinds[i] == COHERENT else 0)
        else:
            rtc_occluded16(valid, handle, packet, 0)
    return used


@kernel
def _replay_packets(handle, valid, packets):
    """Embree alone on recorded shadow packets, in place."""
    base = packets.ctypes.data
    for i in range(packets.shape[0]):
        rtc_occluded16(valid.ctypes.data, handle, base + i * 4 * packets.shape[1], 0)


def _aligned(rows: int, words: int) -> np.ndarray:
    raw = np.zeros(rows * words * 4 + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + rows * words * 4].view(np.float32).reshape(rows, words)


def _all_lanes() -> np.ndarray:
    valid = _aligned(1, LANES)[0].view(np.int32)
    valid[:] = -1
    return valid


PART = 16 * 64
"""Rows of `pixels` in one call of the path tracer."""
SPARSE = 16
"""One of so many parts of the picture, and of the light paths, is traced where all queries are kept."""


class Subject:
    """One scene, ready to time. Every method returns (queries, CPU seconds)."""

    def __init__(self, config_file: str | Path) -> None:
        self.config = load_config(config_file)
        self.scene = share_scene(SerialWorld(), load_scene(scene_path(config_file, self.config)))
        width, height = self.config.film.width, self.config.film.height
        self.camera = camera_array(self.scene.data.camera, width, height)
        self.pixels = pixel_order((0, 0, width, height), width)
        self.film = np.zeros((width * height, 6), np.float32)
        self.path_rates: list[float] = []  # million paths per CPU second, of each `path_tracing`
        self.points: CausticPoints | None = None
        self._methods: dict[str, Any] = {}

    def _method(self, name: str) -> Any:
        if name not in self._methods:
            config = msgspec.structs.replace(self.config, method=name)
            self._methods[name], _ = prepare_method(SerialWorld(), config, self.scene, self.camera, Stopwatch())
        return self._methods[name]

    def _parts(self, step: int) -> list[np.ndarray]:
        """One of `step` parts of the picture, spread over it."""
        return [self.pixels[row : row + PART] for row in range(0, len(self.pixels), step * PART)]

    def path_tracing(self) -> tuple[int, float]:
        """One pass of `pt` in every fourth part of the picture."""
        method = self._method("pt")
        assert isinstance(method, PathTracing)
        method.begin_pass(0)
        method.trace(self.pixels[:0], self.film)
        parts = self._parts(4)
        rays, seconds = _timed(lambda: sum(method.trace(part, self.film) for part in parts))
        self.path_rates.append(sum(int((part[:, 0] >= 0).sum()) for part in parts) / seconds / 1e6)
        return rays, seconds

    def picture(self, pass_index: int) -> tuple[np.ndarray, float]:
        """One whole pass of `pt`, L_d + L_c as (pixels, 3) float64, and its CPU seconds."""
        method = self._method("pt")
        method.begin_pass(pass_index)
        film = np.zeros_like(self.film)
        _, seconds = _timed(lambda: method.trace(self.pixels, film))
        return film[:, :3].astype(np.float64) + film[:, 3:], seconds

    def gather(self) -> tuple[int, float]:
        """Virtual lights of one pass at the first vertices of every fourth part of the picture: shadow rays, and the
        time without finding the vertices."""
        method = self._method("iws")
        assert isinstance(method, WeakSingularities)
        method.begin_pass(0)
        pixels = np.concatenate(self._parts(4))
        common = (self.scene.traced, self.camera, method.work)
        _see_and_gather(*common, pixels[:0], 0, method.lights, 0, method.bound)

        def run(count: int) -> tuple[tuple[int, int], float]:
            began = time.process_time()
            result = _see_and_gather(*common, pixels, 0, method.lights, count, method.bound)
            return result, time.process_time() - began

        (_, _), seeing = run(0)
        (_, shadows), both = run(method.light_count)
        return shadows, both - seeing

    def eye_paths(self, name: str) -> tuple[int, float]:
        """One pass of the eye paths of `iws` or `iws+cf` in every SPARSE-th part of the picture."""
        method = self._method(name)
        method.begin_pass(0)
        method.trace(self.pixels[:0], self.film)
        parts = self._parts(SPARSE)
        return _timed(lambda: sum(method.trace(part, self.film) for part in parts))

    def light_paths(self) -> tuple[int, float]:
        """A SPARSE-th of the light paths of a pass."""
        method, film = self._method("iws+cf"), np.zeros((len(self.film), 3), np.float32)
        if not method.light_paths:
            return 0, 0.0
        method.trace_light(0, 0, 0, film)
        return _timed(lambda: method.trace_light(0, 0, method.light_paths // SPARSE, film))

    def parts(self) -> dict[str, float]:
        """CPU seconds of the parts of a pass of `iws+cf`, each by what its kernel takes with and without it."""
        method = self._method("iws")
        method.begin_pass(0)
        common = (self.scene.traced, self.camera, method.work)
        rows = self._parts(SPARSE)

        def see(count: int) -> float:
            run = (0, method.lights, count, method.bound)
            return _timed(lambda: [_see_and_gather(*common, part, *run) for part in rows])[1]

        _see_and_gather(*common, self.pixels[:0], 0, method.lights, 0, method.bound)
        seeing, gathered = see(0), see(method.light_count)
        diffusive, whole = self.eye_paths("iws")[1], self.eye_paths("iws+cf")[1]
        return {
            "seeing": seeing,
            "gather": gathered - seeing,
            "compensation": diffusive - gathered,
            "caustics": whole - diffusive,
            "light": self.light_paths()[1],
        }

    def photons(self, count: int = MILLION) -> tuple[int, float]:
        """Shooting `count` photons: rays. The points are kept for `million`."""
        shoot_photons(self.scene.traced, 1, 1)
        began = time.process_time()
        self.points, _, rays = shoot_photons(self.scene.traced, 1, count)
        return rays, time.process_time() - began

    def million(self) -> dict[str, float]:
        """CPU seconds of making maps of the points that `photons` shot (see bench.preprocess)."""
        assert self.points is not None
        return preprocess_of(self.points, self.config.forecast, 1)

    def preprocess(self) -> dict[str, float]:
        """CPU-bound wall seconds of the whole preprocess by stage."""
        watch = Stopwatch(from_now=True)
        prepare_forecast(SerialWorld(), self.config, self.scene, watch)
        return watch.stages

    def raw_single(self, packets: np.ndarray, kinds: np.ndarray) -> tuple[int, float]:
        """Embree alone, ray by ray, on the path tracer's nearest-hit rays: the incoherent rate."""
        return self._replay(_replay_single, packets, kinds)

    def raw_paths(self, packets: np.ndarray, kinds: np.ndarray) -> tuple[int, float]:
        """Embree alone on the path tracer's own packets, the same queries in the same order."""
        return self._replay(_replay_paths, packets, kinds)

    def _replay(self, kernel: Any, packets: np.ndarray, kinds: np.ndarray) -> tuple[int, float]:
        handle, rays = self.scene.embree.handle, ray_buffer()
        kernel(handle, rays, packets[:0], kinds[:0])
        return _timed(lambda: kernel(handle, rays, packets, kinds))

    def raw_rows(self, packets: np.ndarray) -> tuple[int, float]:
        """Embree alone, ray by ray and in place, on nearest-hit packets: as if they had never been packed."""
        queries = packets.reshape(len(packets), -1, LANES).transpose(0, 2, 1).reshape(-1, packets.shape[1] // LANES)
        queries = queries[queries[:, TFAR] >= 0]
        rays = _aligned(len(queries), 32)
        rays[:, : queries.shape[1]] = queries
        handle = self.scene.embree.handle
        _replay_rows(handle, rays[:0])
        return len(queries), _timed(lambda: _replay_rows(handle, rays))[1]

    def raw_part(self, queries: Mapping[str, np.ndarray]) -> tuple[int, float]:
        """Embree alone on all queries of a part (see bench.record.QUERIES): queries in use, CPU seconds."""
        packets, kinds, single, single_kinds = (queries[part] for part in QUERIES)
        handle = self.scene.embree.handle
        rows = _aligned(len(single), 32)
        rows[:, : single.shape[1]] = single
        _replay_mixed(handle, rows[:0], single_kinds[:0])
        used, seconds = self.raw_paths(packets, kinds)
        return used + len(single), seconds + _timed(lambda: _replay_mixed(handle, rows, single_kinds))[1]

    def raw_packets(self, packets: np.ndarray) -> tuple[int, float]:
        """Embree alone on recorded 16-wide shadow packets (n, 192): rays in use."""
        copy = _aligned(len(packets), packets.shape[1])
        copy[:] = packets
        valid = _all_lanes()
        _replay_packets(self.scene.embree.handle, valid, copy[:0])
        in_use = int((packets.reshape(-1, 12, LANES)[:, TFAR] >= 0).sum())
        return in_use, _timed(lambda: _replay_packets(self.scene.embree.handle, valid, copy))[1]


def _timed(run: Any) -> tuple[int, float]:
    began = time.process_time()
    result = run()
    return result, time.process_time() - began

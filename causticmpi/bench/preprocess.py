"""The preprocess of a million caustic points: ours by stage, and scipy's clustering and tree on the same points."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from causticmpi.config.records import Forecast
from causticmpi.preprocess.forecast import build_forecast
from causticmpi.preprocess.photons import CausticPoints
from causticmpi.preprocess.vector_quantization import features, training_vectors

MILLION = 1_000_000
CLUSTERS = 256
SCIPY_ROUNDS = 10
"""Iterations of kmeans2, its own default."""
STAGES = {
    "ours": "1 M caustic points, 256 clusters: vector quantization, trees and all maps",
    "kmeans": "... the same by k-means",
    "scipy": "... scipy: kmeans2 (same training vectors, 10 rounds), vq, cKDTree",
}
"""What is timed, in CPU seconds."""


def preprocess_of(points: CausticPoints, settings: Forecast, seed: int) -> dict[str, float]:
    """CPU seconds of each of STAGES, one after the other."""

    def ours(clustering: str) -> Any:
        return build_forecast(
            points,
            seed,
            CLUSTERS,
            settings.neighbours,
            settings.table,
            settings.max_rank,
            settings.splitting,
            clustering=clustering,
            sampling=settings.sampling,
        )

    return {
        "ours": _timed(lambda: ours("vq")),
        "kmeans": _timed(lambda: ours("kmeans")),
        "scipy": _timed(lambda: _scipy(points, seed)),
    }


def _scipy(points: CausticPoints, seed: int) -> None:
    from scipy.cluster.vq import kmeans2, vq
    from scipy.spatial import cKDTree

    feature = np.ascontiguousarray(features(points.position, points.normal)[0].T)
    training = feature[training_vectors(len(feature), CLUSTERS, seed)]
    codebook, _ = kmeans2(training, training[:CLUSTERS], iter=SCIPY_ROUNDS, minit="matrix", missing="warn")
    vq(feature, codebook)
    cKDTree(points.position)


def _timed(run: Callable[[], Any]) -> float:
    began = time.process_time()
    run()
    return time.process_time() - began

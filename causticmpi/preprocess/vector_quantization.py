"""Vector quantization of caustic points over position and normal [CF sec. 3.2], by competitive learning.

Frequency-sensitive competitive learning [Ahalt et al. 1990, the paper's reference]: the codeword with the least
(wins x squared distance) moves towards the training vector, so that clusters follow the density of the photons and come
out evenly filled.
"""

import numpy as np

from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.vec import ONE

NORMAL_WEIGHT = 0.25
"""Unit normals enter the 6-D feature space scaled by this fraction of the extent of the caustic points."""
TRAINING = 200
"""Training vectors per codeword: the codebook changes little beyond."""
EPOCHS = 2


def features(position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, float]:
    """(6, n) float32 features and the scale of the normals in scene units.

    Position enters unscaled, so that distances in feature space are scene units.
    """
    extent = float(np.linalg.norm(np.ptp(position, axis=0))) if len(position) else 0.0
    scale = NORMAL_WEIGHT * (extent or 1.0)
    return np.ascontiguousarray(np.concatenate([position, normal * np.float32(scale)], axis=1).T, np.float32), scale


@inline
def _squared_distances(codebook, feature, out):
    """Squared distances of a feature (six float32) to all codewords; codebook (6, m), out (m,)."""
    a, b, c, d, e, f = feature
    for j in range(out.shape[0]):
        s0, s1, s2 = codebook[0, j] - a, codebook[1, j] - b, codebook[2, j] - c
        s3, s4, s5 = codebook[3, j] - d, codebook[4, j] - e, codebook[5, j] - f
        out[j] = s0 * s0 + s1 * s1 + s2 * s2 + s3 * s3 + s4 * s4 + s5 * s5


@inline
def _column(feature, i):
    return feature[0, i], feature[1, i], feature[2, i], feature[3, i], feature[4, i], feature[5, i]


@inline
def _least(values):
    """Index of the least value, none of them below 0; the first of equals.

    In two loops over integers, which become vector code: floats from 0 on have the order of their bits.
    """
    bits = values.view(np.int32)
    least, index = bits[0], np.int32(values.shape[0])
    for j in range(bits.shape[0]):
        least = min(least, bits[j])
    for j in range(bits.shape[0]):
        index = min(index, np.int32(j) if bits[j] == least else np.int32(bits.shape[0]))
    return np.int64(index)


@inline
def nearest_codeword(codebook, feature, distance):
    """Index of the codeword nearest to a feature (six float32); distance (m,): workspace."""
    _squared_distances(codebook, feature, distance)
    return _least(distance)


@kernel
def _compete(codebook, wins, feature, order, distance):
    """One epoch over the columns `order`; codebook and wins change in place."""
    for i in order:
        _squared_distances(codebook, _column(feature, i), distance)
        for j in range(distance.shape[0]):
            distance[j] *= wins[j]
        winner = _least(distance)
        wins[winner] += ONE
        rate = ONE / wins[winner]
        for c in range(6):
            codebook[c, winner] += rate * (feature[c, i] - codebook[c, winner])


@kernel
def assign(codebook, feature, distance, cluster):
    """Nearest codeword of every column; distance (m,) float32 workspace, cluster (n,) int32 result."""
    for i in range(feature.shape[1]):
        cluster[i] = nearest_codeword(codebook, _column(feature, i), distance)


def training_vectors(count: int, clusters: int, seed: int) -> np.ndarray:
    """Columns of at most TRAINING vectors per codeword, of `count`, in random order (k,) int64."""
    generator = np.random.Generator(np.random.Philox(key=seed))
    return generator.permutation(count)[: TRAINING * clusters].astype(np.int64)


def learn_codebook(feature: np.ndarray, clusters: int, seed: int) -> np.ndarray:
    """Codebook (6, m) float32, m <= clusters, of features (6, n); deterministic for a seed."""
    clusters = min(clusters, feature.shape[1])
    training = training_vectors(feature.shape[1], clusters, seed)
    codebook = np.ascontiguousarray(feature[:, training[:clusters]])
    wins = np.ones(clusters, np.float32)
    distance = np.empty(clusters, np.float32)
    for _ in range(EPOCHS):
        _compete(codebook, wins, feature, training, distance)
    return codebook

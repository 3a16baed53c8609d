"""k-means: scipy agrees on assignment, on a step of Lloyd's iteration and on where it ends."""

import numpy as np
from scipy.cluster.vq import kmeans2, vq
from test_forecast import POINTS, assigned, build, squared_distances

from causticmpi.preprocess.k_means import k_means_codebook
from causticmpi.preprocess.vector_quantization import TRAINING, features, learn_codebook, training_vectors

CLUSTERS = 12
FEATURE = features(POINTS.position, POINTS.normal)[0]


def training() -> np.ndarray:
    return FEATURE[:, training_vectors(FEATURE.shape[1], CLUSTERS, 5)].T.astype(np.float64)


def test_scipy_ends_at_the_same_codebook() -> None:
    """From the same first codewords, to a fixed point: every codeword the mean of its own vectors."""
    mine = k_means_codebook(FEATURE, CLUSTERS, 5)
    data = training()
    assert len(data) == TRAINING * CLUSTERS
    theirs, _ = kmeans2(data, data[:CLUSTERS], iter=200, minit="matrix")
    np.testing.assert_allclose(mine.T, theirs, atol=1e-4)
    cluster, _ = vq(data, mine.T.astype(np.float64))
    means = np.array([data[cluster == j].mean(axis=0) for j in range(CLUSTERS)])
    np.testing.assert_allclose(mine.T, means, atol=1e-5)


def test_scipy_assigns_alike() -> None:
    codebook = learn_codebook(FEATURE, 40, 3)
    theirs, distance = vq(FEATURE.T.astype(np.float64), codebook.T.astype(np.float64))
    mine = assigned(codebook, FEATURE)
    assert (mine == theirs).mean() > 0.999
    own = np.sqrt(squared_distances(codebook, FEATURE)[np.arange(len(mine)), mine])
    np.testing.assert_allclose(own, distance, rtol=1e-4, atol=1e-6)


def test_squared_error_is_less_than_that_of_competition() -> None:
    errors = [
        squared_distances(learn(FEATURE, 40, 3), FEATURE).min(axis=1).mean()
        for learn in (k_means_codebook, learn_codebook)
    ]
    assert errors[0] < errors[1]


def test_deterministic_and_small_inputs() -> None:
    a, b = (k_means_codebook(FEATURE, CLUSTERS, 5) for _ in range(2))
    assert np.array_equal(a, b)
    assert k_means_codebook(FEATURE[:, :5].copy(), CLUSTERS, 3).shape == (6, 5)
    same = np.repeat(FEATURE[:, :1], 100, axis=1)
    assert np.isfinite(k_means_codebook(same, 8, 3)).all()


def test_maps_use_it() -> None:
    maps, _, _ = build(clustering="kmeans")
    assert np.array_equal(maps.codebook, k_means_codebook(FEATURE, 40, 3))

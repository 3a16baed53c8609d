"""k-means clustering of caustic points over position and normal, the paper's rival to vector quantization [CF sec.
3.2].

Lloyd's iteration from the first training vectors: each codeword becomes the mean of the vectors nearest to it, until
none changes its cluster. The squared error is less than that of vector quantization.
"""

import numpy as np

from causticmpi.kernels.jit import kernel
from causticmpi.preprocess.vector_quantization import assign, training_vectors

MOST_ROUNDS = 100


@kernel
def _move_to_means(codebook, feature, cluster, sums, members):
    """Codewords (6, m) to the means of their columns; one without any stays. sums (6, m) float64, members (m,)."""
    for j in range(codebook.shape[1]):
        members[j] = 0
        for c in range(6):
            sums[c, j] = 0
    for i in range(feature.shape[1]):
        j = cluster[i]
        members[j] += 1
        for c in range(6):
            sums[c, j] += feature[c, i]
    for j in range(codebook.shape[1]):
        if members[j] > 0:
            for c in range(6):
                codebook[c, j] = sums[c, j] / members[j]


def k_means_codebook(feature: np.ndarray, clusters: int, seed: int) -> np.ndarray:
    """Codebook (6, m) float32, m <= clusters, of features (6, n); deterministic for a seed."""
    clusters = min(clusters, feature.shape[1])
    training = np.ascontiguousarray(feature[:, training_vectors(feature.shape[1], clusters, seed)])
    codebook = np.ascontiguousarray(training[:, :clusters])
    cluster = np.full(training.shape[1], -1, np.int32)
    before = cluster.copy()
    distance, members = np.empty(clusters, np.float32), np.empty(clusters, np.int64)
    sums = np.empty((6, clusters), np.float64)
    for _ in range(MOST_ROUNDS):
        assign(codebook, training, distance, cluster)
        if np.array_equal(cluster, before):
            break
        before[:] = cluster
        _move_to_means(codebook, training, cluster, sums, members)
    return codebook

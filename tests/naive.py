"""Slow plain oracles in float64, written from the definitions and not from the kernels they check."""

import math

import numpy as np

MASK = (1 << 64) - 1
GOLDEN_GAMMA = 0x9E3779B97F4A7C15


def mix(x: int) -> int:
    """SplitMix64's finalizer on Python integers."""
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 & MASK
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB & MASK
    return x ^ (x >> 31)


def subkey(key: int, counter: int) -> int:
    return mix(key ^ mix((counter + GOLDEN_GAMMA) & MASK))


def make_key(seed: int, purpose: int, pass_index: int, item: int) -> int:
    key = mix((seed + GOLDEN_GAMMA) & MASK)
    key = mix(key ^ ((pass_index * 0xBF58476D1CE4E5B9 + purpose) & MASK))
    return mix((key + item * GOLDEN_GAMMA) & MASK)


def uniform2(key: int, dimension: int) -> tuple[float, float]:
    x = mix((key + (dimension + 1) * GOLDEN_GAMMA) & MASK)
    return (x >> 40) / 2**24, (x >> 8 & 0xFFFFFF) / 2**24


def unit(v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) at unit length."""
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def mirrored(w: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Mirror image of w about n."""
    return 2 * (w @ n)[..., None] * n - w


def brdf(
    kd: np.ndarray, ks: np.ndarray, exponent: float | None, n: np.ndarray, wo: np.ndarray, wi: np.ndarray
) -> np.ndarray:
    """f (..., 3) of Lambert (exponent None) or of Lambert plus a Phong lobe."""
    f = np.broadcast_to(np.asarray(kd, np.float64) / math.pi, (*wi.shape[:-1], 3)).copy()
    if exponent is not None:
        c = np.maximum(wi @ mirrored(wo, n), 0)
        lobe = np.where(c > 0, c**exponent, 0) * (exponent + 2) / (2 * math.pi)
        f += lobe[..., None] * np.asarray(ks, np.float64)
    return f


def brdf_pdf(share: float, exponent: float, n: np.ndarray, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Mixture of the Phong lobe (with probability `share`) and the cosine, 1/sr."""
    cosine = np.maximum(wi @ n, 0) / math.pi
    c = np.maximum(wi @ mirrored(wo, n), 0)
    return (1 - share) * cosine + share * np.where(c > 0, c**exponent, 0) * (exponent + 1) / (2 * math.pi)


def fresnel(angle: float, n_incident: float, n_transmitted: float) -> float:
    """Unpolarized reflectance from the angles (Fresnel's sine and tangent laws)."""
    sine = n_incident / n_transmitted * math.sin(angle)
    if sine >= 1:
        return 1.0
    inner = math.asin(sine)
    if angle < 1e-6:
        return ((n_incident - n_transmitted) / (n_incident + n_transmitted)) ** 2
    s = math.sin(angle - inner) / math.sin(angle + inner)
    p = math.tan(angle - inner) / math.tan(angle + inner)
    return (s * s + p * p) / 2


def intersect(
    corners: np.ndarray, spheres: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """t of every ray with every primitive (rays, T + S), inf where it misses, and how deep inside its edges a hit lies.

    Moeller-Trumbore for triangles `corners` (T, 3, 3), the quadratic for spheres (S, 4); the depth of a triangle is its
    least barycentric, that of a sphere the cosine at the hit.
    """
    o, d = (np.asarray(a, np.float64)[:, None, :] for a in (origin, direction))
    a, b, c = (np.asarray(corners, np.float64)[:, i] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.cross(d, c - a)
        inverse = 1 / ((b - a) * p).sum(-1)
        s = o - a
        u = (s * p).sum(-1) * inverse
        q = np.cross(s, b - a)
        v = (d * q).sum(-1) * inverse
        t = ((c - a) * q).sum(-1) * inverse
        depth = np.minimum(np.minimum(u, v), 1 - u - v)
        t = np.where((depth >= 0) & (t > 0), t, np.inf)
        centre, radius = np.asarray(spheres, np.float64)[:, :3], np.asarray(spheres, np.float64)[:, 3]
        m = o - centre
        squared = (d * d).sum(-1)
        half = (m * d).sum(-1)
        root = np.sqrt(half**2 - squared * ((m * m).sum(-1) - radius**2))
        near, far = (-half - root) / squared, (-half + root) / squared
        ball = np.where(near > 0, near, np.where(far > 0, far, np.inf))
        ball = np.where(np.isnan(root), np.inf, ball)
        grazing = np.where(np.isnan(root), -1, root / (np.sqrt(squared) * radius))
    return np.concatenate([t, ball], axis=1), np.concatenate([depth, grazing], axis=1)


def neighbours(points: np.ndarray, p: np.ndarray, radius2: float, most: int) -> np.ndarray:
    """Ascending squared distances of the `most` nearest rows within the radius."""
    d2 = ((np.asarray(points, np.float64) - np.asarray(p, np.float64)) ** 2).sum(axis=1)
    return np.sort(d2[d2 < radius2])[:most]


def energy_ranks(energy: list[float], area: list[float], culled: int) -> list[int]:
    """Rank by rank: take clusters of falling energy density until 1 - 0.5^(n+1) is reached, then go on with n + 1."""
    order = sorted(
        (i for i in range(len(energy)) if energy[i] > 0),
        key=lambda i: (-energy[i] / area[i] if area[i] > 0 else -math.inf, i),
    )
    total = math.fsum(energy)
    rank, held, n = [culled] * len(energy), [], 0
    for i in order:
        while n < 30 and math.fsum(held) >= (1 - 0.5 ** (n + 1)) * total * (1 - 1e-9):
            n += 1
        rank[i] = n
        held.append(energy[i])
    return rank


def bin_of(columns: int, rows: int, local: np.ndarray) -> int:
    """Bin of a direction above the horizon: rows of equal cosine, columns of equal azimuth."""
    column = min(columns - 1, int(math.atan2(local[1], local[0]) % (2 * math.pi) / (2 * math.pi) * columns))
    return min(rows - 1, int(local[2] * rows)) * columns + column


def connection(
    f_p: np.ndarray, f_q: np.ndarray, n: np.ndarray, m: np.ndarray, d: np.ndarray, peak: float, bound: float
) -> np.ndarray:
    """f_p G w f_q, w = min(1, b / (G max(1, pi f_p) peak)), for d from p to q and both BRDFs given."""
    squared = float(d @ d)
    geometry = max(float(n @ d), 0) * max(float(-m @ d), 0) / squared**2
    if geometry <= 0:
        return np.zeros(3)
    sharp = max(1.0, math.pi * float(np.max(f_p))) * peak
    return f_p * f_q * geometry * min(1.0, bound / (geometry * sharp))


def competitive_learning(feature: np.ndarray, training: np.ndarray, clusters: int, epochs: int) -> np.ndarray:
    """Codebook (6, m): the codeword of least (wins x squared distance) moves to the vector by 1 / wins."""
    codebook, wins = feature[:, training[:clusters]].T.astype(np.float64), np.ones(clusters)
    for i in np.tile(training, epochs):
        winner = int(np.argmin(wins * ((codebook - feature[:, i]) ** 2).sum(axis=1)))
        wins[winner] += 1
        codebook[winner] += (feature[:, i] - codebook[winner]) / wins[winner]
    return codebook.T

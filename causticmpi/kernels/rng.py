"""Counter-based random numbers, named by meaning: (seed, purpose, pass, item, vertex, dimension), never by rank.

A key is a 64-bit hash of everything but the dimension; the dimension counts inside the key. The mixer is SplitMix64's
finalizer [Steele, Lea, Flood 2014], whose outputs for consecutive counters pass BigCrush.
"""

import numpy as np

from causticmpi.kernels.jit import inline

CAMERA, PARTICLE, PHOTON, TRAINING, SHIFT, LIGHT_PATH, GUIDE, SIGHT = (np.uint64(i) for i in range(8))
"""Purposes: one for each independent use of randomness."""

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S40, _S8 = (np.uint64(i) for i in (30, 27, 31, 40, 8))
_24 = np.uint64(0xFFFFFF)
_TO_UNIT = np.float32(2.0**-24)


@inline
def mix(x):
    """SplitMix64 finalizer; a bijection of the 64-bit integers."""
    x = (x ^ (x >> _S30)) * _M1
    x = (x ^ (x >> _S27)) * _M2
    return x ^ (x >> _S31)


@inline
def subkey(key, counter):
    """Key of the `counter`-th child of `key`."""
    return mix(key ^ mix(np.uint64(counter) + _GOLDEN))


@inline
def make_key(seed, purpose, pass_index, item):
    """Key of one stream: `item` is a pixel, a particle path or a photon."""
    key = mix(np.uint64(seed) + _GOLDEN)
    key = mix(key ^ (np.uint64(pass_index) * _M1 + purpose))
    return mix(key + np.uint64(item) * _GOLDEN)


@inline
def uniform2(key, dimension):
    """Two float32 in [0, 1), 24 bits each, of one dimension (a pair) of a key."""
    x = mix(key + (np.uint64(dimension) + np.uint64(1)) * _GOLDEN)
    return np.float32(x >> _S40) * _TO_UNIT, np.float32((x >> _S8) & _24) * _TO_UNIT

"""Nearest neighbours: balanced kd-trees in one array, without pointers.

A tree over rows [low, high) has its root at the middle row; the rows before it lie on the lower side of its plane,
those after it on the upper side, and both are trees again. Runs of at most LEAF rows are searched one by one.
"""

import numpy as np

from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.vec import INFINITY, ZERO

LEAF = 12
MAX_DEPTH = 64


@inline
def _select(keys, order, low, high, k):
    """Reorder `order[low:high]` so that the k-th smallest key stands at k, smaller ones before it (quickselect)."""
    right = high - 1
    left = low
    while left < right:
        # Median of three as pivot: sorted input, which meshes produce, stays fast.
        middle = (left + right) >> 1
        a, b, c = keys[order[left]], keys[order[middle]], keys[order[right]]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = left, right
        while i <= j:
            while keys[order[i]] < pivot:
                i += 1
            while keys[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if k <= j:
            right = j
        elif k >= i:
            left = i
        else:
            return


@kernel
def build_trees(points, starts, order, axis, stack):
    """Balanced trees over the runs starts[i] … starts[i+1] of `order`.

    points (3, n) float32; starts (m+1,) int64; order (k,) int32 columns of `points`, permuted in place;
    axis (k,) uint8: splitting axis of each place, the widest of its run; stack (2 * MAX_DEPTH,) int64: workspace.
    """
    for run in range(starts.shape[0] - 1):
        top = 0
        stack[0], stack[1] = starts[run], starts[run + 1]
        while top >= 0:
            low, high = stack[2 * top], stack[2 * top + 1]
            top -= 1
            if high - low <= LEAF:
                continue
            widest, best = 0, np.float32(-1)
            for c in range(3):
                least = greatest = points[c, order[low]]
                for i in range(low + 1, high):
                    x = points[c, order[i]]
                    least = min(least, x)
                    greatest = max(greatest, x)
                if greatest - least > best:
                    widest, best = c, greatest - least
            middle = (low + high) >> 1
            _select(points[widest], order, low, high, middle)
            axis[middle] = widest
            top += 1
            stack[2 * top], stack[2 * top + 1] = low, middle
            top += 1
            stack[2 * top], stack[2 * top + 1] = middle + 1, high


@inline
def _sift_down(distance, row, count):
    """Let the root of a max-heap of `count` entries sink to its place."""
    i = 0
    d, r = distance[0], row[0]
    while True:
        child = 2 * i + 1
        if child >= count:
            break
        if child + 1 < count and distance[child + 1] > distance[child]:
            child += 1
        if distance[child] <= d:
            break
        distance[i], row[i] = distance[child], row[child]
        i = child
    distance[i], row[i] = d, r


@inline
def _sift_up(distance, row, i):
    d, r = distance[i], row[i]
    while i > 0:
        parent = (i - 1) >> 1
        if distance[parent] >= d:
            break
        distance[i], row[i] = distance[parent], row[parent]
        i = parent
    distance[i], row[i] = d, r


@inline
def _offer(x, y, z, i, p, radius2, most, distance, row, found):
    """Keep point i if it is nearer than sqrt(radius2). Returns how many are kept and the squared radius from now on."""
    dx, dy, dz = p[0] - x[i], p[1] - y[i], p[2] - z[i]
    d2 = dx * dx + dy * dy + dz * dz
    if d2 < radius2:
        if found < most:
            distance[found], row[found] = d2, i
            _sift_up(distance, row, found)
            found += 1
        else:
            distance[0], row[0] = d2, i
            _sift_down(distance, row, found)
        if found == most:
            radius2 = distance[0]
    return found, radius2


@inline
def _gap(x, y, z, axis, middle, p):
    """Signed distance of p from the plane at row `middle`; the rows before it lie on the negative side."""
    k = axis[middle]
    if k == 0:
        return p[0] - x[middle]
    if k == 1:
        return p[1] - y[middle]
    return p[2] - z[middle]


@inline
def run_of(x, y, z, axis, low, high, p, most):
    """Walk down the tree over rows [low, high), not empty, to the run of at most `most` >= LEAF rows on whose side of
    every plane p lies. Returns its rows (low, high)."""
    a, b = np.int64(low), np.int64(high)
    while b - a > most:
        middle = (a + b) >> 1
        gap = _gap(x, y, z, axis, middle, p)
        if gap < ZERO:
            b = middle
        else:
            a = middle + 1
    return a, b


@inline
def nearest(x, y, z, axis, low, high, p, radius2, most, distance, row, stack, plane):
    """The `most` nearest points to p within sqrt(radius2) of the tree over rows [low, high).

    x, y, z (k,) float32 in tree order; distance, row (most,): max-heap of squared distances, filled here;
    stack (2 * MAX_DEPTH,) int32, plane (MAX_DEPTH,) float32: workspace. Returns the number found.
    """
    found = 0
    top = 0
    stack[0], stack[1], plane[0] = low, high, ZERO
    while top >= 0:
        a, b = np.int64(stack[2 * top]), np.int64(stack[2 * top + 1])
        far = plane[top]
        top -= 1
        if far >= radius2:
            continue
        while b - a > LEAF:
            middle = (a + b) >> 1
            gap = _gap(x, y, z, axis, middle, p)
            gap2 = gap * gap
            if gap2 < radius2:
                found, radius2 = _offer(x, y, z, middle, p, radius2, most, distance, row, found)
                top += 1
                plane[top] = gap2
                if gap < ZERO:
                    stack[2 * top], stack[2 * top + 1] = middle + 1, b
                else:
                    stack[2 * top], stack[2 * top + 1] = a, middle
            if gap < ZERO:
                b = middle
            else:
                a = middle + 1
        for i in range(a, b):
            found, radius2 = _offer(x, y, z, i, p, radius2, most, distance, row, found)
    return found


@kernel
def box_runs(x, y, z, starts, box, stack):
    """Boxes around the runs of the trees over rows starts[i] … starts[i+1], none empty, for `nearest_in_boxes`.

    x, y, z (k,) float32 in tree order; box (k, 6) float32: least and greatest x, y and z of each run that the search
    comes to, in its middle row, filled here; stack (2 * MAX_DEPTH,) int64: workspace.
    """
    for tree in range(starts.shape[0] - 1):
        top = 0
        stack[0], stack[1] = starts[tree], starts[tree + 1]
        while top >= 0:
            low, high = stack[2 * top], stack[2 * top + 1]
            top -= 1
            middle = (low + high) >> 1
            for c, of in enumerate((x, y, z)):
                least = greatest = of[middle]
                for i in range(low, high):
                    least = min(least, of[i])
                    greatest = max(greatest, of[i])
                box[middle, 2 * c], box[middle, 2 * c + 1] = least, greatest
            if high - low > LEAF:
                stack[2 * top + 2], stack[2 * top + 3] = low, middle
                stack[2 * top + 4], stack[2 * top + 5] = middle + 1, high
                top += 2


@inline
def _box_gap2(box, low, high, p):
    """Squared distance of p from the box around rows [low, high)."""
    i = (low + high) >> 1
    x = max(box[i, 0] - p[0], p[0] - box[i, 1], ZERO)
    y = max(box[i, 2] - p[1], p[1] - box[i, 3], ZERO)
    z = max(box[i, 4] - p[2], p[2] - box[i, 5], ZERO)
    return x * x + y * y + z * z


@inline
def nearest_in_boxes(x, y, z, box, low, high, p, most, distance, row, stack, gap):
    """The `most` nearest points to p of the tree over rows [low, high), however far; found as in `nearest`.

    Seen from outside a dense patch its rim is hardly farther than the nearest point, and planes part little of it from
    p: boxes around the runs do.
    """
    found, radius2 = 0, INFINITY
    top = 0
    stack[0], stack[1], gap[0] = low, high, ZERO
    while top >= 0:
        a, b = np.int64(stack[2 * top]), np.int64(stack[2 * top + 1])
        near2 = gap[top]
        top -= 1
        while b - a > LEAF and near2 < radius2:
            middle = (a + b) >> 1
            found, radius2 = _offer(x, y, z, middle, p, radius2, most, distance, row, found)
            below2, above2 = _box_gap2(box, a, middle, p), _box_gap2(box, middle + 1, b, p)
            top += 1
            if below2 < above2:
                stack[2 * top], stack[2 * top + 1], gap[top] = middle + 1, b, above2
                b, near2 = middle, below2
            else:
                stack[2 * top], stack[2 * top + 1], gap[top] = a, middle, below2
                a, near2 = middle + 1, above2
        if near2 < radius2:
            for i in range(a, b):
                found, radius2 = _offer(x, y, z, i, p, radius2, most, distance, row, found)
    return found

"""Distance from tapered capsules, the kernel of figurines: most of the time that making their meshes takes."""

import math

from causticmpi.kernels.jit import exact_kernel


@exact_kernel
def lessen_to_capsules(rows, x, y, z, nearest):
    """Lessen `nearest` (N,) to the distance of each point from the nearest capsule, negative within.

    rows (n, 9): start, axis, radius at the start, its growth along the axis, squared length of the axis.
    """
    for s in range(rows.shape[0]):
        row = rows[s]
        ax, ay, az, bx, by, bz = row[0], row[1], row[2], row[3], row[4], row[5]
        radius, growth, squared = row[6], row[7], row[8]
        for i in range(x.shape[0]):
            px, py, pz = x[i] - ax, y[i] - ay, z[i] - az
            along = min(max((px * bx + py * by + pz * bz) / squared, 0.0), 1.0)
            px, py, pz = px - along * bx, py - along * by, pz - along * bz
            distance = math.sqrt(px * px + py * py + pz * pz) - (radius + along * growth)
            nearest[i] = min(nearest[i], distance)

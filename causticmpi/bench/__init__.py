"""This machine's rates: Embree alone on recorded rays, and beside it what the kernels make of it."""

"""Kinds of material. `kind >= MIRROR` is specular (S, a Dirac lobe); the others are non-specular (D)."""

DIFFUSE, PHONG, MIRROR, DIELECTRIC = 0, 1, 2, 3

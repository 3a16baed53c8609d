"""Kinds of material. `kind >= MIRROR` is specular (S, a Dirac lobe); the others are non-specular (D)."""

DIFFUSE, PHONG, MIRROR, DIELECTRIC = 0, 1, 2, 3
LIGHT_BIT = 8
"""Added to the kind of a surface that is a light (`TracedScene.primitive_kind`)."""

"""What a scene file may say, as frozen records: one per kind of material and shape, chosen by `type`.

A spectrum is one number or three, linear Rec.709; its range is checked where it becomes an array, because msgspec 0.22
reads the limits of a union of a number and a tuple from the wrong place.
"""

from typing import Annotated, Any

from msgspec import Meta

from causticmpi.config.records import Camera, Record, Vector

Spectrum = float | Vector
Ior = Annotated[float, Meta(gt=1, le=10, description="normals point out of the denser side")]
Exponent = Annotated[float, Meta(ge=0)]


class Diffuse(Record, frozen=True, kw_only=True, tag_field="type", tag="diffuse"):
    """Lambertian reflection; albedo in [0, 1]."""

    reflectance: Spectrum


class Mirror(Record, frozen=True, kw_only=True, tag_field="type", tag="mirror"):
    """Perfect mirror; reflectance in [0, 1]."""

    reflectance: Spectrum


class Dielectric(Record, frozen=True, kw_only=True, tag_field="type", tag="dielectric"):
    """Smooth interface; `ior` = n behind the surface / n in front of it, front being where the normal points."""

    ior: Ior


class Phong(Record, frozen=True, kw_only=True, tag_field="type", tag="phong"):
    """Diffuse albedo plus the albedo of a Phong lobe; their sum is at most 1 per channel."""

    diffuse: Spectrum
    specular: Spectrum
    exponent: Exponent


class Shape(Record, frozen=True, kw_only=True):
    """What every shape has: the name of its material, and the radiance its front side emits (none by default)."""

    material: str
    emission: Spectrum = 0.0


class Quad(Shape, frozen=True, kw_only=True, tag_field="type", tag="quad"):
    """Flat convex quadrilateral; front by the right-hand rule of its corners."""

    corners: tuple[Vector, Vector, Vector, Vector]


class Sphere(Shape, frozen=True, kw_only=True, tag_field="type", tag="sphere"):
    """Analytic sphere; its front is the outside."""

    center: Vector
    radius: float


class Box(Shape, frozen=True, kw_only=True, tag_field="type", tag="box"):
    """Axis-aligned box with outward normals."""

    min: Vector
    max: Vector


class Mesh(Shape, frozen=True, kw_only=True, tag_field="type", tag="mesh"):
    """Triangle mesh: a PLY or OBJ `file`, relative to the scene file, or one that the program is to `generate`.

    Scaled first, then turned by `rotate` degrees about the fixed x axis, then y, then z, then moved by `translate`.
    """

    file: str | None = None
    generate: str | None = None
    smooth: bool = False
    scale: Spectrum = 1.0
    rotate: Vector = (0.0, 0.0, 0.0)
    translate: Vector = (0.0, 0.0, 0.0)


class SceneFile(Record, frozen=True, kw_only=True):
    """Top level of a scene file; materials and shapes are converted one by one, each with its own place."""

    camera: Camera
    materials: dict[str, Any]
    shapes: list[Any]


Material = Diffuse | Mirror | Dielectric | Phong
MATERIALS: dict[str, type[Material]] = {
    "diffuse": Diffuse,
    "mirror": Mirror,
    "dielectric": Dielectric,
    "phong": Phong,
}
SHAPES: dict[str, type[Quad] | type[Sphere] | type[Box] | type[Mesh]] = {
    "quad": Quad,
    "sphere": Sphere,
    "box": Box,
    "mesh": Mesh,
}

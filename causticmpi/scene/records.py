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
    """Lambertian reflection.

    reflectance: albedo, 0 to 1.
    """

    reflectance: Spectrum


class Mirror(Record, frozen=True, kw_only=True, tag_field="type", tag="mirror"):
    """Perfect mirror.

    reflectance: 0 to 1.
    """

    reflectance: Spectrum


class Dielectric(Record, frozen=True, kw_only=True, tag_field="type", tag="dielectric"):
    """Smooth interface.

    ior: n behind the surface / n in front of it, front being where the normal points.
    """

    ior: Ior


class Phong(Record, frozen=True, kw_only=True, tag_field="type", tag="phong"):
    """Lambertian reflection plus a Phong lobe.

    diffuse, specular: albedo of each, 0 to 1, their sum at most 1 per channel; exponent: of the lobe, up to 10^6.
    """

    diffuse: Spectrum
    specular: Spectrum
    exponent: Exponent


class Shape(Record, frozen=True, kw_only=True):
    """What every shape has.

    material: name of one of the scene's materials; emission: radiance that the front side emits, diffuse or Phong
    materials only.
    """

    material: str
    emission: Spectrum = 0.0


class Quad(Shape, frozen=True, kw_only=True, tag_field="type", tag="quad"):
    """Flat convex quadrilateral.

    corners: in order around it, in scene units; the front is by the right-hand rule.
    """

    corners: tuple[Vector, Vector, Vector, Vector]


class Sphere(Shape, frozen=True, kw_only=True, tag_field="type", tag="sphere"):
    """Analytic sphere; its front is the outside.

    center: in scene units; radius: in scene units, > 0.
    """

    center: Vector
    radius: float


class Box(Shape, frozen=True, kw_only=True, tag_field="type", tag="box"):
    """Axis-aligned box with outward normals.

    min, max: opposite corners in scene units, min < max in x, y and z.
    """

    min: Vector
    max: Vector


class Mesh(Shape, frozen=True, kw_only=True, tag_field="type", tag="mesh"):
    """Triangle mesh: exactly one of `file` and `generate`.

    file: PLY or OBJ, relative to the scene file; generate: a mesh that the program makes: `horse`, `dragon`, `tin` or
    `lid`; smooth: only `false`, meshes are flat shaded; scale: factor, or one for each axis, > 0, applied first;
    rotate: degrees about the fixed x axis, then y, then z, applied second; translate: scene units, applied last.
    """

    file: str | None = None
    generate: str | None = None
    smooth: bool = False
    scale: Spectrum = 1.0
    rotate: Vector = (0.0, 0.0, 0.0)
    translate: Vector = (0.0, 0.0, 0.0)


class SceneFile(Record, frozen=True, kw_only=True):
    """A whole scene file.

    camera: used where the config has none; materials: a name for each, with its `type` and the keys of that type;
    shapes: each with its `type` and the keys of that type, at least one emits light.
    """

    # Materials and shapes are converted one by one, each with its own place.

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

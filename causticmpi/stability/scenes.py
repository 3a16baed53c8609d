"""Scenes made from parameters: plain data in the form of a scene file, one function per kind of room.

All rooms are 2 units wide before `scale` and `offset`. Lights keep their power while their size changes.
"""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from causticmpi.errors import InputError

SceneDict = dict[str, Any]
POWER = 15 * 0.5**2
"""Radiance times area of a light, as in the Cornell box."""
MATERIALS: SceneDict = {
    "white": {"type": "diffuse", "reflectance": [0.725, 0.71, 0.68]},
    "red": {"type": "diffuse", "reflectance": [0.63, 0.065, 0.05]},
    "green": {"type": "diffuse", "reflectance": [0.14, 0.45, 0.091]},
    "black": {"type": "diffuse", "reflectance": 0.0},
    "mirror": {"type": "mirror", "reflectance": 0.9},
}
OUTSIDE = 4.0
"""Distance of the bright walls around `closed` from its centre."""


def _quad(corners: list[list[float]], material: str, emission: float = 0.0) -> SceneDict:
    made: SceneDict = {"type": "quad", "corners": corners, "material": material}
    return made | {"emission": emission} if emission > 0 else made


def _level(y: float, half: float, material: str, up: bool, emission: float = 0.0, x: float = 0.0) -> SceneDict:
    """A horizontal square about (x, y, 0)."""
    corners = [[x - half, y, half], [x + half, y, half], [x + half, y, -half], [x - half, y, -half]]
    return _quad(corners if up else corners[::-1], material, emission)


def _upright(plane: str, at: float, material: str, emission: float = 0.0, half: float = 1.0) -> SceneDict:
    """A wall x = at or z = at of side 2 half; its front looks at the origin."""
    a, b = -half, half
    if plane == "x":
        corners = [[at, a, b], [at, a, a], [at, b, a], [at, b, b]]
    else:
        corners = [[a, a, at], [b, a, at], [b, b, at], [a, b, at]]
    return _quad(corners if (at < 0) else corners[::-1], material, emission)


def _room(left: str = "red", right: str = "green", back: str = "white", floor: str = "white") -> list[SceneDict]:
    return [
        _level(-1.0, 1.0, floor, up=True),
        _level(1.0, 1.0, "white", up=False),
        _upright("z", -1.0, back),
        _upright("x", -1.0, left),
        _upright("x", 1.0, right),
    ]


def _scene(shapes: list[SceneDict], eye: list[float], target: list[float], fov: float, **more: SceneDict) -> SceneDict:
    camera = {"eye": eye, "target": target, "up": [0.0, 1.0, 0.0], "fov": fov}
    used = {shape["material"] for shape in shapes}
    materials = {name: value for name, value in (MATERIALS | more).items() if name in used}
    return {"camera": camera, "materials": materials, "shapes": shapes}


def box(
    light: float = 0.5, ior: float = 1.5, exponent: float = 0.0, back: str = "white", pane: bool = False
) -> SceneDict:
    """The Cornell box with a mirror and a glass sphere.

    light: side; exponent: the floor's Phong lobe (0: diffuse); back: material of the back wall; pane: a glass pane
    before the camera, so that all is seen through it.
    """
    gloss = {"type": "phong", "diffuse": 0.25, "specular": 0.45, "exponent": exponent}
    shapes = _room(back=back, floor="gloss" if exponent > 0 else "white")
    shapes.append(_level(0.998, light / 2, "black", up=False, emission=POWER / light**2 if light > 0 else 1.0))
    shapes.append({"type": "sphere", "center": [-0.42, -0.65, -0.3], "radius": 0.35, "material": "mirror"})
    shapes.append({"type": "sphere", "center": [0.42, -0.65, 0.3], "radius": 0.35, "material": "glass"})
    if pane:
        shapes.append({"type": "box", "min": [-0.9, -0.95, 1.1], "max": [0.9, 0.9, 1.2], "material": "glass"})
    glass = {"type": "dielectric", "ior": ior}
    return _scene(shapes, [0.0, 0.0, 3.9], [0.0, 0.0, 0.0], 39.3, gloss=gloss, glass=glass)


def sheets(bounces: int = 1, light: float = 0.2, ior: float = 1.2) -> SceneDict:
    """A floor lit through `bounces` level sheets, alternately into glass and out of it: L S^n D paths alone."""
    shapes = [_level(-1.0, 1.0, "white", up=True), _upright("z", -1.0, "white")]
    shapes += [_upright("x", -1.0, "red"), _upright("x", 1.0, "green"), _upright("z", 1.0, "white")]
    shapes.append(_level(0.998, light / 2, "black", up=False, emission=POWER / light**2))
    for i in range(bounces):
        shapes.append(_level(0.6 - 0.05 * i, 1.01, "glass", up=i % 2 == 0))
    return _scene(shapes, [0.0, 0.0, 0.95], [0.0, -0.75, -0.4], 70.0, glass={"type": "dielectric", "ior": ior})


def hidden(light: float = 0.1) -> SceneDict:
    """The box whose light looks up at a mirror plate: caustics (L S D), and caustics of caustics (L S D S D)."""
    made = box(light)
    made["shapes"] = [shape for shape in made["shapes"] if "emission" not in shape]
    made["shapes"].append(_level(0.6, light / 2, "black", up=True, emission=POWER / light**2))
    made["shapes"].append(_level(0.75, light, "mirror", up=False))
    made["materials"]["black"] = MATERIALS["black"]
    return made


def mirrors(reflectance: float = 0.9, light: float = 0.3) -> SceneDict:
    """A room between two facing mirrors with a diffuse sphere: paths between them have no bound."""
    shapes = _room(left="wall", right="wall")
    shapes.append(_level(0.998, light / 2, "black", up=False, emission=POWER / light**2))
    shapes.append({"type": "sphere", "center": [0.2, -0.6, 0.0], "radius": 0.4, "material": "white"})
    wall = {"type": "mirror", "reflectance": reflectance}
    return _scene(shapes, [0.0, 0.0, 3.9], [0.0, 0.0, 0.0], 39.3, wall=wall)


def furnace(rho: float = 0.5, facing: bool = False) -> SceneDict:
    """A closed room of albedo rho whose walls emit 1, with a lossless mirror and a glass sphere: 1 / (1 - rho) is seen.

    facing: the left and the right wall are lossless mirrors instead.
    """
    sides = [("x", -1.0, "lossless"), ("x", 1.0, "lossless")] if facing else [("x", -1.0, "wall"), ("x", 1.0, "wall")]
    shapes = [_level(-1.0, 1.0, "wall", up=True, emission=1.0), _level(1.0, 1.0, "wall", up=False, emission=1.0)]
    for plane, at, material in (*sides, ("z", -1.0, "wall"), ("z", 1.0, "wall")):
        shapes.append(_upright(plane, at, material, emission=1.0 if material == "wall" else 0.0))
    shapes.append({"type": "sphere", "center": [-0.5, -0.55, -0.3], "radius": 0.4, "material": "lossless"})
    shapes.append({"type": "sphere", "center": [0.45, -0.5, 0.1], "radius": 0.45, "material": "glass"})
    more = {
        "wall": {"type": "diffuse", "reflectance": rho},
        "lossless": {"type": "mirror", "reflectance": 1.0},
        "glass": {"type": "dielectric", "ior": 1.5},
    }
    return _scene(shapes, [-0.2, 0.6, 0.93], [0.0, -0.35, -0.2], 75.0, **more)


def closed() -> SceneDict:
    """A dark closed box with mirror and glass inside bright walls of radiance 1: whatever is seen has leaked in."""
    shapes = [_level(-1.0, 1.0, "white", up=True), _level(1.0, 1.0, "white", up=False)]
    shapes += [_upright(plane, at, "white") for plane in ("x", "z") for at in (-1.0, 1.0)]
    shapes += [_level(-OUTSIDE, OUTSIDE, "black", True, 1.0), _level(OUTSIDE, OUTSIDE, "black", False, 1.0)]
    shapes += [_upright(plane, at, "black", 1.0, OUTSIDE) for plane in ("x", "z") for at in (-OUTSIDE, OUTSIDE)]
    shapes.append({"type": "sphere", "center": [-0.5, -0.55, -0.3], "radius": 0.4, "material": "mirror"})
    shapes.append({"type": "sphere", "center": [0.45, -0.5, 0.1], "radius": 0.45, "material": "glass"})
    glass = {"type": "dielectric", "ior": 1.5}
    return _scene(shapes, [-0.2, 0.6, 0.93], [0.0, -0.35, -0.2], 75.0, glass=glass)


TEMPLATES: dict[str, Callable[..., SceneDict]] = {
    made.__name__: made for made in (box, sheets, hidden, mirrors, furnace, closed)
}
PLACED = ("scale", "offset")
"""Parameters of every template: all lengths times `scale`, then moved by `offset` units along each axis."""


def build(template: str, parameters: Mapping[str, Any]) -> SceneDict:
    """The scene of a template. Raises InputError, without a place, for an unknown template or parameter."""
    if template not in TEMPLATES:
        raise InputError(f'found "{template}"; allowed: {", ".join(TEMPLATES)}')
    allowed = [*inspect.signature(TEMPLATES[template]).parameters, *PLACED]
    for name in parameters:
        if name not in allowed:
            raise InputError(f'found the parameter "{name}"; allowed for {template}: {", ".join(allowed)}')
    own = {name: value for name, value in parameters.items() if name not in PLACED}
    return _placed(TEMPLATES[template](**own), float(parameters.get("scale", 1)), float(parameters.get("offset", 0)))


def _placed(scene: SceneDict, scale: float, offset: float) -> SceneDict:
    def point(p: list[float]) -> list[float]:
        return [scale * x + offset for x in p]

    shapes = []
    for shape in scene["shapes"]:
        moved = dict(shape)
        for key in ("center", "min", "max"):
            if key in moved:
                moved[key] = point(moved[key])
        if "corners" in moved:
            moved["corners"] = [point(corner) for corner in moved["corners"]]
        if "radius" in moved:
            moved["radius"] = scale * moved["radius"]
        shapes.append(moved)
    camera = scene["camera"] | {key: point(scene["camera"][key]) for key in ("eye", "target")}
    return scene | {"camera": camera, "shapes": shapes}


def write_scene(scene: SceneDict, path: Path) -> Path:
    """The scene as a file that `causticmpi render` takes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(scene, sort_keys=False))
    return path

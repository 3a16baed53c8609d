"""What can be told to go badly before the budget is spent, and what to do about it: one sentence each.

Nothing here stops a run, and none of it but too large coordinates makes a picture wrong: it would be noisy, or slow.
The thresholds are where the pages of configs/stability see the trouble begin.
"""

import math
from collections.abc import Iterator

import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.kernels.material_kinds import MIRROR, PHONG
from causticmpi.preprocess.parallax import NARROWEST
from causticmpi.render.methods import BIASED, BY_CHANCE, FORECASTING
from causticmpi.scene.content import extent, has_specular
from causticmpi.scene.data import SceneData

BLIND = 1e-5
"""Share of the sphere a light fills below which paths that end on it by chance are too rare for a picture."""
LIGHTS_PER_BIN = 30.0
"""So many lights beside each other in a bin of a table: a sample in the right bin still misses."""
SHARP, SHINY = 1e4, 0.1
"""Exponent and albedo of a lobe that virtual lights cannot light: all of it is left to compensation."""
LOSSLESS, LARGE = 0.8, 0.1
"""Reflectance of facing mirrors worth a word; sides of a mirror, over the scene's extent, that count."""
FAR, TOO_FAR = 1e4, "where float32 coordinates are too coarse for it"
"""Distance from the origin over the scene's extent."""
PARTICLES_PER_PHOTON = 100
"""Emitted for one caustic point: beyond it hardly any light takes part in caustics."""
PHOTONS_PER_CLUSTER = 10
"""Fewer say nothing of where a cluster's light comes from."""


def of_scene(config: RenderConfig, scene: SceneData) -> tuple[str, ...]:
    """Warnings that the scene and the method alone give, before a ray is traced."""
    specular = has_specular(scene)
    made = [*_lights(config, scene)] if specular else []
    if config.method in BIASED:
        made.append(
            f"{config.method} is biased: more passes do not lead to the true picture, and the estimated error is its "
            "noise from pass to pass alone; use iws+cf"
        )
    if config.method.startswith("iws"):
        made += _gloss(scene)
    if specular and config.method in FORECASTING and config.forecast.photons == 0:
        made.append(
            "forecast.photons is 0: caustics are sampled by the BRDF alone; set forecast.photons, or use method pt"
        )
    elif specular and config.method in FORECASTING:
        made += _settings(config)
    return (*made, *_mirrors(scene), *_place(scene))


def of_photons(photons: int, wanted: int, emitted: int) -> tuple[str, ...]:
    """Warnings about the caustic points that were found, of those wanted, by so many emitted particles."""
    if photons == 0:
        return (
            f"no photon of {emitted} reached a surface by way of a specular one: caustics are sampled by the "
            "BRDF alone; is the specular object lit?",
        )
    if photons < wanted:
        return (
            f"the forecast is starved: {photons} of {wanted} caustic points after {emitted} particles; the picture "
            "stays unbiased but caustics will be noisy; bring light and specular objects closer, or use method pt",
        )
    if emitted > PARTICLES_PER_PHOTON * photons:
        return (
            f"only one particle in {emitted / photons:.0f} makes a caustic: it is small or faint, and a forecast may "
            "not pay; compare with method pt",
        )
    return ()


def of_photon_map(photons: int, wanted: int, emitted: int) -> tuple[str, ...]:
    """Warnings about the photon map of `iws+pm`."""
    if photons == wanted:
        return ()
    return (
        f"the photon map is starved: {photons} of {wanted} photons after {emitted} particles; caustics will be blurred "
        "or missing; bring light and specular objects closer",
    )


def _lights(config: RenderConfig, scene: SceneData) -> Iterator[str]:
    """About the smallest light, seen from half the scene's extent away."""
    area = smallest_light(scene)
    distance = extent(scene) / 2
    share = area / (4 * math.pi * distance**2)
    size = f"a light of {math.sqrt(area):.2g} x {math.sqrt(area):.2g} units in a scene of {2 * distance:.2g}"
    if config.method in BY_CHANCE and share < BLIND:
        yield f"{size}: {config.method} meets its caustics by chance, once in {1 / share:.0e} paths; use iws+cf"
    if config.method not in FORECASTING:
        return
    columns, rows = config.forecast.table
    per_bin = (2 * math.pi / (columns * rows)) / (area / distance**2)
    if config.forecast.sampling != "mixture" and per_bin > LIGHTS_PER_BIN:
        yield (
            f"{size}: a bin of forecast.table {columns} x {rows} is {per_bin:.0f} times as wide, so most samples of it "
            "miss; use forecast.sampling: mixture, or a finer table"
        )
    if config.forecast.sampling == "mixture" and math.sqrt(area) < 2 * NARROWEST * distance:
        yield (
            f"{size}: it is nearly a point, narrower than the narrowest cone around a photon, so its caustics will be "
            "noisy; make it larger"
        )


def _settings(config: RenderConfig) -> Iterator[str]:
    photons, clusters = config.forecast.photons, config.forecast.clusters
    if photons < PHOTONS_PER_CLUSTER * clusters:
        yield (
            f"{photons} photons for {clusters} clusters: each knows next to nothing of its light; "
            f"set forecast.clusters to {max(1, photons // 50)} or less, or forecast.photons to {50 * clusters} or more"
        )


def _gloss(scene: SceneData) -> Iterator[str]:
    used = np.unique(scene.primitive_material)
    sharp = used[
        (scene.material_kind[used] == PHONG)
        & (scene.material_exponent[used] >= SHARP)
        & (scene.material_specular[used].max(axis=1) >= SHINY)
    ]
    if len(sharp):
        exponent = scene.material_exponent[sharp].max()
        yield (
            f"a Phong exponent of {exponent:.3g} is too sharp for virtual lights: all its reflections are left to "
            "compensation and will be noisy; make it a mirror, lower the exponent, or use method pt"
        )


def _mirrors(scene: SceneData) -> Iterator[str]:
    """Large flat mirrors that face each other."""
    count = len(scene.triangles)
    material = scene.primitive_material[:count]
    bright = scene.material_reflectance[material].max(axis=1) if count else np.zeros(0)
    corners = scene.vertices[scene.triangles].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(cross, axis=1)
    large = (scene.material_kind[material] == MIRROR) & (bright >= LOSSLESS) & (
        double_area >= (LARGE * extent(scene)) ** 2
    )  # fmt: skip
    rows = np.flatnonzero(large)[:64]  # a scene of more large mirrors is warned of by these
    normal, centre = cross[rows] / double_area[rows, None], corners[rows].mean(axis=1)
    between = centre[None] - centre[:, None]
    apart = np.linalg.norm(between, axis=2)
    # A mirror reflects on both sides: parallel planes, one above the other, closer than they are wide.
    parallel = np.abs(normal @ normal.T) > 0.999
    along = np.abs(np.einsum("ijk,ik->ij", between, normal))
    width = np.sqrt(double_area[rows])
    facing = parallel & (along > 1e-3 * apart) & (np.sqrt(np.maximum(apart**2 - along**2, 0)) < width[:, None])
    if facing.any():
        reflectance = float(bright[rows][facing.any(axis=1)].max())
        length = "some 35" if reflectance > 0.97 else f"some {1 / (1 - reflectance):.0f}"
        yield (
            f"mirrors of reflectance {reflectance:.2g} face each other: paths between them take {length} bounces; "
            "turn one of them, or lower the reflectance, if passes are slow"
        )


def _place(scene: SceneData) -> Iterator[str]:
    """Far from the origin float32 coordinates are coarse: walls move, and rays start behind them."""
    points = np.concatenate([scene.vertices, scene.spheres[:, :3]])
    away = float(np.abs(points).max()) / extent(scene)
    if away > FAR:
        yield (
            f"the scene lies {away:.1g} times its extent from the origin, {TOO_FAR}: the picture will be wrong; "
            "move scene and camera nearer to the origin"
        )


def smallest_light(scene: SceneData) -> float:
    """Area [units^2] of the smallest light: triangles of equal radiance and the same plane belong together."""
    count = len(scene.triangles)
    emitting = np.flatnonzero(scene.primitive_emission[:count] >= 0)
    areas = []
    if len(emitting):
        corners = scene.vertices[scene.triangles[emitting]].astype(np.float64)
        double = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        _, light = np.unique(_connected(scene.triangles[emitting]), return_inverse=True)
        areas += list(np.bincount(light, weights=double / 2))
    lit = scene.primitive_emission[count:] >= 0
    areas += [math.pi * float(radius) ** 2 for radius in scene.spheres[lit, 3]]  # as it is seen
    return min(areas)


def _connected(triangles: np.ndarray) -> np.ndarray:
    """A label for each triangle, equal for those that share vertices, directly or by way of others."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rows = np.repeat(np.arange(len(triangles)), 3)
    _, vertex = np.unique(triangles.ravel(), return_inverse=True)
    shared = coo_array((np.ones(len(rows)), (rows, vertex))).tocsr()
    labels: np.ndarray = connected_components(shared @ shared.T, directed=False)[1]
    return labels

"""What the eye sees: points that stand for the picture, and how far they extend."""

import math
from pathlib import Path

import numpy as np
import pytest

from causticmpi.kernels.camera import film_position
from causticmpi.preprocess.view import VIEWS, extent_in_view, see_views
from causticmpi.scene.tracing import camera_array
from tests.rendering import prepare, scene_from

SIZE = 40
SCENE = """\
camera: {{eye: [0, 0, 5], target: [{target}], up: [0, 1, 0], fov: 40}}
materials: {{floor: {{type: diffuse, reflectance: [0.8, 0.5, 0.2]}}, glass: {{type: dielectric, ior: 1.5}}}}
shapes:
  - {{type: quad, corners: [[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], material: floor, emission: 1}}
  - {{type: sphere, center: [0, 0, 3], radius: 0.2, material: glass}}
"""


def views_of(target: str, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Views (VIEWS, 9) and the camera."""
    scene = scene_from(SCENE.format(target=target), folder)
    camera = camera_array(scene.camera, SIZE, SIZE)
    return see_views(prepare(scene).traced, camera, SIZE, SIZE, 1), camera


def test_views_lie_on_the_floor_within_the_picture(tmp_path):
    views, camera = views_of("0, 0, 0", tmp_path)
    assert views.shape == (VIEWS, 9)
    views = views[views[:, 6] > 0]
    assert 0.98 * VIEWS < len(views) < VIEWS, "the sphere reflects a few into the void"
    np.testing.assert_allclose(views[:, 3:6], [[0, 0, 1]] * len(views), atol=1e-6)
    assert (views[:, 2] > 0).all() and views[:, 2].max() < 0.01
    direct = np.array([film_position(camera, row[:3] - camera[0])[:2] for row in views.astype(np.float32)])
    inside = ((direct > -0.1) & (direct < SIZE + 0.1)).all(axis=1)
    assert inside.mean() > 0.95, "all but what the sphere may bend out of the picture"
    np.testing.assert_allclose(views[:, 6:], [[0.8, 0.5, 0.2]] * len(views), rtol=1e-5)


def test_extent_is_that_of_the_picture_and_not_of_the_scene(tmp_path):
    views, _ = views_of("0, 0, 0", tmp_path)
    side = 2 * 5 * math.tan(math.radians(20))
    assert extent_in_view(views) == pytest.approx(math.sqrt(2) * 0.9 * side, rel=0.03)


def test_an_eye_that_sees_nothing_has_no_extent(tmp_path):
    views, _ = views_of("0, 0, 10", tmp_path)
    assert not views[:, 6:].any()
    assert extent_in_view(views) == 0

"""The scenes at rest of `sims`: their triangles, and that their lights and cameras see them."""

import numpy as np
import pytest

import warp_psf as psf
from sims import bunny, cubes, garden, office, pipe, pisa, spiralling_boxes
from tests.oracles_area import view_points

SCENES = {
    "pipe": pipe,
    "cubes": cubes,
    "office": office,
    "spiralling_boxes": spiralling_boxes,
    "garden": garden,
    "bunny": bunny,
    "pisa": pisa,
}
# Table 2 of the thesis has 148, 1,273 and 16,301; closed bodies have an even number.
TRIANGLES = {"spiralling_boxes": 148, "garden": 1274, "bunny": 16302}


@pytest.fixture(scope="module", params=SCENES)
def frozen(request):
    module = SCENES[request.param]
    model = module.build()
    cameras = [model.camera(index).name for index in range(model.ncam)]
    return request.param, module, psf.freeze_scene(model, cameras=cameras)


def test_triangles_are_as_many_as_the_thesis_says(frozen):
    name, _, scene = frozen
    if name in TRIANGLES:
        assert len(scene.faces) == TRIANGLES[name]
    assert len(np.unique(scene.surface)) == len(scene.flat)


def test_cameras_see_the_scene(frozen):
    _, _, scene = frozen
    for camera in range(len(scene.cameras)):
        there, *_ = view_points(scene, camera, 64, 48)
        assert there.mean() > 0.25


def test_lights_shine_on_what_is_seen(frozen):
    """Every light is before something, and lights a part of some picture."""
    _, module, scene = frozen
    for light in module.lights():
        layers = psf.area_light.upload_layers(
            psf.area_light.bake_layered_map(scene, light, 48, samples=16, device="cpu"), scene, "cpu"
        )
        lit = [psf.area_light.trace_view(layers, camera, 48, 36).visibility.max() for camera in scene.cameras]
        assert max(lit) > 0.5, light.name


def test_office_has_the_lights_of_figure_17():
    assert [light.name for light in office.lights()] == ["ceiling", "wall", "left desk", "right desk", "moon"]


def test_lamp_of_the_cubes_looks_down_on_the_highest_box():
    (lamp,) = cubes.lights()
    assert lamp.rotation[:, 2] == pytest.approx([0.0, 0.0, -1.0])
    assert lamp.position[2] > max(height for *_, height, _ in cubes.BOXES)


def test_lamp_grazes_the_wall_of_the_garden():
    """Light comes at least 60 degrees off the wall's normal: less than half as many map samples lie on it."""
    (lamp,) = garden.lights()
    across, up = np.meshgrid(np.linspace(-3.0, 3.0, 13), np.linspace(0.0, 1.6, 5))
    wall = np.stack([across, np.full_like(across, garden.WALL_Y), up], axis=-1)
    towards = lamp.position - wall
    cosine = -towards[..., 1] / np.linalg.norm(towards, axis=-1)
    assert cosine.min() > 0.0
    assert cosine.max() < 0.5


def test_tower_is_as_many_points_as_in_figure_40():
    """2,239,674 in three lists, within 2 % of which the smallest squares are chosen."""
    scene = psf.freeze_scene(pisa.build())
    counts = psf.area_light.sample_points(scene, smallest=pisa.SMALLEST, levels=3).counts
    assert counts.sum() == pytest.approx(2_239_674, rel=0.02)


def test_nothing_lies_under_the_floor(frozen):
    """The tower, which leans, dips into its lawn."""
    name, _, scene = frozen
    assert scene.bounds[0][2] > (-0.02 if name == "pisa" else -0.11)


def test_scenes_at_rest_have_states_without_end(frozen):
    _, module, _ = frozen
    model = module.build()
    states = module.states(model, 10)
    times = [next(states).time for _ in range(3)]
    assert times == pytest.approx([0.0, 0.1, 0.2], abs=1e-3)

"""Textures where the pieces of a shape meet, and where a mesh brings coordinates of its own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from warp_psf.scene import primitives
from warp_psf.scene.mesh import make_mesh

HALVES = '<texture name="halves" type="2d" builtin="flat" width="16" height="16"/>'
LENS_VERTICES = [(-2, 0, 0), (2, 0, 0), (0, -2, 0), (0, 2, 0), (0, 0, 0.2), (0, 0, -0.2)]
LENS_FACES = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
# The halved floor's cameras: up to the ceiling, and down.
UP, DOWN = 0, 1
# The light that leaves a box is followed on its sides, that of another convex body at the vertices of a finer mesh.
FLOORS = {
    "box": primitives.box((2.0, 2.0, 0.1), cells=2),
    "lens": make_mesh("lens", np.array(LENS_VERTICES, np.float32), LENS_FACES),
}


def load(xml: str, pixels: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A model whose first texture has these pixels, and its initial state."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.tex_data[: pixels.size] = pixels.ravel()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def layers_of(model: mujoco.MjModel, data: mujoco.MjData, size: int, camera: int = 0, **options):
    with psf.Renderer(model, size, size, material_space="linear", environment=None, **options) as renderer:
        renderer.update_scene(data, camera)
        return renderer.layers()


def halved_floor(kind: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A floor, red where x < 0 and green elsewhere, under a white ceiling, with a lamp between."""
    # Each face has corners of its own, all at one place of the texture.
    corners = FLOORS[kind].vertices[FLOORS[kind].faces]
    vertices, faces = corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)
    places = np.where(corners[:, :, :1].mean(axis=1) < 0.0, 0.25, 0.75).repeat(3, axis=0).repeat(2, axis=1)

    def write(rows) -> str:
        return " ".join(str(value) for row in rows for value in row)

    xml = f"""
    <mujoco>
      <visual><headlight active="0"/><quality offsamples="0"/></visual>
      <asset>
        {HALVES}
        <mesh name="floor" vertex="{write(vertices)}" face="{write(faces)}" texcoord="{write(places)}"/>
        <material name="halves" texture="halves" specular="0"/><material name="white" rgba="1 1 1 1" specular="0"/>
      </asset>
      <worldbody>
        <camera pos="0 0 .4" xyaxes="1 0 0 0 -1 0" fovy="110"/><camera pos="0 0 1" xyaxes="1 0 0 0 1 0" fovy="90"/>
        <light type="point" pos="0 0 .8" castshadow="false"/>
        <geom type="mesh" mesh="floor" material="halves"/>
        <geom type="box" size="2 2 .05" pos="0 0 1.3" material="white"/>
      </worldbody>
    </mujoco>"""
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:, :8, 0] = pixels[:, 8:, 1] = 255
    return load(xml, pixels)


@pytest.mark.parametrize("kind", FLOORS)
def test_light_bounces_in_the_colours_that_a_mesh_lays_out(kind):
    layers = layers_of(*halved_floor(kind), 40, UP)
    left, right = layers["indirect"][10:30, 3:10].mean(axis=(0, 1)), layers["indirect"][10:30, 30:37].mean(axis=(0, 1))
    # The nearer half fills twice the solid angle of the other and is better lit; functions over a lens blur the border.
    assert left[0] > 1.6 * left[1] > 0.0
    assert right[1] > 1.6 * right[0] > 0.0


def test_coordinates_of_a_mesh_follow_its_refinement():
    model, data = halved_floor("box")
    coarse, fine = (
        layers_of(model, data, 40, DOWN, bounces=0, shading=shading)["albedo"] for shading in ("pixel", "vertex")
    )
    assert coarse[20, 2, 0] == coarse[20, 37, 1] == 1.0
    # float32 coordinates in pixels of the texture.
    np.testing.assert_allclose(fine, coarse, atol=1e-4)


def test_sides_of_a_cube_run_into_one_another():
    """Where a smooth image of few pixels is looked up, the ends of its sides show no steps."""
    size = 4
    step = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    across, down = np.meshgrid(step, step)
    one = np.ones_like(across)
    sides = [(one, -down, -across), (-one, -down, across), (across, one, down)]
    sides += [(across, -one, -down), (across, -down, one), (-across, -down, -one)]
    directions = np.stack([np.stack(side, axis=2) for side in sides])
    directions /= np.linalg.norm(directions, axis=3, keepdims=True)
    pixels = np.round(255 * (0.5 + 0.5 * directions)).astype(np.uint8)
    xml = f"""
    <mujoco>
      <asset>
        <texture name="sky" type="cube" builtin="flat" width="{size}" height="{6 * size}"/>
        <material name="ball" texture="sky" specular="0"/>
      </asset>
      <worldbody>
        <camera pos="2 2 2" xyaxes="-1 1 0 -1 -1 2" fovy="20"/><geom size="1" material="ball"/>
      </worldbody>
    </mujoco>"""
    albedo = layers_of(*load(xml, pixels), 60, bounces=0)["albedo"]
    assert albedo.min() > 0.0
    # A pixel is 0.03 radians at the nearest, and the slope of the image 0.5 per radian, a third more between the
    # pixels' centres of two sides that meet; at the ends of the view a pixel covers twice the angle.
    for axis in (0, 1):
        assert np.abs(np.diff(albedo, axis=axis)).max() < 0.06


def test_a_capsule_is_as_sharp_where_its_ends_begin():
    """Stripes along a capsule keep their contrast across the line at which the formula of the coordinates changes."""
    pixels = np.repeat(np.tile([0, 255], 16).astype(np.uint8)[None, :, None], 32, axis=0).repeat(3, axis=2)
    xml = """
    <mujoco>
      <asset>
        <texture name="stripes" type="2d" builtin="flat" width="32" height="32"/>
        <material name="stripes" texture="stripes" specular="0"/>
      </asset>
      <worldbody>
        <camera pos="0 -3 .5" xyaxes="1 0 0 0 0 1" fovy="15"/>
        <geom type="capsule" size=".5 .5" material="stripes"/>
      </worldbody>
    </mujoco>"""
    albedo = layers_of(*load(xml, pixels), 60, bounces=0)["albedo"][..., 0]
    # The middle half of every row sees four stripes at eight pixels each.
    contrast = albedo[15:45, 15:45].std(axis=1)
    # The stripes are hardly narrower half a radius up the end than on the side.
    assert contrast.min() > 0.9 * contrast.max() > 0.25


@pytest.mark.parametrize("broken", [np.nan, np.inf, 1e38, -3e9])
def test_broken_coordinates_show_the_mean(broken):
    model, data = halved_floor("lens")
    model.mesh_texcoord[:] = broken
    layers = layers_of(model, data, 40, DOWN)
    # Red and green in equal parts, on every face, and in the light that it sends on.
    seen = layers["segmentation"][..., 0] == 0
    np.testing.assert_allclose(layers["albedo"][seen], np.tile((0.5, 0.5, 0.0), (seen.sum(), 1)), atol=0.01)
    assert np.isfinite(layers["color"]).all()

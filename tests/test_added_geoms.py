"""Geoms that a script adds to a picture, as MuJoCo shapes them: a model's meshes, planes, triangles and arrows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from tests.test_loose import start
from warp_psf.bridge import loose, solids
from warp_psf.bridge.deforming import _find_blockers
from warp_psf.bridge.grouping import _enclose
from warp_psf.scene import primitives
from warp_psf.scene.fit import find_slab

GEOM = mujoco.mjtGeom
# Its corners lie unlike along each axis, so that a turn or a mirror image would show.
WEDGE = '<mesh name="wedge" vertex="0 0 0  .6 0 0  0 .4 0  0 0 .2"/>'
SCENE = f"""
<mujoco>
  <visual><headlight active="0"/></visual>
  <asset>{WEDGE}<mesh name="other" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
  <worldbody>
    <camera name="front" pos="0 -3 .5" xyaxes="1 0 0 0 0 1" fovy="30"/>
    {{}}
  </worldbody>
</mujoco>
"""


def test_an_added_mesh_is_where_a_geom_of_it_would_be():
    place = np.array((0.2, 0.1, 0.4))
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, np.array((0.8, 0.0, 0.6, 0.0)))
    model, data = start(SCENE.format(""))
    with psf.Renderer(model, 120, 120, bounces=0) as renderer:
        renderer.update_scene(data, "front")
        geom = renderer.scene.geoms[renderer.scene.ngeom]
        mujoco.mjv_initGeom(geom, GEOM.mjGEOM_MESH, np.zeros(3), place, turn, np.ones(4, np.float32))
        geom.dataid = 2 * model.mesh("wedge").id
        renderer.scene.ngeom += 1
        added = renderer.layers()
    # A geom's frame is where the mesh's own was before MuJoCo centred it and turned it.
    offset, axes = model.mesh_pos[0], np.empty(9)
    mujoco.mju_quat2Mat(axes, model.mesh_quat[0])
    world = turn.reshape(3, 3) @ axes.reshape(3, 3).T
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, world.ravel())
    position = place - world @ offset
    numbers = [" ".join(map(repr, map(float, values))) for values in (position, quaternion)]
    model, data = start(
        SCENE.format(f'<geom type="mesh" mesh="wedge" pos="{numbers[0]}" quat="{numbers[1]}" rgba="1 1 1 1"/>')
    )
    with psf.Renderer(model, 120, 120, bounces=0) as renderer:
        renderer.update_scene(data, "front")
        expected = renderer.layers()
    there = np.isfinite(expected["depth"])
    assert there.sum() > 250
    # Along edges a rounded pose moves a pixel.
    assert (np.isfinite(added["depth"]) == there).mean() > 0.998
    both = there & np.isfinite(added["depth"])
    assert np.median(np.abs(added["depth"][both] - expected["depth"][both])) < 1e-5
    assert np.quantile(np.linalg.norm(added["normal"] - expected["normal"], axis=2)[both], 0.95) < 1e-4


def surface_of(kind: GEOM, size: tuple[float, float, float], **place: Any) -> solids.Surface | None:
    """A geom in the world, seen from the origin by a camera whose pixels are a hundredth wide at 1 m."""
    geom: Any = SimpleNamespace(
        type=kind, dataid=-1, size=size, pos=place.get("pos", np.zeros(3)), mat=place.get("mat", np.eye(3))
    )
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    return loose._surface(model, geom, np.zeros(3), 0.01)


def area(surface: solids.Surface) -> float:
    vertices, _, faces = surface
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


@pytest.mark.parametrize(
    ("kind", "size", "expected"),
    [(GEOM.mjGEOM_PLANE, (2.0, 3.0, 0.0), 24.0), (GEOM.mjGEOM_TRIANGLE, (2.0, 3.0, 0.0), 3.0)],
)
def test_what_is_flat_has_two_sides(kind, size, expected):
    surface = surface_of(kind, size)
    assert surface is not None
    vertices, normals, faces = surface
    assert area(surface) == pytest.approx(2 * expected)
    np.testing.assert_array_equal(vertices[:, 2], 0.0)
    corners = vertices[faces]
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((turned * normals[faces[:, 0]]).sum(axis=1) > 0).all()
    np.testing.assert_array_equal(turned.sum(axis=0), 0.0)


@pytest.mark.parametrize("size", [(0.0, 0.0, 1.0), (0.0, 2.0, 1.0)])
def test_an_endless_plane_that_is_added_has_no_surface(size):
    assert surface_of(GEOM.mjGEOM_PLANE, size) is None


def test_geoms_without_a_shape_have_no_surface():
    assert surface_of(GEOM.mjGEOM_LABEL, (1.0, 1.0, 1.0)) is None


@pytest.mark.parametrize(
    ("kind", "low", "widest"),
    [(GEOM.mjGEOM_ARROW, 0.0, 1.75), (GEOM.mjGEOM_ARROW1, 0.0, 1.0), (GEOM.mjGEOM_ARROW2, -0.4, 1.75)],
)
def test_arrows_are_as_long_and_wide_as_they_say(kind, low, widest):
    """As MuJoCo draws them: the shaft to a third of the length, the tip at two thirds; 1 has a head no wider."""
    surface = surface_of(kind, (0.05, 0.05, 0.6))
    assert surface is not None
    vertices = surface[0]
    assert vertices[:, 2].min() == pytest.approx(low) and vertices[:, 2].max() == pytest.approx(0.4)
    assert np.hypot(vertices[:, 0], vertices[:, 1]).max() == pytest.approx(0.05 * widest)


def test_the_width_of_lines_is_in_pixels_however_far_they_are():
    widths = []
    for distance in (1.0, 4.0):
        surface = surface_of(GEOM.mjGEOM_LINE, (3.0, 0.0, 0.5), pos=np.array((distance, 0.0, 0.0)))
        assert surface is not None
        vertices = surface[0]
        widths.append(2 * np.hypot(vertices[:, 0] - distance, vertices[:, 1]).max())
    assert widths == pytest.approx([0.03, 0.12])


# Bounds and fits of what a model has


@pytest.mark.parametrize(
    ("b", "b_radius"),
    [((0.3, 0, 0), 0.2), ((0.3, 0, 0), 2.0), ((3.0, 1.0, 0), 0.5), ((0, 0, 0), 1.0), ((0, 2, 0), 1.0)],
)
def test_a_sphere_around_two_touches_both_and_is_no_larger(b, b_radius):
    a, a_radius, b = np.array((0.0, 0.0, 0.0)), 1.0, np.array(b, float)
    center, radius = _enclose(a, a_radius, b, b_radius)
    apart = np.linalg.norm(b - a)
    # Half of what both span along the line through their centres, where neither holds the other.
    assert radius == pytest.approx(max(a_radius, b_radius, 0.5 * (a_radius + apart + b_radius)))
    for inner, inner_radius in ((a, a_radius), (b, b_radius)):
        assert np.linalg.norm(inner - center) + inner_radius <= radius + 1e-12


def test_a_point_within_a_body_blocks_as_the_nearest_of_its_shell():
    points = np.array([(0, 0, 0), (1, 0, 0), (0.9, 0.1, 0), (0, 1, 0), (0.1, 0.8, 0)], np.float32)
    blocking = np.array([0, 1, 3])
    np.testing.assert_array_equal(_find_blockers(np.array([0, 1, 2, 3, 4]), blocking, points), [0, 1, 1, 2, 2])


def test_a_box_with_a_wall_within_is_no_slab():
    """All six sides are there, and faces that are on none of them: light in it meets more than a box."""
    half = np.array((0.3, 0.2, 0.1))
    mesh = primitives.box(half, cells=1)
    vertices, faces = mesh.vertices.astype(float), mesh.faces
    found = find_slab(vertices, faces, mesh.radius)
    assert found is not None
    np.testing.assert_allclose(np.sort(found[2]), np.sort(half), rtol=1e-6)
    wall = np.array([(0, -0.2, -0.1), (0, 0.2, -0.1), (0, 0.2, 0.1), (0, -0.2, 0.1)])
    count = len(vertices)
    walls = np.array([(0, 1, 2), (0, 2, 3)]) + count
    assert find_slab(np.concatenate([vertices, wall]), np.concatenate([faces, walls]), mesh.radius) is None

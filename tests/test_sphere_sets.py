"""Blocker spheres: their tree and weights, the cuts that receivers share, and a skin's shadow against ray casting."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from benchmarks.accuracy import pixel_points
from sims import figure
from tests.oracles import loose_triangles, shade_points, traced_irradiance
from warp_psf.bake.sphere_set import bake_spheres, share_rays
from warp_psf.device import find_device
from warp_psf.field.spheres import SphereSet, build_tree, place_nodes
from warp_psf.field.store import load_arrays, save_arrays
from warp_psf.scene import primitives
from warp_psf.scene.material import Material
from warp_psf.scene.receiver import make_receivers
from warp_psf.scene.scene import Entity, Part, Scene
from warp_psf.shade.spheres import CLUSTER, CUT_SINE, MOST_IN_CUT, choose_cuts, make_cuts, upload_spheres

RANDOM = np.random.default_rng(5)


def scatter(count: int) -> tuple[SphereSet, np.ndarray]:
    """Spheres at random places of a unit cube, carried by as many vertices, and the vertices."""
    order, first, leaves = build_tree(center := RANDOM.uniform(size=(count, 3)))
    carriers = np.arange(count, dtype=np.int32)[:, None]
    radius, weight = RANDOM.uniform(0.02, 0.1, count), RANDOM.uniform(0.2, 1.0, count)
    return SphereSet(radius, weight, carriers, np.ones((count, 1)), first, leaves), center[order]


def under(spheres: SphereSet, node: int) -> slice:
    return slice(spheres.first[node], spheres.first[node] + spheres.leaves[node])


@pytest.mark.parametrize("count", [1, 2, 7, 96])
def test_every_leaf_is_under_the_root_and_once_below_each_depth(count):
    spheres, _ = scatter(count)
    assert len(spheres.leaves) == 2 * count - 1
    assert (spheres.first[0], spheres.leaves[0]) == (0, count)
    # Skipping the subtree of a left child leads to the right one; together they have their parent's leaves.
    for node in np.flatnonzero(spheres.leaves > 1):
        left, right = node + 1, node + 2 * spheres.leaves[node + 1]
        assert spheres.leaves[left] + spheres.leaves[right] == spheres.leaves[node]
        assert spheres.first[right] == spheres.first[left] + spheres.leaves[left]


def test_a_node_keeps_the_sum_of_projected_areas_and_their_centre():
    spheres, center = scatter(33)
    places, radii, weights = place_nodes(spheres, center)
    area = spheres.weight * spheres.radius**2
    for node in range(len(radii)):
        rows = under(spheres, node)
        # Float32 of the nodes.
        assert weights[node] * radii[node] ** 2 == pytest.approx(area[rows].sum(), rel=1e-5)
        middle = (area[rows, None] * center[rows]).sum(axis=0) / area[rows].sum()
        np.testing.assert_allclose(places[node], middle, atol=1e-5)


def test_a_node_reaches_as_far_as_its_leaves_spread():
    spheres, center = scatter(2)
    spheres = dataclasses.replace(spheres, radius=np.full(2, 1e-4), weight=np.ones(2))
    _, radii, _ = place_nodes(spheres, center)
    # Two points at a distance of d from their middle spread by d^2, of which two thirds are seen: R^2 / 2.
    half = np.linalg.norm(center[1] - center[0]) / 2
    assert radii[0] == pytest.approx(np.sqrt(4 / 3) * half, rel=1e-3)


def test_spheres_behind_one_another_share_what_they_take():
    # Seen along a random direction two spheres in one place are one; two that are far apart hardly hide one another.
    together = share_rays(np.zeros((2, 3)), np.ones(2))
    np.testing.assert_allclose(together, 0.5, atol=1e-12)
    apart = share_rays(np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]]), np.ones(2))
    # None of the directions from which it is looked is along the line between them.
    np.testing.assert_allclose(apart, 1.0, atol=1e-12)
    # A small one within a large one has every ray in common with it.
    small, large = share_rays(np.zeros((2, 3)), np.array([0.3, 1.0]))
    assert small == pytest.approx(0.5)
    # Of the large one's rays 9 % meet the small one: the grid of 96 rays across resolves that to a few rows.
    assert large == pytest.approx(1 - 0.5 * 0.09, abs=2e-3)


def cut_of(spheres: SphereSet, center: np.ndarray, points: np.ndarray, entity: int = 0) -> list[set[int]]:
    """The nodes of the cut of each cluster of receivers at points of an entity; the spheres are entity 1's."""
    device = find_device()
    part = Part("body", Material(np.zeros(3), np.zeros(3), 0.0, np.zeros(3)), -1, 0)
    scene = Scene((), (Entity("floor", 0, (part,)), Entity("body", 0, (part,))), (), deforming=(1,))
    state = upload_spheres(scene, (spheres,), 1, device)
    (table,) = state.tables.tables
    for array, values in zip((table.center, table.radius, table.weight), place_nodes(spheres, center), strict=True):
        array.assign(values[None])
    receivers = make_receivers((1, len(points)), device)
    receivers.entity.fill_(entity)
    receivers.position.assign(np.asarray(points, np.float32)[None])
    cuts = make_cuts(1, len(points), True, device)
    choose_cuts(cuts, receivers, state, device)
    count, node = (array.numpy()[0] for array in (cuts.tables[0].count, cuts.tables[0].node))
    return [set(map(int, row[:size])) for row, size in zip(node, count, strict=True)]


def test_a_cut_holds_every_leaf_once_and_is_coarser_far_away():
    spheres, center = scatter(96)
    far = np.array([0.5, 0.5, 12.0]) + RANDOM.uniform(-0.05, 0.05, (CLUSTER, 3))
    near = np.array([0.5, 0.5, 1.2]) + RANDOM.uniform(-0.05, 0.05, (CLUSTER, 3))
    cuts = cut_of(spheres, center, np.concatenate([far, near, near[:5]]))
    assert len(cuts) == 3
    for cut in cuts:
        leaves = [leaf for node in cut for leaf in range(*under(spheres, node).indices(96))]
        assert sorted(leaves) == list(range(96))
    assert len(cuts[0]) < 5 < len(cuts[1])
    places, radii, _ = place_nodes(spheres, center)
    for node in cuts[1]:
        away = np.linalg.norm(near - places[node], axis=1).min()
        # The cluster's bounding sphere reaches less than its box' diagonal farther.
        assert spheres.leaves[node] == 1 or radii[node] < 1.01 * CUT_SINE * away


def test_a_cut_that_would_be_too_large_is_coarser():
    spheres, center = scatter(3 * MOST_IN_CUT)
    (cut,) = cut_of(spheres, center, center[:CLUSTER])
    assert len(cut) <= MOST_IN_CUT
    leaves = [leaf for node in cut for leaf in range(*under(spheres, node).indices(3 * MOST_IN_CUT))]
    assert sorted(leaves) == list(range(3 * MOST_IN_CUT))


def test_many_small_spheres_are_no_small_body():
    spheres, center = scatter(96)
    small = dataclasses.replace(spheres, radius=np.full(96, 0.004))
    # Next to the cube each takes less than a thousandth of the view, and together they do not.
    (cut,) = cut_of(small, center, np.array([0.5, 0.5, 1.2]) + RANDOM.uniform(-0.05, 0.05, (CLUSTER, 3)))
    assert sum(int(spheres.leaves[node]) for node in cut) == 96


def test_a_body_s_own_spheres_are_in_no_cut_of_its_receivers():
    spheres, center = scatter(8)
    assert cut_of(spheres, center, center, entity=1) == [set()]


@pytest.mark.parametrize("spoil", [np.negative, np.zeros_like, lambda radius: 1e300 * radius, lambda radius: radius[0]])
def test_damaged_spheres_are_fitted_again(monkeypatch, tmp_path, spoil):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path))
    mesh = primitives.capsule(0.1, 0.2)
    expected = bake_spheres(mesh, 6)
    (file,) = tmp_path.iterdir()
    kept = load_arrays(file.stem)
    assert kept is not None
    save_arrays(file.stem, kept | {"radius": spoil(kept["radius"])})
    with pytest.warns(UserWarning, match="they are fitted again"):
        found = bake_spheres(mesh, 6)
    np.testing.assert_array_equal(found.radius, expected.radius)


# A skin in a scene


@pytest.fixture(scope="module")
def walking():
    model = figure.build()
    data = next(iter(figure.states(model, 30, 0.1)))
    environment = psf.Environment.from_coefficients(psf.load_environment("studio").project(4))
    with psf.Renderer(model, 4, 4, bounces=0, environment=environment, model_lights=False) as renderer:
        renderer.update_scene(data, "front")
        renderer.layers()
        yield model, data, environment, renderer


def ground(count: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Points on the floor about the figure, and their normals."""
    x = np.linspace(-1.2, 1.2, count)
    points = np.stack([*np.meshgrid(x, x), np.zeros((count, count))], axis=-1).reshape(-1, 3)
    return points, np.broadcast_to((0.0, 0.0, 1.0), points.shape)


def test_a_skins_shadow_agrees_with_ray_casting(walking):
    model, data, environment, renderer = walking
    points, normals = ground()
    light = environment.project(4)
    found, _ = shade_points(renderer, renderer._stage.scene.entities[0].name, points, normals)
    expected = traced_irradiance(model, data, points, normals, light, loose=loose_triangles(renderer))
    clear = traced_irradiance(model, data, points, normals, light)
    error = (found - expected) / clear.max()
    # The bar for a skinned body is 0.04 of unshadowed irradiance on the ground it stands on.
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert ((clear - expected) / clear.max()).max() > 0.5  # there is a shadow to be wrong about


def test_under_a_point_light_deforming_bodies_cast_shadows_and_tendons_do_not():
    # A light above the middle of a square of cloth, which lies level over the floor beside a thick tendon.
    xml = """
<mujoco>
  <visual><headlight active="0"/></visual>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <light pos="0 0 3" dir="0 0 -1" diffuse="1 1 1" cutoff="90" exponent="0" bulbradius="0"/>
    <site name="a" pos="-1 1.5 .5"/><site name="b" pos="1 1.5 .5"/>
    <flexcomp name="cloth" type="grid" count="5 5 1" spacing=".2 .2 .2" pos="0 0 1" radius=".01" dim="2" mass="1"/>
  </worldbody>
  <tendon><spatial width=".2"><site site="a"/><site site="b"/></spatial></tendon>
</mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    model.vis.quality.offsamples = 0  # at the cloth's edge a pixel would show some of it
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    # From below the cloth the floor is seen; the camera looks straight down from under it.
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.0, 1.0, 0.0), 6.0, 90.0, -89.9
    with psf.Renderer(model, 96, 96, environment=None, bounces=0) as renderer:
        renderer.update_scene(data, camera)
        layers = renderer.layers()
        points = pixel_points(layers["depth"], renderer.world_from_camera, np.deg2rad(model.vis.global_.fovy))
    floor = (layers["segmentation"] == (model.geom("floor").id, int(mujoco.mjtObj.mjOBJ_GEOM))).all(axis=-1)
    lit = layers["direct"][..., 0]
    # The cloth is 0.8 m wide at a height of 1 m; its shadow from 3 m is half as wide again.
    x, y = points[..., 0], points[..., 1]
    under = floor & (np.maximum(abs(x), abs(y)) < 0.55) & (np.maximum(abs(x), abs(y)) > 0.45)
    beside = floor & (np.maximum(abs(x), abs(y)) > 0.65)
    assert under.any() and (lit[under] == 0.0).all()
    # The tendon's shadow would lie at y = 1.8.
    assert (beside & (abs(y - 1.8) < 0.05) & (abs(x) < 0.8)).any()
    assert (lit[beside & (np.hypot(x, y) < 2.0)] > 0.0).all()


def test_a_flex_gone_astray_darkens_nothing():
    xml = """
<mujoco>
  <visual><headlight active="0"/></visual>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <flexcomp name="cloth" type="grid" count="4 4 1" spacing=".1 .1 .1" pos="0 0 .4" radius=".01" dim="2" mass="1"/>
  </worldbody>
</mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    points, normals = ground(4)
    with psf.Renderer(model, 4, 4, bounces=0) as renderer:
        data.flexvert_xpos[:] = np.nan
        renderer.update_scene(data)
        renderer.layers()
        found, _ = shade_points(renderer, renderer._stage.scene.entities[0].name, points, normals)
    # Without a shadow every point of a plane is lit alike.
    np.testing.assert_allclose(found, np.broadcast_to(found[0], found.shape), rtol=1e-5)
    assert found.min() > 0.0


def test_a_skin_that_is_not_shown_casts_no_shadow(walking):
    model, data, environment, renderer = walking
    points, normals = ground(6)
    name = renderer._stage.scene.entities[0].name
    shadowed, _ = shade_points(renderer, name, points, normals)
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_SKIN] = False
    renderer.update_scene(data, "front", option)
    renderer.layers()
    clear, _ = shade_points(renderer, name, points, normals)
    renderer.update_scene(data, "front")
    renderer.layers()
    again, _ = shade_points(renderer, name, points, normals)
    # What four bands make of a blocker overshoots beside it by a hundredth.
    assert (shadowed - clear).max() < 0.01 * clear.max() < (clear - shadowed).max()
    np.testing.assert_array_equal(again, shadowed)

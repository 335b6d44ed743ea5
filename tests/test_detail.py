"""Meshes cut finely enough to be shaded at their vertices."""

import numpy as np

import warp_psf as psf
from tests.oracles import make_renderer
from warp_psf.scene import detail, primitives
from warp_psf.scene.material import Material
from warp_psf.scene.scene import Entity, Part, Scene

GREY = Material(np.full(3, 0.5), np.zeros(3), 0.0, np.zeros(3))


def scene_of(*meshes: psf.Mesh) -> Scene:
    entities = (Entity(mesh.name, k, (Part(mesh.name, GREY, k, 5),)) for k, mesh in enumerate(meshes))
    return Scene(meshes, tuple(entities), ())


def longest_edge(mesh: psf.Mesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())


def test_floors_are_cut_for_the_bodies_on_them():
    ball = primitives.capsule(0.1, 0.1)
    floor, refined = detail.refine_flat_bodies(scene_of(primitives.box((1.0, 1.0, 0.1)), ball)).meshes
    assert longest_edge(floor) <= detail.EDGE_PER_RADIUS * ball.radius
    assert floor.slab is not None
    assert refined is ball


def test_small_boxes_stay_as_they_are():
    box, ball = primitives.box((0.1, 0.1, 0.1)), primitives.capsule(0.5, 0.5)
    assert len(detail.refine_flat_bodies(scene_of(box, ball)).meshes[0].vertices) == len(box.vertices)


def test_an_endless_floor_stays_affordable():
    floor = detail.refine_flat_bodies(scene_of(primitives.plane(1e4, 1e4), primitives.capsule(0.1, 0.1))).meshes[0]
    # The last halving may overshoot the bound by a factor of four.
    assert len(floor.faces) <= 4 * detail.MOST_FACES


def test_a_scene_without_bodies_is_itself():
    assert detail.refine_flat_bodies(scene_of()).meshes == ()


def test_vertices_show_the_shadow_that_pixels_show():
    xml = """<geom name="floor" type="box" size="3 3 .1" pos="0 0 -.1"/><geom type="sphere" size=".5" pos="0 0 .5"/>
    <camera name="front" pos="0 -4 2.5" xyaxes="1 0 0 0 .5 .866"/>"""
    direct = {}
    for shading in ("pixel", "vertex"):
        renderer, data = make_renderer(xml, 90, 160, shading=shading)
        renderer.update_scene(data, "front")
        direct[shading] = renderer.layers()["direct"]
    error = direct["vertex"] - direct["pixel"]
    # Linear between vertices an eighth of the ball apart; at the contact the light changes over less.
    assert np.sqrt(np.mean(error**2)) < 0.01 * direct["pixel"].max()

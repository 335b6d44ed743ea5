"""Skins and flexes as bodies that deform: what is seen of them, what hides them, and the light that they take."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from benchmarks.accuracy import pixel_points
from tests.oracles import loose_triangles, make_model, shade_points, traced_irradiance
from warp_psf.bridge import looks, meet_deforming, read_deformed
from warp_psf.bridge.deforming import DeformingBody
from warp_psf.scene.topology import area_vectors, pair_edges

KIND, FLAG = mujoco.mjtObj, mujoco.mjtVisFlag
EVERYTHING = mujoco.mjtCatBit.mjCAT_ALL.value
GRID = '<flexcomp name="{}" type="grid" count="{}" spacing=".1 .1 .1" pos="{}" radius="{}" dim="{}" mass="1" {}/>'
ROWS, COLUMNS, RADIUS = 5, 6, 0.01
CLOTH = GRID.format("cloth", f"{ROWS} {COLUMNS} 1", "0 0 .6", RADIUS, 2, 'rgba="1 0 0 1"')
ROPE = GRID.format("rope", "6 1 1", "0 0 .8", 0.02, 1, "")
FLOOR = '<geom name="floor" type="plane" size="5 5 .1" material="white"/>'
CAMERA = '<camera name="front" pos="0 -2 1" xyaxes="1 0 0 0 .5 1"/>'


def meet(model: mujoco.MjModel, option: mujoco.MjvOption | None = None) -> tuple[DeformingBody, ...]:
    """The deforming bodies in the model's initial state."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return meet_deforming(model, data, option or mujoco.MjvOption(), "linear")


def view_of(model, data, option: mujoco.MjvOption | None = None) -> mujoco.MjvScene:
    view = mujoco.MjvScene(model, maxgeom=1000)
    mujoco.mjv_updateScene(model, data, option or mujoco.MjvOption(), None, mujoco.MjvCamera(), EVERYTHING, view)
    return view


def choose(**flags: bool) -> mujoco.MjvOption:
    """MuJoCo's default options but for some flags."""
    option = mujoco.MjvOption()
    for name, value in flags.items():
        option.flags[getattr(FLAG, f"mjVIS_{name}")] = value
    return option


def crumple(data: mujoco.MjData, size: float = 0.02) -> None:
    """Moves every simulated vertex of a flex somewhere else."""
    data.flexvert_xpos[:] += np.random.default_rng(3).uniform(-size, size, data.flexvert_xpos.shape)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    corners = vertices[faces].astype(np.float64)
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum()) / 6


# What is seen of them, and what hides them


@pytest.mark.parametrize("option", [choose(), choose(FLEXSKIN=False, FLEXFACE=True)], ids=["smooth", "flat"])
@pytest.mark.parametrize("dim", [2, 3])
def test_welded_vertices_give_mujoco_s_faces_in_every_state(dim, option):
    count = "4 4 1" if dim == 2 else "3 4 4"
    model, data = make_model(GRID.format("body", count, "0 0 1", RADIUS, dim, 'rgba="1 0 0 1"'))
    (body,) = meet(model, option)
    for _ in range(2):
        view = view_of(model, data, option)
        (state,) = read_deformed(model, view, (body,))
        assert state is not None
        used = int(view.flexfaceused[0])
        assert len(body.shape.faces) == used > 0
        for found, expected in ((state.vertices, view.flexface), (state.normals, view.flexnormal)):
            np.testing.assert_array_equal(found[body.shape.faces].ravel(), expected[: 9 * used])
        np.testing.assert_array_equal(state.blocker_vertices, np.float32(data.flexvert_xpos)[body.origin.points])
        crumple(data)


def test_a_sheet_has_two_sides_a_rim_and_one_sheet_that_blocks():
    model, data = make_model(CLOTH)
    (body,) = meet(model)
    shape = body.shape
    vertices, rim = ROWS * COLUMNS, 2 * (ROWS - 1 + COLUMNS - 1)
    # A rim has normals of its own, and two triangles per edge.
    assert len(shape.vertices) == 2 * vertices + 6 * rim
    assert len(shape.blocker_vertices) == vertices
    assert len(shape.blocker_faces) == model.flex_elemnum[0]
    # Every vertex that is seen lies a radius off the one that it belongs to.
    away = np.linalg.norm(shape.vertices - shape.blocker_vertices[shape.blocker_of], axis=1)
    np.testing.assert_allclose(away, RADIUS, rtol=1e-4)
    # Neighbours in the sheet look to the same side.
    normals = area_vectors(shape.blocker_vertices, shape.blocker_faces)
    assert (normals[:, 2] > 0.0).all() or (normals[:, 2] < 0.0).all()


def test_of_a_solid_its_shell_blocks():
    model, _ = make_model(GRID.format("block", "4 4 4", "0 0 1", RADIUS, 3, ""))
    (body,) = meet(model)
    shape, start = body.shape, int(model.flex_shelldataadr[0])
    assert len(shape.blocker_faces) == model.flex_shellnum[0]
    shell = np.asarray(model.flex_shell[start : start + 3 * model.flex_shellnum[0]])
    assert len(shape.blocker_vertices) == len(np.unique(shell))
    assert pair_edges(shape.blocker_faces)[1]
    # A cube of 0.3 m, in float32.
    assert volume(shape.blocker_vertices, shape.blocker_faces) == pytest.approx(0.027, rel=1e-5)


def test_of_a_layer_of_a_solid_the_layer_blocks():
    model, data = make_model(GRID.format("block", "6 6 6", "0 0 1", RADIUS, 3, ""))
    option = choose(FLEXSKIN=False, FLEXFACE=True)
    volumes = []
    for option.flex_layer in (0, 1):
        (body,) = meet(model, option)
        shape = body.shape
        assert pair_edges(shape.blocker_faces)[1]
        volumes.append(volume(shape.blocker_vertices, shape.blocker_faces))
        away = np.linalg.norm(shape.vertices - shape.blocker_vertices[shape.blocker_of], axis=1)
        np.testing.assert_allclose(away, RADIUS, rtol=1e-3)
    elements = np.asarray(model.flex_elem).reshape(-1, 4)
    a, b, c, d = (data.flexvert_xpos[elements[:, corner]] for corner in range(4))
    content = np.abs(np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a))) / 6
    assert volumes == pytest.approx([content[model.flex_elemlayer == layer].sum() for layer in (0, 1)], rel=1e-5)


def test_a_rope_is_tubes():
    model, data = make_model(ROPE)
    (body,) = meet(model)
    shape = body.shape
    closed = pair_edges(shape.blocker_faces)[1]
    assert closed and len(np.unique(shape.blocker_vertices, axis=0)) == len(shape.blocker_vertices)
    np.testing.assert_array_equal(shape.vertices[:, 2] < 0.8201, True)
    # Of 0.5 m, five tubes that overlap in half balls; what has 16 sides is a little thinner than what is round.
    one = volume(shape.blocker_vertices, shape.blocker_faces) / 5
    assert one == pytest.approx(np.pi * 0.02**2 * 0.1 + 4 / 3 * np.pi * 0.02**3, rel=0.05)
    assert meet(model, choose(FLEXEDGE=False)) == ()


SQUARE = "0 0 0  1 0 0  1 1 0  0 0 0  1 1 0  0 1 0"
BONE = '<bone body="{}" bindpos="0 0 0" bindquat="1 0 0 0" vertid="{}" vertweight="{}"/>'
TEXTURE = (
    '<asset><texture name="checker" type="2d" builtin="checker" width="64" height="64" rgb1="1 1 1" rgb2="0 0 0"/>'
    '<material name="cloth" texture="checker" texrepeat="2 1"/></asset>'
)


def skinned(bones: str, attributes: str = "", others: str = "", header: str = ""):
    """A square of two triangles with corners of their own, in the plane z = 0, on the bodies `a` and `b`."""
    skin = (
        f'<deformable><skin name="square" vertex="{SQUARE}" face="0 1 2 3 4 5" {attributes}>{bones}</skin></deformable>'
    )
    bodies = "".join(
        f'<body name="{name}"><joint name="{name}" type="slide" axis="0 0 1"/><geom size=".01" group="4"/></body>'
        for name in "ab"
    )
    return make_model(bodies + others, '<statistic extent="1"/>' + header + skin)


ONE_BONE = BONE.format("a", "0 1 2 3 4 5", "1 1 1 1 1 1")


def test_vertices_in_one_place_block_as_one_if_they_follow_the_same_bones():
    model, _ = skinned(ONE_BONE)
    (body,) = meet(model)
    assert (len(body.shape.vertices), len(body.shape.blocker_vertices)) == (6, 4)
    np.testing.assert_array_equal(body.shape.blocker_vertices[body.shape.blocker_of], body.shape.vertices)
    # The triangles of two bones come apart.
    model, data = skinned(BONE.format("a", "0 1 2", "1 1 1") + BONE.format("b", "3 4 5", "1 1 1"))
    (body,) = meet(model)
    assert len(body.shape.blocker_vertices) == 6
    data.joint("b").qpos[0] = 0.5
    mujoco.mj_forward(model, data)
    (state,) = read_deformed(model, view_of(model, data), (body,))
    assert state is not None
    assert sorted(state.blocker_vertices[:, 2]) == [0.0] * 3 + [0.5] * 3


def test_texture_coordinates_are_mujoco_s():
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]], np.float32)
    given = " ".join(map(str, corners.ravel()))
    model, _ = skinned(ONE_BONE, f'material="cloth" texcoord="{given}"', header=TEXTURE)
    (body,) = meet(model)
    np.testing.assert_array_equal(body.shape.texture_coordinates, corners.reshape(2, 3, 2))
    assert body.shape.part.mapping.scale == (2.0, 1.0)
    assert meet(model, choose(TEXTURE=False))[0].shape.texture_coordinates is None
    cloth = CLOTH.replace('rgba="1 0 0 1"', 'material="cloth"')
    model, data = make_model(cloth, TEXTURE)
    (body,) = meet(model)
    view = view_of(model, data)
    expected = np.asarray(view.flextexcoord).reshape(-1, 3, 2)[: len(body.shape.faces)]
    np.testing.assert_array_equal(body.shape.texture_coordinates, expected)
    assert np.ptp(expected, axis=(0, 1)).min() == 1.0


# In pictures


def above(height: float = 3.0, fovy: float = 30.0) -> str:
    return f'<camera name="above" pos=".5 .5 {height}" xyaxes="1 0 0 0 1 0" fovy="{fovy}"/>'


def layers_of(model, data, camera: str = "above", option: mujoco.MjvOption | None = None, size: int = 48, **options):
    chosen = {"environment": None, "bounces": 0, "material_space": "linear"} | options
    with psf.Renderer(model, size, size, **chosen) as renderer:
        renderer.update_scene(data, camera, option)
        return renderer.layers()


def test_a_glossy_skin_shines_like_a_plane_of_its_material():
    gloss = '<asset><material name="gloss" rgba=".3 .4 .5 1" specular=".8" shininess=".4"/></asset>'
    light = '<light type="point" pos=".5 .5 2" diffuse="1 1 1" specular="1 1 1" attenuation="1 0 0"/>'
    model, data = skinned(ONE_BONE, 'material="gloss"', above(2.0) + light, gloss)
    plane = '<geom type="plane" pos=".5 .5 0" size=".5 .5 .1" material="gloss"/>'
    expected = layers_of(*make_model(plane + above(2.0) + light, gloss))
    found = layers_of(model, data)
    on_both = (found["segmentation"][..., 1] == KIND.mjOBJ_SKIN) & (expected["segmentation"][..., 0] == 0)
    assert on_both.sum() > 900
    # Where neither ends in a pixel.
    inner = np.s_[8:-8, 8:-8]
    assert on_both[inner].all()
    np.testing.assert_allclose(found["direct"][inner], expected["direct"][inner], rtol=1e-4)
    # Straight under the light the lobe adds to what is diffuse: it is there.
    assert expected["direct"][24, 24, 0] > 1.5 * expected["albedo"][24, 24, 0]


def test_a_texture_lies_on_a_skin():
    corners = "0 0 1 0 1 1 0 0 1 1 0 1"
    attributes = f'material="cloth" texcoord="{corners}"'
    model, data = skinned(ONE_BONE, attributes, above(2.0), TEXTURE)
    albedo = layers_of(model, data)["albedo"][..., 0]
    found = layers_of(model, data)["segmentation"][..., 1] == KIND.mjOBJ_SKIN
    # A checker of two by two, twice beside one another.
    rows, columns = np.nonzero(found)
    inside = albedo[rows.min() + 2 : rows.max() - 1, columns.min() + 2 : columns.max() - 1]
    quarters = [block.mean() for half in np.array_split(inside, 2) for block in np.array_split(half, 4, axis=1)]
    light = np.array(quarters) > 0.4
    np.testing.assert_array_equal(light[:4], [light[0], not light[0]] * 2)
    np.testing.assert_array_equal(light[4:], ~light[:4])


def test_a_flex_is_seen_where_it_is():
    model, data = make_model(FLOOR + CAMERA + CLOTH + ROPE)
    with psf.Renderer(model, 90, 120, bounces=0) as renderer:
        pictures = []
        for _ in range(2):
            renderer.update_scene(data, "front")
            pictures.append(renderer.layers())
            for _ in range(50):
                mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
        names = [entity.name for entity in renderer._stage.scene.entities]
    assert names == ["floor", "cloth", "rope"]
    segmentation = [picture["segmentation"] for picture in pictures]
    for which in range(2):
        rows = [np.nonzero((ids == (which, KIND.mjOBJ_FLEX)).all(axis=-1))[0] for ids in segmentation]
        assert min(map(len, rows)) > 20
        # It has fallen: its picture is lower, and not left behind where it was.
        assert rows[1].mean() > rows[0].mean() + 1
    assert np.isfinite(pictures[1]["color"]).all()


LAMP = '<light type="point" pos="0 0 3" diffuse="1 1 1" specular="0 0 0" attenuation="1 0 0"/>'
BENEATH = '<camera name="beneath" pos="0 0 .5" xyaxes="1 0 0 0 1 0" fovy="40"/>'


def test_a_hidden_flex_vanishes_and_casts_nothing():
    model, data = make_model(FLOOR + CLOTH + CAMERA + BENEATH + LAMP)
    model.flex_group[0] = 2
    hidden = mujoco.MjvOption()
    hidden.flexgroup[2] = 0
    with psf.Renderer(model, 40, 40, environment="overcast", bounces=0) as renderer:
        pictures = []
        for option in (None, hidden, choose(FLEXSKIN=False, FLEXEDGE=False), None):
            for camera in ("front", "beneath"):
                renderer.update_scene(data, camera, option)
                pictures.append(renderer.layers())
    shown, gone, off, again = (pictures[place : place + 2] for place in range(0, 8, 2))
    assert (shown[0]["segmentation"][..., 1] == KIND.mjOBJ_FLEX).sum() > 30
    for picture, other in zip(gone, off, strict=True):
        assert not (picture["segmentation"][..., 1] == KIND.mjOBJ_FLEX).any()
        np.testing.assert_array_equal(picture["color"], other["color"])
    # The floor straight beneath the cloth sees neither lamp nor, mostly, sky.
    middle = np.s_[18:22, 18:22]
    assert shown[1]["direct"][middle].max() < 0.7 * gone[1]["direct"][middle].min()
    for picture, before in zip(again, shown, strict=True):
        np.testing.assert_array_equal(picture["color"], before["color"])


def test_a_body_that_lets_half_of_the_light_through():
    alpha = 0.5
    lit = [
        layers_of(*make_model(FLOOR + CLOTH.replace("1 0 0 1", f"1 0 0 {value}") + BENEATH + LAMP), "beneath")
        for value in (0.0, alpha, 1.0)
    ]
    clear, half, full = (picture["direct"][18:22, 18:22, 1] for picture in lit)
    # The ray from the lamp crosses an upper and a lower side; a body is one pane to it.
    np.testing.assert_allclose(half, (1 - alpha) * clear, rtol=1e-4)
    assert not full.any()


def test_a_colour_that_changes_is_seen():
    model, data = make_model(CLOTH + CAMERA)
    with psf.Renderer(model, 30, 40, bounces=0, material_space="linear") as renderer:
        for color in ((1, 0, 0, 1), (0, 0, 1, 1)):
            model.flex_rgba[0] = color
            renderer.update_scene(data, "front")
            layers = renderer.layers()
            on = layers["segmentation"][..., 1] == KIND.mjOBJ_FLEX
            strongest = layers["albedo"][on].argmax(axis=-1)
            assert on.sum() > 10 and (strongest == np.argmax(color[:3])).all()


def test_looks_tell_what_is_shown_of_skins_and_flexes():
    model, _ = make_model(CLOTH)
    usual = looks(model, mujoco.MjvOption())
    layer, group = mujoco.MjvOption(), mujoco.MjvOption()
    layer.flex_layer, group.flexgroup[0] = 1, 0
    others = [looks(model, option) for option in (choose(FLEXSKIN=False), layer, group)]
    assert usual not in others and len(set(others)) == 3
    # What a model lacks changes nothing of it.
    assert looks(model, choose(SKIN=False)) == usual


def test_frames_are_the_same_whatever_was_drawn_before():
    model, data = make_model(FLOOR + CLOTH + CAMERA + LAMP)
    states = []
    for _ in range(3):
        states.append(np.array(data.flexvert_xpos))
        crumple(data)

    def draw(order: tuple[int, ...]) -> dict[int, np.ndarray]:
        with psf.Renderer(model, 30, 40, bounces=1) as renderer:
            pictures = {}
            for frame in order:
                data.flexvert_xpos[:] = states[frame]
                renderer.update_scene(data, "front")
                pictures[frame] = renderer.layers()["color"]
            return pictures

    forward, backward = draw((0, 1, 2)), draw((2, 0, 1))
    for frame in range(3):
        np.testing.assert_array_equal(forward[frame], backward[frame])
    assert (forward[0] != forward[1]).any()


# The light that they take


@pytest.fixture(scope="module")
def two_cloths():
    """A cloth over another, both level, and the renderer that shows them."""
    upper = GRID.format("upper", "7 7 1", "0 0 .3", RADIUS, 2, "")
    lower = GRID.format("lower", "11 11 1", "0 0 0", RADIUS, 2, "")
    model, data = make_model(upper + lower + '<geom name="speck" size=".001" pos="0 0 -9"/>')
    environment = psf.Environment.from_coefficients(psf.load_environment("studio").project(4))
    with psf.Renderer(model, 4, 4, bounces=0, environment=environment) as renderer:
        renderer.update_scene(data)
        renderer.layers()
        # Receivers of a level cloth hide nothing from themselves: the closed form of the cosine holds.
        renderer._stage.lighting.table.first_transfer.fill_(-1)
        yield model, data, environment, renderer


def on_lower() -> tuple[np.ndarray, np.ndarray]:
    x = np.linspace(-0.45, 0.45, 10)
    points = np.stack([*np.meshgrid(x, x), np.full((10, 10), RADIUS)], axis=-1).reshape(-1, 3)
    return points, np.broadcast_to((0.0, 0.0, 1.0), points.shape)


def test_two_cloths_shadow_one_another(two_cloths):
    model, data, environment, renderer = two_cloths
    points, normals = on_lower()
    found, _ = shade_points(renderer, "lower", points, normals)
    light = environment.project(4)
    expected = traced_irradiance(model, data, points, normals, light, loose=loose_triangles(renderer))
    clear = traced_irradiance(model, data, points, normals, light)
    assert ((clear - expected) / clear).max() > 0.5
    # A mask errs by 1 %, four bands of one occluder by as much again.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.02 * clear.max()


def test_a_body_s_own_spheres_take_nothing_from_it(two_cloths):
    _, _, _, renderer = two_cloths
    points, normals = on_lower()
    # On top of the upper cloth there is only what lies below the horizon.
    points = points * (0.6, 0.6, 0.0) + (0.0, 0.0, 0.3 + RADIUS)
    found, _ = shade_points(renderer, "upper", points, normals)
    np.testing.assert_allclose(found, np.broadcast_to(found[0], found.shape), rtol=1e-5)


def test_a_flex_gone_astray_leaves_the_others(two_cloths):
    model, data, _, renderer = two_cloths
    points, normals = on_lower()
    shadowed, _ = shade_points(renderer, "lower", points, normals)
    place = np.array(data.flexvert_xpos)
    data.flexvert_xpos[: model.flex_vertnum[0]] = np.nan
    renderer.update_scene(data)
    assert np.isfinite(renderer.layers()["color"]).all()
    found, _ = shade_points(renderer, "lower", points, normals)
    # Nothing of the upper cloth is left: all places are lit alike, and more than they were.
    np.testing.assert_allclose(found, np.broadcast_to(found[0], found.shape), rtol=1e-5)
    assert (found > shadowed - 0.02 * found.max()).all() and found.min() > shadowed.min() + 0.2 * found.max()
    vertices, _ = loose_triangles(renderer)
    assert len(vertices) == len(meet(model)[1].shape.vertices)
    data.flexvert_xpos[:] = place
    renderer.update_scene(data)
    renderer.layers()
    np.testing.assert_array_equal(shade_points(renderer, "lower", points, normals)[0], shadowed)


# Their own shadows


FOLD_CAMERA = '<camera name="fold" pos="0 -1.1 1.5" xyaxes="1 0 0 0 .8 .6" fovy="35"/>'


def folded(slope: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A cloth of 1 m that is bent into a valley along y, whose sides rise by `slope`."""
    cloth = GRID.format("cloth", "21 21 1", "0 0 .2", 0.004, 2, 'rgba="1 1 1 1"').replace(".1 .1 .1", ".05 .05 .05")
    model, data = make_model(cloth + FOLD_CAMERA + '<geom name="speck" size=".001" pos="0 0 -9"/>')
    model.vis.quality.offsamples = 0
    data.flexvert_xpos[:, 2] += slope * np.abs(data.flexvert_xpos[:, 0])
    return model, data


def light_on(model, data, **options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the pixels on the cloth receive, [N, 3]; what they should by ray casting; and without any shadow."""
    environment = psf.Environment.from_coefficients(psf.load_environment("studio").project(4))
    settings = {"bounces": 0, "environment": environment, "material_space": "linear", "model_lights": False}
    with psf.Renderer(model, 60, 80, **settings, **options) as renderer:
        renderer.update_scene(data, "fold")
        layers, pose, loose = renderer.layers(), renderer.world_from_camera, loose_triangles(renderer)
    on = layers["segmentation"][..., 1] == KIND.mjOBJ_FLEX
    points, normals = pixel_points(layers["depth"], pose, np.deg2rad(35))[on], layers["normal"][on]
    light = environment.project(4)
    nothing = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    expected, clear = (traced_irradiance(model, data, points, normals, light, loose=each) for each in (loose, nothing))
    return layers["direct"][on] * np.pi / layers["albedo"][on], expected, clear


@pytest.mark.parametrize("slope", [0.8, 1.6])
@pytest.mark.parametrize("shading", ["pixel", "vertex"])
def test_a_valley_hides_its_sides_from_each_other(slope, shading):
    found, expected, clear = light_on(*folded(slope), shading=shading)
    scale = clear.mean()
    assert np.sqrt(np.mean((clear - expected) ** 2)) > 0.1 * scale
    # Masks err by 1 %; pixels at the bottom, where normals turn within an edge, take what vertices around them have.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.03 * scale


def test_what_is_still_keeps_its_transfer_and_what_moves_does_not():
    model, data = folded(1.0)
    with psf.Renderer(model, 60, 80, bounces=0) as renderer:
        renderer.update_scene(data, "fold")
        first = renderer.layers()["direct"]
        (state,) = renderer._stage.hemispheres.states.values()
        done = state.table.progress.numpy().copy()
        assert 0 < (done == 2).sum() < done.size and not (done == 1).any()
        renderer.update_scene(data, "fold")
        np.testing.assert_array_equal(renderer.layers()["direct"], first)
        np.testing.assert_array_equal(state.table.progress.numpy(), done)
        data.flexvert_xpos[:, 2] *= 0.5
        renderer.update_scene(data, "fold")
        moved = renderer.layers()["direct"]
    with psf.Renderer(model, 60, 80, bounces=0) as renderer:
        renderer.update_scene(data, "fold")
        np.testing.assert_array_equal(renderer.layers()["direct"], moved)

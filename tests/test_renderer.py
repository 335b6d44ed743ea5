"""The renderer: its face, like mujoco.Renderer's, and what must hold for whole pictures."""

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from tests.oracles import make_model, make_renderer
from warp_psf.bake import body as bake_body
from warp_psf.basis import sh, sphere
from warp_psf.scene import primitives

HEIGHT, WIDTH = 54, 96
CAMERA = '<camera name="front" pos="0 -5 2.5" xyaxes="1 0 0 0 .45 .9"/>'
SCENE = (
    '<geom name="floor" type="plane" size="9 9 .1" material="white"/>'
    '<geom name="ball" type="sphere" size=".6" pos="-.5 0 .6" rgba=".2 .5 .8 1"/>'
    '<body name="box" mocap="true" pos=".8 .4 .4"><geom type="box" size=".4 .3 .4" rgba=".8 .4 .2 1"/></body>' + CAMERA
)


def sky(order: int = 4) -> np.ndarray:
    light = 0.15 * np.random.default_rng(7).normal(size=(order * order, 3))
    light[0] += 3.0
    light[2] += 0.8
    return light


@pytest.fixture(scope="module")
def scene():
    renderer, data = make_renderer(SCENE, HEIGHT, WIDTH)
    renderer.update_scene(data, "front")
    return renderer, data


# The face


def test_defaults_are_mujoco_s():
    model, data = make_model(SCENE)
    with psf.Renderer(model) as renderer:
        assert (renderer.height, renderer.width) == (240, 320)
        assert renderer.model is model
        renderer.update_scene(data)
        assert renderer.render().shape == (240, 320, 3)


def test_a_picture(scene):
    renderer, _ = scene
    picture = renderer.render()
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture.dtype == np.uint8
    assert 60 < picture.mean() < 220
    np.testing.assert_array_equal(picture, psf.to_display(renderer.layers()["color"]))


def test_depth_and_segmentation(scene):
    renderer, _ = scene
    layers = renderer.layers()
    renderer.enable_depth_rendering()
    depth = renderer.render()
    assert (depth.dtype, depth.shape) == (np.float32, (HEIGHT, WIDTH))
    seen = np.isfinite(layers["depth"])
    np.testing.assert_array_equal(depth[seen], layers["depth"][seen])
    far = renderer.model.vis.map.zfar * renderer.model.stat.extent
    np.testing.assert_allclose(depth[~seen], far)
    renderer.enable_segmentation_rendering()
    segmentation = renderer.render()
    assert (segmentation.dtype, segmentation.shape) == (np.int32, (HEIGHT, WIDTH, 2))
    np.testing.assert_array_equal(segmentation, layers["segmentation"])
    renderer.enable_depth_rendering()
    assert renderer.render().dtype == np.float32
    renderer.disable_depth_rendering()
    assert renderer.render().dtype == np.uint8
    renderer.enable_segmentation_rendering()
    renderer.disable_segmentation_rendering()
    assert renderer.render().dtype == np.uint8


def test_layers(scene):
    renderer, _ = scene
    layers = renderer.layers()
    assert list(layers) == ["color", "direct", "indirect", "albedo", "normal", "depth", "segmentation"]
    for name in ("color", "direct", "albedo", "normal"):
        assert (layers[name].dtype, layers[name].shape) == (np.float32, (HEIGHT, WIDTH, 3))
        assert np.isfinite(layers[name]).all()
    np.testing.assert_allclose(
        np.linalg.norm(layers["normal"], axis=2)[layers["segmentation"][..., 0] >= 0], 1, atol=1e-5
    )
    # They are the caller's own.
    layers["color"][:] = 0
    assert renderer.layers()["color"].any()


def test_out_receives_the_picture(scene):
    renderer, _ = scene
    out = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    assert renderer.render(out=out) is out
    np.testing.assert_array_equal(out, renderer.render())
    other = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    assert renderer.render(out=other) is other
    np.testing.assert_array_equal(out, other)


def test_wrong_out(scene):
    with pytest.raises(ValueError, match=rf"shape \({HEIGHT}, {WIDTH}\), the picture \({HEIGHT}, {WIDTH}, 3\)"):
        scene[0].render(out=np.zeros((HEIGHT, WIDTH), np.uint8))


def test_nothing_to_render_yet():
    model, _ = make_model(SCENE)
    renderer = psf.Renderer(model, 4, 4)
    for use in (renderer.render, renderer.layers, lambda: renderer.world_from_camera):
        with pytest.raises(RuntimeError, match="call update_scene"):
            use()


@pytest.mark.parametrize("shading", ["pixel", "vertex"])
def test_a_closed_renderer_says_so(shading):
    renderer, data = make_renderer(SCENE, 4, 4, shading=shading)
    with renderer:
        renderer.render()
    renderer.close()
    for use in (renderer.render, renderer.layers, lambda: renderer.update_scene(data)):
        with pytest.raises(RuntimeError, match="closed"):
            use()


def test_cameras_by_id_name_and_object(scene):
    renderer, data = scene
    named = renderer.layers()["color"]
    free = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(renderer.model, free)
    free.azimuth += 40
    pictures = []
    for camera in (0, -1, free):
        renderer.update_scene(data, camera)
        pictures.append(renderer.layers()["color"])
    np.testing.assert_array_equal(pictures[0], named)
    assert np.abs(pictures[1] - pictures[2]).max() > 0.1
    renderer.update_scene(data, "front")
    pose = renderer.world_from_camera
    np.testing.assert_allclose(pose[:3, :3], data.cam_xmat[0].reshape(3, 3), atol=1e-6)
    np.testing.assert_allclose(pose[:3, 3], (0, -5, 2.5), atol=1e-6)


def test_stages_are_timed():
    renderer, _ = make_renderer(SCENE, 12, 16)
    renderer.render()
    stages = renderer.stage_seconds
    assert list(stages) == [
        "primary visibility",
        "turn fields",
        "lattice",
        "shadow rays",
        "basis irradiances",
        "light on proxies",
        "bounces",
        "last gather",
        "resolve pixels",
        "display",
    ]
    assert all(seconds >= 0 for seconds in stages.values())
    assert renderer.occluders == 3
    assert renderer.vertices > 1000


def test_progress_is_told():
    told = []
    model, _ = make_model(SCENE)
    psf.Renderer(model, 4, 4, progress=lambda what, share: told.append((what, share)))
    assert told[-1][1] == 1.0
    assert all(what.startswith("baking ") and 0 <= share <= 1 for what, share in told)


def test_only_the_first_frame_tells_that_it_waits_for_kernels():
    told = []
    model, data = make_model(SCENE)
    renderer = psf.Renderer(model, 4, 4, bounces=0, progress=lambda what, share: told.append((what, share)))
    told.clear()
    for _ in range(2):
        renderer.update_scene(data)
        renderer.render()
    assert told == [("preparing kernels", 0.0), ("preparing kernels", 1.0)]


def test_shapes_of_lights_are_not_baked_as_occluders(monkeypatch):
    monkeypatch.setattr(bake_body, "FINEST_RESOLUTION", 16)  # a fraction of the time to bake
    model, _ = make_model(SCENE)
    told = []
    tube = psf.AreaLight("tube", primitives.capsule(0.4, 0.6), (1, 1, 1))
    renderer = psf.Renderer(model, 4, 4, lights=[tube], progress=lambda what, share: told.append(what))
    light = {"baking light of sphere", "baking light of box"}
    assert set(told) == {"baking plane", "baking sphere", "baking box"} | light
    assert renderer.occluders == 3


def test_exposure_and_view():
    pictures = [
        make_renderer(SCENE, 12, 16, exposure=exposure, view=view, bounces=0)[0].render().astype(int)
        for exposure, view in ((0, "neutral"), (1, "neutral"), (0, "srgb"))
    ]
    assert pictures[1].mean() > pictures[0].mean() + 20
    assert np.abs(pictures[2] - pictures[0]).max() > 3


# Whole pictures


def test_renders_are_repeatable_to_the_bit(scene):
    renderer, data = scene
    first = renderer.layers()
    renderer.update_scene(data, -1)
    renderer.render()
    renderer.update_scene(data, "front")
    again = renderer.layers()
    other, other_data = make_renderer(SCENE, HEIGHT, WIDTH)
    other.update_scene(other_data, "front")
    for name, layer in other.layers().items():
        np.testing.assert_array_equal(again[name], first[name])
        np.testing.assert_array_equal(layer, first[name])


def test_moved_bodies_are_drawn_where_they_are(scene):
    renderer, data = scene
    before = renderer.layers()
    data.mocap_pos[0] = (1.2, -0.3, 0.7)
    mujoco.mj_forward(renderer.model, data)
    renderer.update_scene(data, "front")
    after = renderer.layers()
    fresh, fresh_data = make_renderer(SCENE, HEIGHT, WIDTH)
    fresh_data.mocap_pos[0] = (1.2, -0.3, 0.7)
    mujoco.mj_forward(fresh.model, fresh_data)
    fresh.update_scene(fresh_data, "front")
    # Nothing of the frame before is left.
    np.testing.assert_array_equal(fresh.layers()["color"], after["color"])
    assert np.abs(after["color"] - before["color"]).max() > 0.1
    data.mocap_pos[0] = (0.8, 0.4, 0.4)
    mujoco.mj_forward(renderer.model, data)
    renderer.update_scene(data, "front")


def test_a_small_motion_changes_little(scene):
    # A thousandth of the box's radius: 0.6 mm, a fiftieth of a pixel; edges move by an eighth of a pixel at most.
    renderer, data = scene
    before = renderer.layers()
    data.mocap_pos[0] += (6e-4, 0, 0)
    mujoco.mj_forward(renderer.model, data)
    renderer.update_scene(data, "front")
    after = renderer.layers()
    data.mocap_pos[0] -= (6e-4, 0, 0)
    smooth = (renderer._stage.surfaces.extra.numpy() < 0).reshape(HEIGHT, WIDTH)
    change = np.abs(after["color"] - before["color"]).max(axis=2)
    assert change[smooth].max() < 0.02
    assert change.max() < 0.25


def turned(rotation: np.ndarray, others: str = "", **options) -> dict[str, np.ndarray]:
    """The layers of a ball over a floor, with the camera and the light turned along."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    body = (
        f'<body quat="{" ".join(map(str, quaternion))}"><geom type="plane" size="9 9 .1" material="white"/>'
        f'<geom type="sphere" size=".6" pos="-.3 0 .65" material="shiny"/>{others}{CAMERA}</body>'
    )
    header = '<asset><material name="shiny" rgba=".4 .3 .2 1" specular=".5" shininess=".25"/></asset>'
    environment = psf.Environment.from_coefficients(sh.rotate(sky().T, rotation).T)
    renderer, data = make_renderer(body, HEIGHT, WIDTH, header=header, environment=environment, **options)
    renderer.update_scene(data, "front")
    return renderer.layers()


def test_turning_everything_changes_nothing():
    rotation = sphere.frame(np.array([0.48, -0.6, 0.64])) @ sphere.frame(np.array([0.8, 0.36, 0.48]))
    upright, tilted = turned(np.eye(3)), turned(rotation)
    inner = (upright["depth"] < 50) & (tilted["depth"] < 50)
    for name in ("direct", "albedo"):
        difference = np.abs(upright[name] - tilted[name])[inner].max(axis=1)
        # One occluder per receiver: the quadrature is exact in every frame. Float32 coordinates tip a few samples of
        # edges and cells of the lattice to the other side.
        assert np.median(difference) < 1e-5
        assert (difference < 2e-3).mean() > 0.99
    assert (upright["segmentation"] != tilted["segmentation"]).mean() < 0.002


def test_turning_several_occluders_changes_little():
    # Products of more occluders than one hold bands that the quadrature folds back, differently in every frame.
    others = '<geom type="box" size=".2 .2 .3" pos=".7 .2 .3"/><geom type="sphere" size=".3" pos=".6 -.6 .3"/>'
    rotation = sphere.frame(np.array([0.48, -0.6, 0.64])) @ sphere.frame(np.array([0.8, 0.36, 0.48]))
    upright, tilted = turned(np.eye(3), others), turned(rotation, others)
    error = np.abs(upright["direct"] - tilted["direct"])[upright["depth"] < 50] / upright["direct"].max()
    assert np.sqrt(np.mean(error**2)) < 0.005
    assert np.quantile(error, 0.99) < 0.03


def test_vertex_shading_is_like_pixel_shading():
    # On a ball, whose vertices are dense; the picture of the floor depends on its 64 x 64 cells of 12 cm. No bounces,
    # as probes gather the sky's light with them.
    layers = {shading: turned(np.eye(3), shading=shading, bounces=0) for shading in ("pixel", "vertex")}
    ball = layers["pixel"]["segmentation"][..., 0] == 1
    for name, limit in (("direct", 0.01), ("albedo", 0.0)):
        error = np.abs(layers["pixel"][name] - layers["vertex"][name])[ball]
        assert np.quantile(error, 0.98) <= limit


def test_bounced_light_is_a_layer_of_the_color(scene):
    renderer, data = scene
    renderer.update_scene(data, "front")
    layers = renderer.layers()
    body = layers["segmentation"][..., 0] >= 0
    # Nothing here emits, and edges mix in some background: away from them the two layers are all.
    inner = (renderer._stage.surfaces.extra.numpy() < 0).reshape(HEIGHT, WIDTH) & body
    total = layers["direct"] + layers["indirect"]
    assert layers["color"][inner] == pytest.approx(total[inner], rel=1e-5)
    assert layers["indirect"][inner].max() > 0.01
    assert not layers["indirect"][~body & (renderer._stage.surfaces.extra.numpy() < 0).reshape(HEIGHT, WIDTH)].any()


@pytest.mark.parametrize("shading", ["pixel", "vertex"])
def test_bounces_change_no_direct_light(shading):
    pictures = []
    for bounces in (0, 2):
        renderer, data = make_renderer(SCENE, 135, 240, bounces=bounces, shading=shading)
        renderer.update_scene(data, "front")
        pictures.append(renderer.layers())
    without, with_bounces = (layers["direct"] for layers in pictures)
    if shading == "vertex":
        np.testing.assert_array_equal(without, with_bounces)
    else:
        # With bounces, probes gather the sky's light: between them it may be off by the eight percent at which their
        # cells are halved, and is by far less at nearly all pixels.
        error = np.abs(without - with_bounces).max(axis=-1) / without.max()
        assert np.sqrt((error**2).mean()) < 0.005
        assert error.max() < 0.08
    assert not pictures[0]["indirect"].any()
    assert pictures[1]["indirect"].max() > 0.01


def test_vertex_shading_has_the_same_bounced_light():
    # Direct light is interpolated from vertices; bounced light is gathered at pixels either way.
    layers = {shading: turned(np.eye(3), shading=shading) for shading in ("pixel", "vertex")}
    difference = np.abs(layers["pixel"]["indirect"] - layers["vertex"]["indirect"])
    assert layers["pixel"]["indirect"].max() > 0.05
    assert np.quantile(difference, 0.98) < 0.01 * layers["pixel"]["indirect"].max()


def test_area_lights_hang_on_bodies():
    lamp = psf.rectangle_light("lamp", 0.5, 0.5, (5, 5, 5), (0, 0, -0.5), (0, 0, -1), body="box")
    renderer, data = make_renderer(SCENE, HEIGHT, WIDTH, environment=None, lights=[lamp])
    sums = []
    for height in (2.0, 4.0):
        data.mocap_pos[0] = (0, 0, height)
        mujoco.mj_forward(renderer.model, data)
        renderer.update_scene(data, "front")
        sums.append(renderer.layers()["direct"].max())
    assert sums[0] > 2 * sums[1] > 0


def test_light_may_change_between_frames():
    model, data = make_model(SCENE)
    fresh = {}
    for name in ("studio", "sunset", None):
        with psf.Renderer(model, 24, 32, environment=name) as renderer:
            renderer.update_scene(data, "front")
            fresh[name] = renderer.layers()
    with psf.Renderer(model, 24, 32) as renderer:
        renderer.update_scene(data, "front")
        for name in ("studio", "sunset", None, "studio"):
            renderer.environment = name
            found = renderer.layers()
            for layer in ("color", "direct", "indirect"):
                np.testing.assert_array_equal(found[layer], fresh[name][layer], err_msg=f"{name} {layer}")
        assert getattr(renderer.environment, "name", None) == "studio"
        # What cannot be used changes nothing.
        with pytest.raises((ValueError, FileNotFoundError), match="nowhere"):
            renderer.environment = "nowhere"
        np.testing.assert_array_equal(renderer.layers()["color"], fresh["studio"]["color"])
    with pytest.raises(RuntimeError, match="closed"):
        renderer.environment = "studio"

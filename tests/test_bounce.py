"""Light that bounces between bodies: furnaces, what cannot reflect, smooth motion, colours, and the path tracer.

Pictures here are gathered at every pixel; what sparse probes add is a matter of `test_last_gather.py`.
"""

from collections.abc import Iterator
from functools import cache

import mujoco
import numpy as np
import pytest

import warp_psf as psf
import warp_psf.stage
from sims import bodies
from tests.oracles import make_renderer
from tests.oracles_bounce import traced_bounces
from warp_psf.bake import body as bake_body
from warp_psf.shade import last_gather
from warp_psf.shade.between import MOST_SOURCES

HEIGHT, WIDTH = 32, 48
# Every pixel is one surface at its centre.
SHARP = '<visual><quality offsamples="0"/></visual>'
# A few shapes stand for all, so that few are baked.
BALL = 'type="sphere" size=".3"'
PILL = 'type="capsule" size=".12 .2"'
CUBE = 'type="box" size=".2 .2 .2"'


def materials(**rows: tuple[str, float]) -> str:
    """Matt materials by name, colour and emission (a multiple of the colour): an MJCF section."""
    lines = [f'<material name="{n}" rgba="{rgb} 1" specular="0" emission="{e}"/>' for n, (rgb, e) in rows.items()]
    return f"<asset>{''.join(lines)}</asset>"


PAINTS = materials(
    glow=(".5 .5 .5", 2.0),
    black=("0 0 0", 0),
    red=(".8 .1 .1", 0),
    green=(".1 .7 .2", 0),
    pale=(".8 .8 .8", 0),
)


def geom(shape: str, position: str, material: str, name: str = "") -> str:
    named = f'name="{name}" ' if name else ""
    return f'<geom {named}{shape} pos="{position}" material="{material}"/>'


def movable(name: str, shape: str, position: str, material: str) -> str:
    return f'<body name="{name}" mocap="true" pos="{position}"><geom {shape} material="{material}"/></body>'


def camera(position: str, axes: str, fovy: float = 60.0) -> str:
    return f'<camera name="eye" pos="{position}" xyaxes="{axes}" fovy="{fovy}"/>'


def closed_room(material: str) -> str:
    """Six thick walls around the cube from -1 to 1, meeting in overlapping corners."""
    walls = []
    for axis in range(3):
        for side in (-1.1, 1.1):
            position, size = np.zeros(3), np.full(3, 1.2)
            position[axis], size[axis] = side, 0.1
            numbers = [" ".join(map(str, vector)) for vector in (position, size)]
            walls.append(geom(f'type="box" size="{numbers[1]}"', numbers[0], material))
    return "".join(walls)


def start(body: str, *, header: str = "", **options) -> tuple[psf.Renderer, mujoco.MjData]:
    """A renderer that shows the camera `eye`."""
    renderer, data = make_renderer(body, HEIGHT, WIDTH, header=PAINTS + SHARP + header, **options)
    renderer.update_scene(data, "eye")
    return renderer, data


def draw(body: str, **options) -> dict[str, np.ndarray]:
    return start(body, **options)[0].layers()


def gather_everywhere(patch: pytest.MonkeyPatch) -> None:
    """Makes every pixel a probe, and lets none be interpolated."""
    # The kernels take the spacings as they are when they are compiled, the first time that they run.
    draw(geom(BALL, "0 0 1", "pale") + geom(PILL, "0 1 1", "pale") + camera("0 -4 1", "1 0 0 0 0 1"))
    patch.setattr(last_gather, "SPACINGS", (1,))
    patch.setattr(warp_psf.stage, "begin_lattice", lambda lattice, *_: lattice.turns.fill_(1))


@pytest.fixture(scope="module", autouse=True)
def at_every_pixel() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        gather_everywhere(patch)
        yield


def uniform(radiance: float = 1.0) -> psf.Environment:
    """Light of one radiance from everywhere."""
    coefficients = np.zeros((16, 3))
    coefficients[0] = radiance * np.sqrt(4 * np.pi)
    return psf.Environment.from_coefficients(coefficients)


# A bright sky from one side: positive everywhere, so that nothing is clamped.
SLANTED = psf.Environment.from_coefficients(np.array([[3.0, 3.2, 3.5], [0.5] * 3, [1.0] * 3, [0.7] * 3]))


def traced_radiance(
    renderer: psf.Renderer, data: mujoco.MjData, bounces: int, paths: int = 256
) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels show surfaces [H, W], and the radiance that each bounce of `SLANTED` adds there [bounces, N, 3]."""
    albedo, receivers = renderer.layers()["albedo"], renderer._stage.surfaces.receivers
    pixels = HEIGHT * WIDTH
    seen = receivers.entity.numpy()[0, :pixels] >= 0
    points, normals = receivers.position.numpy()[0, :pixels], receivers.normal.numpy()[0, :pixels]
    irradiance = traced_bounces(
        renderer.model,
        data,
        points[seen],
        normals[seen],
        bounces=bounces,
        coefficients=SLANTED.project(4),
        paths=paths,
        material_space="linear",
    )
    seen = seen.reshape(HEIGHT, WIDTH)
    return seen, albedo[seen] * irradiance[1:] / np.pi


# Furnaces

ROOM_EYE = camera("0 -.9 0", "1 0 0 0 0 1", 90)


@pytest.mark.parametrize("bounces", [1, 2, 3])
def test_a_furnace_is_a_geometric_series(bounces):
    # Half of 2 is 1: every wall sends out radiance 1 and reflects half. Coverage and texels of walls are closed forms:
    # what is left is float32, and the seams between walls as probes see them.
    layers = draw(closed_room("glow") + ROOM_EYE, environment=None, bounces=bounces)
    expected = sum(0.5**k for k in range(1, bounces + 1))
    assert layers["indirect"] == pytest.approx(np.full((HEIGHT, WIDTH, 3), expected), rel=0.02)
    assert layers["indirect"].mean() == pytest.approx(expected, rel=1e-3)
    assert layers["color"] == pytest.approx(np.full((HEIGHT, WIDTH, 3), 1 + expected), rel=0.01)
    assert not layers["direct"].any()


def test_a_furnace_with_bodies_in_it():
    inside = geom(BALL, "-.4 .2 -.5", "glow") + geom(PILL, ".5 .1 .2", "glow") + geom(CUBE, ".3 .4 -.7", "glow")
    layers = draw(closed_room("glow") + inside + ROOM_EYE, environment=None, bounces=3)
    indirect, expected = layers["indirect"][..., 0], 0.5 + 0.25 + 0.125
    assert len(np.unique(layers["segmentation"][..., 0])) == 8
    # Fourth-order shadows between the bodies are as wide as the bodies are: too much passes on one side and too little
    # on the other.
    assert indirect.mean() == pytest.approx(expected, rel=0.01)
    for entity in np.unique(layers["segmentation"][..., 0]):
        assert indirect[layers["segmentation"][..., 0] == entity].mean() == pytest.approx(expected, rel=0.02)
    assert np.sqrt(np.mean((indirect / expected - 1) ** 2)) < 0.02


# What sends or receives nothing

FLOOR = geom('type="plane" size="2 2 .1"', "0 0 0", "pale", "floor")
EYE = camera("0 -3.2 1.6", "1 0 0 0 .45 .9", 50)


def shown(layers: dict[str, np.ndarray], number: int) -> np.ndarray:
    """The pixels [H, W] of a geom."""
    return layers["segmentation"][..., 0] == number


def test_a_black_body_receives_nothing_and_only_takes_light_away():
    wall = geom('type="box" size=".1 1 1"', "-1.2 0 1", "red")
    others = FLOOR + wall + geom(BALL, ".7 .2 .3", "pale")
    without = draw(others + EYE, environment=uniform())
    with_it = draw(others + geom(BALL, "-.3 0 .3", "black") + EYE, environment=uniform())
    black = shown(with_it, 3)
    assert black.sum() > 20
    assert not with_it["indirect"][black].any()
    assert not with_it["direct"][black].any()
    kept = ~black & (without["segmentation"][..., 0] >= 0)
    more = (with_it["indirect"] - without["indirect"])[kept]
    # It draws the texels of floor and wall to itself, whose size shows in the pixels where the two meet.
    assert np.quantile(more, 0.95) < 0.005 * without["indirect"].max()
    for number in range(3):
        body = shown(without, number) & kept
        assert with_it["indirect"][body].mean() < 0.98 * without["indirect"][body].mean()


def test_one_convex_body_lights_nothing():
    for shape in (BALL, CUBE):
        layers = draw(geom(shape, "0 0 .5", "pale") + EYE)
        assert layers["direct"].any()
        assert not layers["indirect"].any()


def test_an_empty_scene_has_no_indirect_light():
    layers = draw(EYE, environment=uniform())
    assert not layers["indirect"].any()
    assert (layers["color"] > 0).all()


@cache
def mug() -> str:
    """A mesh with a cavity and a handle, a metre high."""
    vertices, faces = bodies.mug(radius=0.45, height=1.0, rings=24, segments=30)
    numbers = [" ".join(map(str, np.asarray(array).ravel())) for array in (vertices.round(6), faces)]
    return f'<asset><mesh name="mug" vertex="{numbers[0]}" face="{numbers[1]}"/></asset>'


# Looks over the rim.
INTO_MUG = geom('type="mesh" mesh="mug"', "0 0 .5", "red") + camera("0 -1.1 2.0", "1 0 0 0 .8 .6", 45)


@pytest.fixture
def coarse_shadows(monkeypatch) -> None:
    """A tenth of the time to bake; a body alone receives no shadow of its field."""
    monkeypatch.setattr(bake_body, "FINEST_RESOLUTION", 8)


@pytest.mark.usefixtures("coarse_shadows")
def test_a_concave_body_lights_itself():
    renderer, data = start(INTO_MUG, header=mug(), environment=SLANTED, bounces=1)
    seen, (expected,) = traced_radiance(renderer, data, 1)
    found = renderer.layers()["indirect"][seen]
    # 16 functions for the light that leaves it (9 % RMS of it is not represented), the oracle's noise.
    assert found.mean(axis=0) == pytest.approx(expected.mean(axis=0), rel=0.05)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.05 * expected.max()


@pytest.mark.usefixtures("coarse_shadows")
def test_a_concave_body_lights_itself_again():
    renderer, data = start(INTO_MUG, header=mug(), environment=SLANTED, bounces=3)
    seen, expected = traced_radiance(renderer, data, 3)
    once = draw(INTO_MUG, header=mug(), environment=SLANTED, bounces=1)["indirect"]
    found = (renderer.layers()["indirect"] - once)[seen]
    assert found.mean(axis=0) == pytest.approx(expected[1:].sum(axis=0).mean(axis=0), rel=0.1)


@cache
def leaving() -> tuple[dict[str, np.ndarray], ...]:
    """A scene with a guest in its midst, with the guest 1 km away, and without it."""
    wall = geom('type="box" size=".1 1 1"', "-1.2 0 1", "red")
    others = FLOOR + wall + geom(BALL, ".7 .2 .3", "pale")
    renderer, data = start(others + movable("guest", CUBE, "0 0 .6", "green") + EYE, environment=SLANTED)
    near = renderer.layers()
    data.mocap_pos[0] = (0, 1000, 0.6)
    mujoco.mj_forward(renderer.model, data)
    renderer.update_scene(data, "eye")
    return near, renderer.layers(), draw(others + EYE, environment=SLANTED)


def test_a_body_out_of_reach_sends_nothing():
    near, away, alone = leaving()
    assert all(np.isfinite(away[name]).all() for name in ("indirect", "color"))
    np.testing.assert_array_equal(away["direct"], alone["direct"])
    apart = [np.abs(layers["indirect"] - alone["indirect"]).max(axis=2) for layers in (near, away)]
    # It takes up (0.35 m / 1 km)^2 of any view, far below the threshold. What differs is where texels lie: see below.
    assert np.median(apart[1]) < 0.003 * alone["indirect"].max()
    assert np.quantile(apart[1], 0.9) < 0.03 * alone["indirect"].max()
    for number in (0, 2):
        body = shown(alone, number)
        assert away["indirect"][body].mean() == pytest.approx(alone["indirect"][body].mean(), rel=0.05)
        assert np.abs(near["indirect"] - alone["indirect"])[body].mean() > np.abs(apart[1])[body].mean()


def test_a_body_out_of_reach_changes_nothing():
    _, away, alone = leaving()
    assert np.abs(away["indirect"] - alone["indirect"]).max() < 0.01 * alone["indirect"].max()


def crowd(count: int) -> str:
    random = np.random.default_rng(11)
    places = random.uniform((-1.5, -1.0, 0.3), (1.5, 1.5, 2.0), (count, 3))
    return "".join(
        geom((BALL, PILL, CUBE)[k % 3], " ".join(map(str, place)), ("pale", "red", "green")[k % 3])
        for k, place in enumerate(places)
    )


def test_more_bodies_than_sources():
    count = 40
    assert count > MOST_SOURCES
    layers = draw(FLOOR + crowd(count) + EYE, environment=SLANTED)
    floor = shown(layers, 0)
    assert np.isfinite(layers["indirect"]).all()
    assert layers["indirect"].min() >= 0
    assert layers["indirect"][floor].mean() > 0.02
    # Reflectance 0.8 at most: each bounce leaves less than the one before.
    assert layers["indirect"].max() < layers["color"].max()


# Numbers of bounces


CORNER = (
    FLOOR
    + geom('type="box" size=".1 1 .8"', "-1.1 0 .8", "red")
    + geom('type="box" size=".1 1 .8"', "1.1 0 .8", "green")
    + geom(BALL, "0 .1 .31", "pale")
    + camera("0 -2.6 1.3", "1 0 0 0 .35 .94", 55)
)


@cache
def corner(bounces: int) -> dict[str, np.ndarray]:
    """A ball over a floor between two walls."""
    return draw(CORNER, environment=SLANTED, bounces=bounces)


def test_no_bounces_leave_direct_light():
    none, some = corner(0), corner(3)
    assert not none["indirect"].any()
    for name in ("albedo", "normal", "depth", "segmentation"):
        np.testing.assert_array_equal(none[name], some[name])
    # Here probes at every pixel gather the sky's light along with bounced light, as far as five bands hold it.
    np.testing.assert_allclose(none["direct"], some["direct"], atol=0.01)
    body = none["segmentation"][..., 0] >= 0
    np.testing.assert_array_equal(none["color"][body], none["direct"][body])
    np.testing.assert_array_equal(none["color"][~body], some["color"][~body])


def test_color_is_the_sum_of_its_layers():
    layers = corner(3)
    body = layers["segmentation"][..., 0] >= 0
    assert layers["color"][body] == pytest.approx((layers["direct"] + layers["indirect"])[body], rel=1e-6)
    assert not layers["indirect"][~body].any()


def test_light_grows_with_bounces_and_converges():
    energy = np.array([corner(bounces)["indirect"].mean(axis=(0, 1)) for bounces in range(6)])
    added = np.diff(energy, axis=0)
    assert (added > 0).all()
    # Each bounce keeps less than the best reflectance of the one before, and much escapes to the sky.
    assert (added[1:] < 0.6 * added[:-1]).all()
    assert (added[-1] < 0.03 * energy[-1]).all()
    for bounces in range(1, 5):
        assert (corner(bounces + 1)["indirect"] - corner(bounces)["indirect"]).min() > -1e-3


def test_each_bounce_is_the_path_tracer_s():
    renderer, data = start(CORNER, environment=SLANTED, bounces=1)
    seen, expected = traced_radiance(renderer, data, 3, paths=512)
    pictures = [corner(bounces)["indirect"][seen] for bounces in range(4)]
    scale = expected.sum(axis=0).max()
    for bounce in range(3):
        found = pictures[bounce + 1] - pictures[bounce]
        # The limit set for each bounce.
        assert found.mean() == pytest.approx(expected[bounce].mean(), rel=0.03)
        # Fourth-order shadows blur the dark gap below the ball and the seams of walls and floor over a few pixels.
        assert np.sqrt(np.mean((found - expected[bounce]) ** 2)) < 0.03 * scale


# Order


def passing(others: str, offset: float, steps: int = 25) -> np.ndarray:
    """The indirect light [step, N, 3] on a wall while a ball moves past another before it."""
    # The camera stands between the wall and the balls.
    wall = geom('type="box" size=".1 2 2"', "-.1 0 0", "pale")
    fixed = geom(BALL, "1.2 .35 0", "green")
    eye = camera(".3 0 0", "0 1 0 0 0 1", 120)
    body = wall + fixed + others + movable("runner", BALL, f".7 {offset} 0", "red") + eye
    renderer, data = start(body, environment=SLANTED)
    taken = []
    for x in np.linspace(0.8, 1.6, steps):
        data.mocap_pos[0] = (x, offset, 0)
        mujoco.mj_forward(renderer.model, data)
        renderer.update_scene(data, "eye")
        layers = renderer.layers()
        assert shown(layers, 0)[::8, ::8].all()
        taken.append(layers["indirect"][::8, ::8].reshape(-1, 3))
    return np.array(taken)


@pytest.mark.parametrize("others", [0, MOST_SOURCES + 4])
def test_bodies_pass_one_another_without_a_jump(others):
    # Three rings of balls on a sphere around the scene, all of them in view of the wall.
    angles = np.linspace(0, 2 * np.pi, others, endpoint=False)
    ring = "".join(
        geom(BALL, f"{1.2 + 0.5 * (k % 3)} {1.6 * np.cos(a)} {1.6 * np.sin(a)}", "pale") for k, a in enumerate(angles)
    )
    light = passing(ring, -0.3)
    steps = np.abs(np.diff(light, axis=0)).max(axis=(1, 2))
    bends = np.abs(np.diff(light, n=2, axis=0)).max(axis=(1, 2))
    assert steps.max() > 1e-3
    # Were the order of two bodies a matter of yes or no, one step would hold all the change.
    assert steps.max() < 4 * np.median(steps)
    assert bends.max() < 1.0 * np.median(steps)


# Colours


def test_a_red_wall_reddens_the_ball_beside_it():
    ball = geom(BALL, "-.6 0 .31", "pale")
    for paint, channel in (("red", 0), ("green", 1)):
        wall = geom('type="box" size=".1 1 .8"', "-1.1 0 .8", paint)
        layers = draw(FLOOR + ball + wall + EYE, environment=uniform())
        received = layers["indirect"][shown(layers, 1)].mean(axis=0)
        assert received[channel] > 1.2 * np.delete(received, channel).max()


def test_a_white_ball_brightens_the_floor_beside_it():
    received = []
    for paint in ("pale", "black"):
        layers = draw(FLOOR + geom(BALL, "0 0 .31", paint) + EYE, environment=uniform())
        floor = shown(layers, 0)
        received.append(layers["indirect"][floor])
        if paint == "pale":
            near = np.argmin(np.abs(layers["indirect"][floor] - layers["indirect"][floor].max())) // 3
            assert received[0][near].min() > 0.03
    assert not received[1].any()


def test_reflectance_is_no_part_of_what_is_gathered():
    # One bounce of a grey scene under white light scales with the reflectance of what sends and of what receives.
    indirect = {}
    for wall, ball in (("pale", "half"), ("half", "pale"), ("half", "half")):
        layers = draw(
            geom('type="box" size=".1 1 .8"', "-1.1 0 .8", wall) + geom(BALL, "-.6 0 .5", ball) + EYE,
            header=materials(half=(".4 .4 .4", 0)),
            environment=uniform(),
            bounces=1,
        )
        indirect[wall, ball] = layers["indirect"], shown(layers, 0), shown(layers, 1)
    (base, on_wall, on_ball) = indirect["half", "half"]
    # 0.8 is twice 0.4; float32.
    for mask in (on_wall, on_ball):
        assert base[mask].mean() > 1e-3
        for other in (("pale", "half"), ("half", "pale")):
            assert indirect[other][0][mask] == pytest.approx(2 * base[mask], rel=1e-4, abs=1e-6)

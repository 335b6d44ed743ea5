"""An area light of any shape as points of equal area, and what of them a point receives."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.area_light.checks import check_type
from warp_psf.area_light.tracing import StillTable, sees
from warp_psf.scene.light import AreaLight

# The plastic number's powers: points that fill the unit square evenly however many of them are taken.
PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
# Gauss-Legendre points along a rectangle's side: what it sends to a distance of half its side is right to a thousandth.
GAUSS_POINTS = 4
# Where these many samples agree, the others are not asked: a light of which less than a 64th is hidden, or seen, may
# count as wholly so.
ASKED_FIRST = wp.constant(64)
BLOCK = 16
vec16 = wp.types.vector(length=BLOCK, dtype=wp.float32)
# Times the metres by which a sample lies before a point's triangle, it bounds what the smooth normal makes of the
# sample: by more than that can be, or by 0 behind the triangle.
ANY_SHARE = wp.constant(wp.float32(1.0e30))


@wp.struct
class LightTable:
    """Points on a light."""

    position: wp.array2d(dtype=wp.vec3)  # (world, sample), metres
    normal: wp.array2d(dtype=wp.vec3)  # (world, sample), the side that shines
    area: wp.array2d(dtype=wp.float32)  # (world, sample), m^2


@wp.struct
class BrightTable:
    """Points on a light in blocks of sixteen, a coordinate each, so that a core sums a block at once."""

    x: wp.array2d(dtype=vec16)  # (world, block), metres
    y: wp.array2d(dtype=vec16)  # (world, block)
    z: wp.array2d(dtype=vec16)  # (world, block)
    normal_x: wp.array2d(dtype=vec16)  # (world, block), the side that shines
    normal_y: wp.array2d(dtype=vec16)  # (world, block)
    normal_z: wp.array2d(dtype=vec16)  # (world, block)
    area: wp.array2d(dtype=vec16)  # (world, block), m^2; 0 of what fills the last block up


@dataclass(frozen=True, eq=False)
class LightSamples:
    """Points on a light.

    position, normal: world, float64 [N, 3]. area: that each stands for, m^2, float64 [N].
    """

    position: np.ndarray
    normal: np.ndarray
    area: np.ndarray


def sample_light(light: AreaLight, count: int) -> LightSamples:
    """Points on a light that does not hang on a body, each for the same area; any first ones cover it evenly.

    Raises:
        ValueError: the light hangs on a body, or `count` is no whole number from 1 to 65536.
        TypeError: it is no area light.
    """
    check_type("light", light, AreaLight, "rectangle_light or sphere_light")
    if light.body is not None:
        raise ValueError(f"light {light.name!r} hangs on the body {light.body!r}; give it a place in the world")
    if not isinstance(count, (int, np.integer)) or not 1 <= count <= 65536:
        raise ValueError(f"{count!r} samples of light {light.name!r}; give a whole number from 1 to 65536")
    unit = (0.5 + np.arange(count)[:, None] * PLASTIC) % 1.0
    slab = light.mesh.slab
    if slab is not None and slab[2][2] == 0.0:
        area = 4.0 * slab[2][0] * slab[2][1]
        return _on_rectangle(light, 2.0 * unit - 1.0, np.full(count, area / count))
    corners = light.mesh.vertices[light.mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(normals, axis=1)
    # The first coordinate chooses the triangle; what it is off that triangle's share goes on as a coordinate within.
    ends = np.cumsum(double) / double.sum()
    face = np.minimum(np.searchsorted(ends, unit[:, 0], side="right"), len(ends) - 1)
    share = double[face] / double.sum()
    within = np.clip((unit[:, 0] - (ends[face] - share)) / share, 0.0, 1.0)
    root = np.sqrt(within)
    weights = np.stack([1.0 - root, root * (1.0 - unit[:, 1]), root * unit[:, 1]], axis=1)
    place = (weights[..., None] * corners[face]).sum(axis=1)
    normal = (normals / double[:, None])[face]
    area = np.full(count, 0.5 * float(double.sum()) / count)
    return LightSamples(light.position + place @ light.rotation.T, normal @ light.rotation.T, area)


def sample_unshadowed(light: AreaLight, count: int) -> LightSamples:
    """Points over which light that nothing hides is summed: few of a rectangle, `count` of any other shape."""
    slab = light.mesh.slab
    if slab is None or slab[2][2] > 0.0:
        return sample_light(light, count)
    place, weight = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    x, y = np.meshgrid(place, place)
    area = slab[2][0] * slab[2][1] * np.outer(weight, weight)
    return _on_rectangle(light, np.stack([x.ravel(), y.ravel()], axis=1), area.ravel())


def _on_rectangle(light: AreaLight, at: np.ndarray, area: np.ndarray) -> LightSamples:
    """Points of a rectangular light at coordinates from -1 to 1 across it [N, 2]."""
    middle, rotation, half = light.mesh.slab
    place = middle + at * half[:2] @ rotation[:, :2].T
    normal = np.broadcast_to(rotation[:, 2], place.shape)
    return LightSamples(light.position + place @ light.rotation.T, normal @ light.rotation.T, area)


def upload_light(samples: LightSamples, device: wp.Device) -> LightTable:
    """Puts a light's points on the device."""
    table = LightTable()
    table.position = wp.array(samples.position[None], dtype=wp.vec3, device=device)
    table.normal = wp.array(samples.normal[None], dtype=wp.vec3, device=device)
    table.area = wp.array(samples.area[None], dtype=wp.float32, device=device)
    return table


@wp.func
def sent_by(light: LightTable, world: int, sample: int, p: wp.vec3, facing: wp.vec3, n: wp.vec3) -> float:
    """Irradiance at p that a sample of radiance 1 causes when nothing is in the way.

    facing: normal of p's triangle, which must look at the sample too. n: the smooth one.
    """
    offset = light.position[world, sample] - p
    arriving = wp.where(wp.dot(facing, offset) > 0.0, wp.dot(n, offset), 0.0)
    leaving = -wp.dot(light.normal[world, sample], offset)
    squared = wp.max(wp.length_sq(offset), 1.0e-12)
    area = light.area[world, sample]
    return wp.where(arriving > 0.0 and leaving > 0.0, arriving * leaving * area / (squared * squared), 0.0)


def upload_bright(samples: LightSamples, device: wp.Device) -> BrightTable:
    """Puts points over which unhindered light is summed on the device."""
    columns = np.concatenate([samples.position, samples.normal, samples.area[:, None]], axis=1).T
    blocks = np.pad(columns, ((0, 0), (0, -len(samples.area) % BLOCK))).reshape(7, 1, -1, BLOCK)
    table = BrightTable()
    for name, values in zip(("x", "y", "z", "normal_x", "normal_y", "normal_z", "area"), blocks, strict=True):
        setattr(table, name, wp.array(values, dtype=vec16, device=device))
    return table


@wp.func
def irradiance_of(light: BrightTable, world: int, p: wp.vec3, facing: wp.vec3, n: wp.vec3) -> float:
    """Irradiance at p of all samples, for radiance 1, when nothing is in the way: the sum of `sent_by`."""
    total = float(0.0)
    nothing = vec16()
    for block in range(light.area.shape[1]):
        x = light.x[world, block] - vec16(p[0])
        y = light.y[world, block] - vec16(p[1])
        z = light.z[world, block] - vec16(p[2])
        before = wp.max(facing[0] * x + facing[1] * y + facing[2] * z, nothing)
        arriving = wp.min(wp.max(n[0] * x + n[1] * y + n[2] * z, nothing), ANY_SHARE * before)
        toward = wp.cw_mul(light.normal_x[world, block], x) + wp.cw_mul(light.normal_y[world, block], y)
        leaving = wp.max(-toward - wp.cw_mul(light.normal_z[world, block], z), nothing)
        squared = wp.max(wp.cw_mul(x, x) + wp.cw_mul(y, y) + wp.cw_mul(z, z), vec16(1.0e-12))
        form = wp.cw_div(wp.cw_mul(arriving, leaving), wp.cw_mul(squared, squared))
        total += wp.dot(form, light.area[world, block])
    return total


@wp.func
def visible_ratio(
    still: StillTable, light: LightTable, world: int, p: wp.vec3, facing: wp.vec3, n: wp.vec3, all: bool
) -> float:
    """The share of a light's irradiance that reaches p: back-projection (Jeng 2005, section 4.2.1).

    facing, n: as in `sent_by`. all: asks every sample, also where the
    first ones agree.
    """
    sent = float(0.0)
    arrived = float(0.0)
    asked = int(0)
    sample = int(0)
    count = light.position.shape[1]
    while sample < count:
        form = sent_by(light, world, sample, p, facing, n)
        if form > 0.0:
            sent += form
            if sees(still, p, facing, light.position[world, sample]):
                arrived += form
            asked += 1
            if asked == ASKED_FIRST and not all and (arrived == 0.0 or arrived == sent):
                sample = count
        sample += 1
    return wp.where(sent > 0.0, arrived / wp.max(sent, 1.0e-30), 0.0)

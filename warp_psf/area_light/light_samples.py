"""An area light of any shape as points of equal area, and what of them a point receives."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.area_light.tracing import StillTable, sees
from warp_psf.scene.light import AreaLight

# The plastic number's powers: points that fill the unit square evenly however many of them are taken.
PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
# Points of a rectangle over which unshadowed light is summed: within 1 % at a distance of its side.
ENOUGH = 36
# Where these many samples agree, the others are not asked: a light of which less than a 64th is hidden, or seen, may
# count as wholly so.
ASKED_FIRST = wp.constant(64)


@wp.struct
class LightTable:
    """Points on a light."""

    position: wp.array2d(dtype=wp.vec3)  # (world, sample), metres
    normal: wp.array2d(dtype=wp.vec3)  # (world, sample), the side that shines
    area: wp.float32  # of each, m^2
    enough: wp.int32  # so many of the first ones tell what arrives when nothing is in the way


@dataclass(frozen=True, eq=False)
class LightSamples:
    """Points on a light, each for the same area. Any first ones of them cover the light evenly.

    position, normal: world, float64 [N, 3]. area: of each, m^2.
    """

    position: np.ndarray
    normal: np.ndarray
    area: float


def sample_light(light: AreaLight, count: int) -> LightSamples:
    """Points on a light that does not hang on a body.

    Raises:
        ValueError: the light hangs on a body, or `count` is no whole number from 1 to 65536.
    """
    if light.body is not None:
        raise ValueError(f"light {light.name!r} hangs on the body {light.body!r}; give it a place in the world")
    if not isinstance(count, (int, np.integer)) or not 1 <= count <= 65536:
        raise ValueError(f"{count!r} samples of light {light.name!r}; give a whole number from 1 to 65536")
    unit = (0.5 + np.arange(count)[:, None] * PLASTIC) % 1.0
    slab = light.mesh.slab
    if slab is not None and slab[2][2] == 0.0:
        middle, rotation, half = slab
        place = middle + (2.0 * unit - 1.0) * half[:2] @ rotation[:, :2].T
        normal = np.broadcast_to(rotation[:, 2], place.shape)
        return LightSamples(
            light.position + place @ light.rotation.T, normal @ light.rotation.T, 4.0 * half[0] * half[1] / count
        )
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
    return LightSamples(
        light.position + place @ light.rotation.T, normal @ light.rotation.T, 0.5 * float(double.sum()) / count
    )


def upload_light(samples: LightSamples, device: wp.Device) -> LightTable:
    """Puts a light's points on the device."""
    table = LightTable()
    table.position = wp.array(samples.position[None], dtype=wp.vec3, device=device)
    table.normal = wp.array(samples.normal[None], dtype=wp.vec3, device=device)
    table.area = samples.area
    # Of a body half the points look away, and they lie less evenly than on a rectangle.
    flat = (samples.normal == samples.normal[0]).all()
    table.enough = min(ENOUGH, len(samples.normal)) if flat else len(samples.normal)
    return table


@wp.func
def sent_by(light: LightTable, world: int, sample: int, p: wp.vec3, n: wp.vec3) -> float:
    """Irradiance at p that a sample of radiance 1 causes when nothing is in the way."""
    offset = light.position[world, sample] - p
    arriving = wp.dot(n, offset)
    leaving = -wp.dot(light.normal[world, sample], offset)
    squared = wp.max(wp.length_sq(offset), 1.0e-12)
    return wp.where(arriving > 0.0 and leaving > 0.0, arriving * leaving * light.area / (squared * squared), 0.0)


@wp.func
def irradiance_of(light: LightTable, world: int, p: wp.vec3, n: wp.vec3) -> float:
    """Irradiance at p of the light, for radiance 1, when nothing is in the way."""
    total = float(0.0)
    for sample in range(light.enough):
        total += sent_by(light, world, sample, p, n)
    return total * float(light.position.shape[1]) / float(light.enough)


@wp.func
def visible_ratio(
    still: StillTable, light: LightTable, world: int, p: wp.vec3, facing: wp.vec3, n: wp.vec3, all: bool
) -> float:
    """The share of a light's irradiance that reaches p: back-projection (Jeng 2005, section 4.2.1).

    facing: normal of p's triangle, from which rays start. n: the smooth one. all: asks every sample, also where the
    first ones agree.
    """
    sent = float(0.0)
    arrived = float(0.0)
    asked = int(0)
    sample = int(0)
    count = light.position.shape[1]
    while sample < count:
        form = sent_by(light, world, sample, p, n)
        if form > 0.0:
            sent += form
            if sees(still, p, facing, light.position[world, sample]):
                arrived += form
            asked += 1
            if asked == ASKED_FIRST and not all and (arrived == 0.0 or arrived == sent):
                sample = count
        sample += 1
    return wp.where(sent > 0.0, arrived / wp.max(sent, 1.0e-30), 0.0)

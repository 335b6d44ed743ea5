"""Bounced light on the texels of slabs: gathered at stations, one in the middle of each block, and spread from there.

Bounced light has no edges. Between the stations it is interpolated, as steps from block to block would be seen by what
lies close to the face.
"""

import warp as wp

from warp_psf.device import launch
from warp_psf.scene.geometry import DeviceScene, GeometryTables, part_of
from warp_psf.shade.patches import BLOCK, BLOCKS_PER_SIDE, Patches, PatchTables


@wp.func
def stations_along(place: int, count: int):
    """The stations before and after a place along a side of `count` texels, and the share of the second."""
    block = wp.min(wp.max(wp.static(BLOCK), count / wp.static(BLOCKS_PER_SIDE)), count)
    last = (count - block / 2 + block - 1) / block - 1
    along = wp.clamp(float(place - block / 2) / float(block), 0.0, float(last))
    before = int(along)
    return before, wp.min(before + 1, last), along - float(before), last + 1


@wp.func
def stations_around(texel: int, patches: PatchTables):
    """The four stations around a texel, among all faces', and the share of each."""
    face = patches[0].texel_face[texel]
    size = patches[0].size[face]
    index = texel - patches[0].first_texel[face]
    left, right, u, columns = stations_along(index % size[0], size[0])
    above, below, v, _rows = stations_along(index / size[0], size[1])
    start = patches[0].first_station[face]
    stations = wp.vec4i(
        start + above * columns + left,
        start + above * columns + right,
        start + below * columns + left,
        start + below * columns + right,
    )
    return stations, wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)


@wp.kernel(enable_backward=False, module="unique")
def _spread_openness(first: int, patches: PatchTables):
    world, texel = wp.tid()
    texel += first
    if patches[0].seen[world, patches[0].texel_face[texel]] == 0:
        return
    stations, shares = stations_around(texel, patches)
    openness = float(0.0)
    for place in range(4):
        openness += shares[place] * patches[0].station_openness[world, stations[place]]
    patches[0].openness[world, texel] = openness


@wp.kernel(enable_backward=False, module="unique")
def _spread_light(
    first: int,
    geometry: GeometryTables,
    patches: PatchTables,
    tint: wp.array2d(dtype=wp.vec3),  # (world, proxy)
    first_texel: int,
    radiance_out: wp.array2d(dtype=wp.vec3),  # (world, proxy)
    total_out: wp.array2d(dtype=wp.vec3),  # (world, proxy), added to
):
    world, texel = wp.tid()
    texel += first
    face = patches[0].texel_face[texel]
    if patches[0].seen[world, face] == 0:
        return
    stations, shares = stations_around(texel, patches)
    irradiance = wp.vec3()
    for place in range(4):
        irradiance += shares[place] * patches[0].gathered[world, stations[place]]
    entity = patches[0].entity[face]
    albedo = wp.cw_mul(tint[world, first_texel + texel], geometry[0].albedo[part_of(geometry, entity, 0)])
    radiance = wp.cw_mul(albedo + geometry[0].specular[entity], irradiance) / wp.pi
    radiance_out[world, first_texel + texel] = radiance
    total_out[world, first_texel + texel] = total_out[world, first_texel + texel] + radiance


def spread_openness(patches: Patches, device: wp.Device) -> None:
    """Gives every texel the openness of the stations around it."""
    worlds = patches.table.focus.shape[0]
    launch(_spread_openness, (worlds, patches.texels), [patches.tables], [], device)


def spread_light(
    patches: Patches,
    scene: DeviceScene,
    tint: wp.array,
    first_texel: int,
    radiance: wp.array,
    total: wp.array,
    device: wp.Device,
) -> None:
    """Lets the light that the stations have gathered leave the texels: into `radiance`, and added to `total`."""
    inputs = [scene.geometry, patches.tables, tint, first_texel]
    launch(_spread_light, (tint.shape[0], patches.texels), inputs, [radiance, total], device)

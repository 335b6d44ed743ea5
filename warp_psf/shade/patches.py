"""Light that leaves flat things: floors, walls and boxes as textures of radiance, one for each face.

Shells around the centre of a large flat body serve badly the receivers that lie on it, so slabs (`Mesh.slab`) have no
basis radiance fields. Each of their faces carries a grid of texels instead, finest where the other bodies are. What a
point receives from a face is the face's coverage, in closed form, times the radiance that the texels show in each
direction, filtered as coarsely as band-limited functions see it.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.device import launch, upload_tables
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, span_of
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.scene.scene import Scene
from warp_psf.shade.occluders import OcclusionState

# Texels along the longest side of a slab, and of all slabs together; the smallest slabs give some up first.
MOST_TEXELS_PER_SIDE = 128
MOST_TEXELS = 65536
# Direct light is followed at every texel, as shadows have edges; bounced light at one of each block of so many by so
# many, as it has none. Along long sides blocks are larger: there are so many of them.
BLOCK = 4
BLOCKS_PER_SIDE = 16
# However short a side is, it gets two texels: light falls off towards edges.
FEWEST_TEXELS_PER_SIDE = 2
# Bodies that rise above a face by less than this share of the slab's half-diagonal do not see it.
FACE_HORIZON = 1.0e-4
# A slab encloses the end of a face when it reaches to within this share of the other's half-diagonal of it.
ENCLOSED = 1.0e-4
# How far around a single body texels are fine, in its bounding radii: its shadow and what it lights lie within.
SPREAD_PER_RADIUS = 3.0
# Something as weak as this draws them to so many half sides around: far from all bodies they are spread evenly.
EVEN_PULL, EVEN_SPREAD = 0.02, 2.0


@wp.struct
class PatchTable:
    """The faces of all slabs, and their texels."""

    center: wp.array(dtype=wp.vec3)  # (entity): of a slab in the entity's frame
    rotation: wp.array(dtype=wp.mat33)  # (entity): entity_from_slab
    slab_half: wp.array(dtype=wp.vec3)  # (entity): half extents, metres
    opacity: wp.array(dtype=wp.float32)  # (entity): 0 for lights and for what casts no shadow
    first_face: wp.array(dtype=wp.int32)  # (entity): its first of six faces, -1 for what is not a slab
    entity: wp.array(dtype=wp.int32)  # (face)
    axis: wp.array(dtype=wp.int32)  # (face): the axis of the slab that it faces along
    side: wp.array(dtype=wp.float32)  # (face): 1 at the axis' positive end, -1 at the other
    half: wp.array(dtype=wp.vec3)  # (face): half extents along its own two axes, and of the slab across it, metres
    size: wp.array(dtype=wp.vec2i)  # (face): texels along its two axes, powers of two
    first_texel: wp.array(dtype=wp.int32)  # (face): among all faces' texels
    first_station: wp.array(dtype=wp.int32)  # (face): among all faces' stations, row by row
    first: wp.array(dtype=wp.int32)  # (face): among all faces' pyramids, the finest level first
    levels: wp.array(dtype=wp.int32)  # (face): of its pyramid
    texel_face: wp.array(dtype=wp.int32)  # (texel)
    # (world, face): middle and half extent along u, and along v, of the part that is not inside other slabs, metres
    part: wp.array2d(dtype=wp.vec4)
    # (world, face): along u and along v, where texels are finest, from the middle of the part, and how fine
    focus: wp.array2d(dtype=wp.vec4)
    seen: wp.array2d(dtype=wp.int32)  # (world, face): 1 when another body rises above it
    radiance: wp.array2d(dtype=wp.vec4)  # (world, place in a pyramid): three channels, and how far it is seen
    # (world, station), then (world, texel): share of its hemisphere that is open, as the sight of a texel is weighted
    station_openness: wp.array2d(dtype=wp.float32)
    openness: wp.array2d(dtype=wp.float32)
    gathered: wp.array2d(dtype=wp.vec3)  # (world, station): irradiance of a bounce


PatchTables = wp.array(dtype=PatchTable)


@dataclass(frozen=True)
class Patches:
    """The faces of a scene's slabs.

    texels: how many they have together. stations: texels at which bounced light is gathered, one in each block.
    """

    table: PatchTable
    tables: wp.array  # (1): the table, as kernels take it
    texels: int
    stations: np.ndarray


@wp.func
def axis_vector(axis: int) -> wp.vec3:
    """A unit vector along a slab's own axis."""
    return wp.vec3(wp.where(axis == 0, 1.0, 0.0), wp.where(axis == 1, 1.0, 0.0), wp.where(axis == 2, 1.0, 0.0))


@wp.func
def slab_from_world(world: int, entity: int, poses: PoseTables, patches: PatchTables) -> wp.mat33:
    return wp.transpose(poses[0].rotation[world, entity] * patches[0].rotation[entity])


@wp.func
def slab_origin(world: int, entity: int, poses: PoseTables, patches: PatchTables) -> wp.vec3:
    """The middle of a slab, in the world."""
    return poses[0].position[world, entity] + poses[0].rotation[world, entity] * patches[0].center[entity]


@wp.func
def top_along(
    n: wp.vec3, world: int, entity: int, geometry: GeometryTables, poses: PoseTables, patches: PatchTables
) -> float:
    """How far an entity reaches along a direction of the world, metres."""
    if patches[0].first_face[entity] < 0:
        return span_of(world, entity, n, geometry, poses)[1]
    n_slab = slab_from_world(world, entity, poses, patches) * n
    reach = wp.dot(wp.vec3(wp.abs(n_slab[0]), wp.abs(n_slab[1]), wp.abs(n_slab[2])), patches[0].slab_half[entity])
    return wp.dot(n, slab_origin(world, entity, poses, patches)) + reach


@wp.func
def squeeze(x: float, focus: float, scale: float) -> float:
    """Maps a line to -1..1 so that even steps of the result are finest at the focus."""
    return (x - focus) / (scale + wp.abs(x - focus))


@wp.func
def texel_center(index: int, count: int, half: float, focus: float, scale: float) -> float:
    """Where the centre of a texel lies along a side of a face, metres from its middle."""
    low = squeeze(-half, focus, scale)
    high = squeeze(half, focus, scale)
    squeezed = low + (high - low) * (float(index) + 0.5) / float(count)
    return focus + scale * squeezed / (1.0 - wp.abs(squeezed))


@wp.func
def uncovered_part(world: int, face: int, geometry: GeometryTables, poses: PoseTables, patches: PatchTables) -> wp.vec4:
    """Middle and half extent along both axes of a face without the ends that other slabs enclose: walls meet so."""
    own = patches[0].entity[face]
    axis = patches[0].axis[face]
    half = patches[0].half[face]
    to_slab = slab_from_world(world, own, poses, patches)
    origin = slab_origin(world, own, poses, patches)
    skin = wp.static(ENCLOSED) * geometry[0].radius[own]
    lower = -half
    upper = wp.vec3(half[0], half[1], half[2])
    height = patches[0].side[face] * half[2]
    for entity in range(patches[0].opacity.shape[0]):
        if patches[0].opacity[entity] == 1.0 and entity != own and patches[0].first_face[entity] >= 0:
            turned = to_slab * wp.transpose(slab_from_world(world, entity, poses, patches))
            size = patches[0].slab_half[entity]
            middle = to_slab * (slab_origin(world, entity, poses, patches) - origin)
            # Of a slab that stands askew only a box inside it counts, which for a thin one is nothing.
            reach = wp.vec3()
            for row in range(3):
                largest = int(0)
                for column in range(3):
                    if wp.abs(turned[row, column]) > wp.abs(turned[row, largest]):
                        largest = column
                across = wp.abs(turned[row, 0]) + wp.abs(turned[row, 1]) + wp.abs(turned[row, 2])
                askew = across - wp.abs(turned[row, largest])
                reach[row] = size[largest] - askew * geometry[0].radius[entity]
            if wp.abs(height - middle[axis]) <= reach[axis] + skin:
                for which in range(2):
                    along = (axis + 1 + which) % 3
                    beside = (axis + 2 - which) % 3
                    other = 1 - which
                    low = middle[along] - reach[along]
                    high = middle[along] + reach[along]
                    spans = (
                        middle[beside] - reach[beside] <= lower[other] + skin
                        and middle[beside] + reach[beside] >= upper[other] - skin
                    )
                    if spans and low <= lower[which] + skin and high > lower[which]:
                        lower[which] = wp.min(high, upper[which])
                    if spans and high >= upper[which] - skin and low < upper[which]:
                        upper[which] = wp.max(low, lower[which])
    return wp.vec4(
        0.5 * (lower[0] + upper[0]),
        0.5 * (upper[0] - lower[0]),
        0.5 * (lower[1] + upper[1]),
        0.5 * (upper[1] - lower[1]),
    )


@wp.kernel(enable_backward=False, module="unique")
def _focus_faces(first: int, geometry: GeometryTables, poses: PoseTables, patches: PatchTables):
    world, face = wp.tid()
    face += first
    own = patches[0].entity[face]
    axis = patches[0].axis[face]
    half = patches[0].half[face]
    to_slab = slab_from_world(world, own, poses, patches)
    to_world = wp.transpose(to_slab)
    origin = slab_origin(world, own, poses, patches)
    n = patches[0].side[face] * axis_vector(axis)
    n_world = to_world * n
    part = uncovered_part(world, face, geometry, poses, patches)
    patches[0].part[world, face] = part
    count = float(wp.static(EVEN_PULL))
    mean = wp.vec2()
    evenly = wp.static(EVEN_SPREAD) * wp.vec2(part[1], part[3])
    squares = count * wp.cw_mul(evenly, evenly)
    seen = int(0)
    for entity in range(patches[0].opacity.shape[0]):
        if patches[0].opacity[entity] > 0.0 and entity != own:
            position = poses[0].position[world, entity] + poses[0].rotation[world, entity] * geometry[0].center[entity]
            p = to_slab * (position - origin)
            top = top_along(n_world, world, entity, geometry, poses, patches) - wp.dot(n_world, origin)
            if top > half[2] + wp.static(FACE_HORIZON) * geometry[0].radius[own]:
                seen = 1
            if patches[0].first_face[entity] < 0:
                # Bodies with a shape of their own draw the texels to where they are, those far away hardly.
                u = p[(axis + 1) % 3] - part[0]
                v = p[(axis + 2) % 3] - part[2]
                x = wp.clamp(u, -part[1], part[1])
                y = wp.clamp(v, -part[3], part[3])
                squared = geometry[0].radius[entity] * geometry[0].radius[entity]
                away = wp.length_sq(wp.vec3(u - x, v - y, wp.max(wp.dot(n, p) - half[2], 0.0)))
                pull = squared / (squared + away)
                spread = wp.static(SPREAD_PER_RADIUS * SPREAD_PER_RADIUS) * squared
                count += pull
                mean += pull * wp.vec2(x, y)
                squares += pull * wp.vec2(x * x + spread, y * y + spread)
    # The sides of a rectangle have no area, nor has what is enclosed.
    patches[0].seen[world, face] = wp.where(part[1] * part[3] > 0.0, seen, 0)
    mean = mean / count
    patches[0].focus[world, face] = wp.vec4(
        mean[0],
        wp.sqrt(wp.max(squares[0] / count - mean[0] * mean[0], 1.0e-12)),
        mean[1],
        wp.sqrt(wp.max(squares[1] / count - mean[1] * mean[1], 1.0e-12)),
    )


@wp.kernel(enable_backward=False, module="unique")
def _place_texels(first: int, poses: PoseTables, patches: PatchTables, first_proxy: int, proxies: ReceiverTable):
    world, texel = wp.tid()
    texel += first
    face = patches[0].texel_face[texel]
    entity = patches[0].entity[face]
    axis = patches[0].axis[face]
    half = patches[0].half[face]
    size = patches[0].size[face]
    part = patches[0].part[world, face]
    focus = patches[0].focus[world, face]
    index = texel - patches[0].first_texel[face]
    x = part[0] + texel_center(index % size[0], size[0], part[1], focus[0], focus[1])
    y = part[2] + texel_center(index / size[0], size[1], part[3], focus[2], focus[3])
    n = patches[0].side[face] * axis_vector(axis)
    p = x * axis_vector((axis + 1) % 3) + y * axis_vector((axis + 2) % 3) + half[2] * n
    to_world = wp.transpose(slab_from_world(world, entity, poses, patches))
    proxy = first_proxy + texel
    # Nothing sees the light of a face above which nothing rises.
    proxies.entity[world, proxy] = wp.where(patches[0].seen[world, face] == 1, entity, -1)
    proxies.position[world, proxy] = slab_origin(world, entity, poses, patches) + to_world * p
    proxies.normal[world, proxy] = to_world * n


def upload_patches(scene: Scene, is_patch: list[bool], occlusion: OcclusionState, worlds: int, device: wp.Device):
    """The faces of those entities for which `is_patch` holds; all of them must be slabs."""
    occluders = occlusion.table.occluders
    table = PatchTable()
    table.center, table.rotation = occluders.slab_center, occluders.slab_rotation
    table.slab_half, table.opacity = occluders.slab_half, occluders.opacity
    chosen = [entity for entity, flat in enumerate(is_patch) if flat]
    halves = {entity: np.asarray(_slab_half(scene, entity), np.float64) for entity in chosen}
    limits = _share_texels(halves)
    first_face, faces, halved, sizes = np.full(len(is_patch), -1), [], [], []
    for entity in chosen:
        first_face[entity] = len(faces)
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            faces += [(entity, axis, 1.0), (entity, axis, -1.0)]
            size = _face_size(halves[entity][[u, v]], halves[entity].max(), limits[entity])
            sizes += [size, size]
            halved += [halves[entity][[u, v, axis]]] * 2
    sizes = np.array(sizes, np.int64).reshape(-1, 2)
    texels, levels = sizes.prod(axis=1), np.log2(sizes.max(axis=1, initial=1)).astype(np.int64) + 1
    places = [
        int(sum(max(w >> level, 1) * max(h >> level, 1) for level in range(count)))
        for (w, h), count in zip(sizes, levels, strict=True)
    ]

    def upload(values, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    table.first_face = upload(first_face, wp.int32)
    table.entity = upload([face[0] for face in faces], wp.int32)
    table.axis = upload([face[1] for face in faces], wp.int32)
    table.side = upload([face[2] for face in faces], wp.float32)
    table.half = upload(np.array(halved).reshape(-1, 3), wp.vec3)
    table.size = upload(sizes, wp.vec2i)
    table.first_texel = upload(np.cumsum(texels) - texels, wp.int32)
    table.first = upload(np.cumsum(places) - places, wp.int32)
    table.levels = upload(levels, wp.int32)
    table.texel_face = upload(np.repeat(np.arange(len(faces)), texels), wp.int32)
    table.part = wp.zeros((worlds, len(faces)), dtype=wp.vec4, device=device)
    table.focus = wp.zeros((worlds, len(faces)), dtype=wp.vec4, device=device)
    table.seen = wp.zeros((worlds, len(faces)), dtype=wp.int32, device=device)
    table.openness = wp.full((worlds, int(texels.sum())), 1.0, dtype=wp.float32, device=device)
    table.radiance = wp.zeros((worlds, sum(places)), dtype=wp.vec4, device=device)
    stations = [start + _block_centers(size) for start, size in zip(np.cumsum(texels) - texels, sizes, strict=True)]
    counts = np.array([len(centers) for centers in stations], np.int64)
    table.first_station = upload(np.cumsum(counts) - counts, wp.int32)
    table.station_openness = wp.full((worlds, int(counts.sum())), 1.0, dtype=wp.float32, device=device)
    table.gathered = wp.zeros((worlds, int(counts.sum())), dtype=wp.vec3, device=device)
    return Patches(
        table,
        upload_tables([table], PatchTable, device),
        int(texels.sum()),
        np.concatenate([np.zeros(0, np.int64), *stations]),
    )


def place_texels(
    patches: Patches, scene: DeviceScene, proxies: ReceiverTable, first_proxy: int, device: wp.Device
) -> None:
    """Puts the texels where the bodies need them and makes proxies of them, from `first_proxy` on."""
    shape = patches.table.focus.shape
    launch(_focus_faces, shape, [scene.geometry, scene.poses, patches.tables], [], device)
    inputs = [scene.poses, patches.tables, first_proxy, proxies]
    launch(_place_texels, (shape[0], patches.texels), inputs, [], device)


def _block_centers(size: np.ndarray) -> np.ndarray:
    """The middle texel of each block of a face."""
    across, down = np.minimum(np.maximum(BLOCK, size // BLOCKS_PER_SIDE), size)
    x, y = np.arange(across // 2, size[0], across), np.arange(down // 2, size[1], down)
    return (y[:, None] * size[0] + x).ravel()


def _slab_half(scene: Scene, entity: int) -> np.ndarray:
    slab = scene.meshes[scene.entities[entity].mesh].slab
    if slab is None:
        raise ValueError(f"{scene.entities[entity].name} is not a slab; only boxes and rectangles have faces")
    return slab[2]


def _share_texels(halves: dict[int, np.ndarray]) -> dict[int, int]:
    """How many texels the longest side of each slab gets: the smallest slabs give up theirs until all fit."""
    limits = dict.fromkeys(halves, MOST_TEXELS_PER_SIDE)

    def count(entity: int) -> int:
        half = halves[entity]
        sides = [_face_size(half[[u, v]], half.max(), limits[entity]) for u, v in ((1, 2), (2, 0), (0, 1))]
        return sum(2 * a * b for a, b in sides)

    while sum(map(count, limits)) > MOST_TEXELS:
        finest = max(limits.values())
        if finest == FEWEST_TEXELS_PER_SIDE:
            break
        smallest = min(
            (entity for entity in limits if limits[entity] == finest), key=lambda entity: halves[entity].max()
        )
        limits[smallest] //= 2
    return limits


def _face_size(sides: np.ndarray, longest: float, limit: int) -> tuple[int, int]:
    wanted = limit * sides / longest
    powers = 2 ** np.ceil(np.log2(np.maximum(wanted, 1.0) * (1 - 1e-9))).astype(int)
    width, height = np.clip(powers, min(FEWEST_TEXELS_PER_SIDE, limit), limit)
    return int(width), int(height)

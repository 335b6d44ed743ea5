"""The texels' light, filtered level by level, for those who look at a face from afar or over a wide angle.

What a body stands on is dark and hidden by that same body. Band-limited functions do not tell that sharply: they would
see some of the dark below the body in place of the light beside it. So hidden texels take the light of their
surroundings: up the pyramid as means of what is seen, down again into the places that are not.
"""

import warp as wp

from warp_psf.device import launch
from warp_psf.shade.patches import Patches, PatchTables

# A texel counts as seen when this share of its hemisphere is open, less so below, and never for nothing.
SEEN_OPENNESS = 0.5
LEAST_SEEN = 0.01


@wp.func
def average_seen(a: wp.vec4, b: wp.vec4, c: wp.vec4, d: wp.vec4) -> wp.vec4:
    """The mean of four texels, each counted as far as it is seen."""
    seen = a[3] + b[3] + c[3] + d[3]
    mean = (a[3] * a + b[3] * b + c[3] * c + d[3] * d) / wp.max(seen, 1.0e-9)
    return wp.vec4(mean[0], mean[1], mean[2], 0.25 * seen)


@wp.func
def place_of(texel: int, patches: PatchTables) -> int:
    """Where a texel lies in the finest level of its face's pyramid."""
    face = patches[0].texel_face[texel]
    return patches[0].first[face] + texel - patches[0].first_texel[face]


@wp.func
def mix_hidden(
    world: int,
    start: int,
    above: int,
    index: int,
    width: int,
    height: int,
    above_width: int,
    above_height: int,
    patches: PatchTables,
):
    """Gives a place of a level, so far as it is hidden, the light of the level above."""
    own = patches[0].radiance[world, start + index]
    x = (index % width) * above_width / width
    y = (index / width) * above_height / height
    around = patches[0].radiance[world, above + y * above_width + x]
    mixed = own[3] * own + (1.0 - own[3]) * around
    patches[0].radiance[world, start + index] = wp.vec4(mixed[0], mixed[1], mixed[2], own[3])


@wp.kernel(enable_backward=False, module="unique")
def _take_over(
    first: int,
    radiance: wp.array2d(dtype=wp.vec3),  # (world, proxy)
    first_proxy: int,
    patches: PatchTables,
):
    world, texel = wp.tid()
    texel += first
    if patches[0].seen[world, patches[0].texel_face[texel]] == 0:
        return
    color = radiance[world, first_proxy + texel]
    seen = wp.clamp(patches[0].openness[world, texel] / wp.static(SEEN_OPENNESS), wp.static(LEAST_SEEN), 1.0)
    patches[0].radiance[world, place_of(texel, patches)] = wp.vec4(color[0], color[1], color[2], seen)


@wp.kernel(enable_backward=False, module="unique")
def _filter_faces(first: int, patches: PatchTables):
    world, face = wp.tid()
    face += first
    if patches[0].seen[world, face] == 0:
        return
    size = patches[0].size[face]
    start = patches[0].first[face]
    levels = patches[0].levels[face]
    for level in range(1, levels):
        below = wp.vec2i(wp.max(size[0] >> (level - 1), 1), wp.max(size[1] >> (level - 1), 1))
        width = wp.max(size[0] >> level, 1)
        height = wp.max(size[1] >> level, 1)
        # A side that has one texel left is no longer halved.
        step_x = below[0] / width - 1
        step_y = below[1] / height - 1
        above = start + below[0] * below[1]
        for index in range(width * height):
            a = start + (index / width) * (1 + step_y) * below[0] + (index % width) * (1 + step_x)
            b = a + step_y * below[0]
            patches[0].radiance[world, above + index] = average_seen(
                patches[0].radiance[world, a],
                patches[0].radiance[world, a + step_x],
                patches[0].radiance[world, b],
                patches[0].radiance[world, b + step_x],
            )
        start = above
    # The finest level, which is most of the work, is left to `_mix_finest`.
    for turn in range(1, levels - 1):
        level = levels - 1 - turn
        width = wp.max(size[0] >> level, 1)
        height = wp.max(size[1] >> level, 1)
        above = start
        above_width = wp.max(size[0] >> (level + 1), 1)
        above_height = wp.max(size[1] >> (level + 1), 1)
        start = above - width * height
        for index in range(width * height):
            mix_hidden(world, start, above, index, width, height, above_width, above_height, patches)


@wp.kernel(enable_backward=False, module="unique")
def _mix_finest(first: int, patches: PatchTables):
    world, texel = wp.tid()
    texel += first
    face = patches[0].texel_face[texel]
    if patches[0].seen[world, face] == 0 or patches[0].levels[face] < 2:
        return
    size = patches[0].size[face]
    start = patches[0].first[face]
    index = texel - patches[0].first_texel[face]
    above = start + size[0] * size[1]
    half = wp.vec2i(wp.max(size[0] / 2, 1), wp.max(size[1] / 2, 1))
    mix_hidden(world, start, above, index, size[0], size[1], half[0], half[1], patches)


def build_pyramids(patches: Patches, radiance: wp.array, first_proxy: int, device: wp.Device) -> None:
    """Takes over the radiance of the proxies, vec3 (world, proxy), and filters it."""
    worlds, faces = patches.table.focus.shape
    launch(_take_over, (worlds, patches.texels), [radiance, first_proxy, patches.tables], [], device)
    launch(_filter_faces, (worlds, faces), [patches.tables], [], device)
    launch(_mix_finest, (worlds, patches.texels), [patches.tables], [], device)

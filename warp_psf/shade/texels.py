"""Direct light on the texels of slabs: at every second one, and at those between that do not lie in even light."""

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.scene.receiver import ReceiverTable, in_use
from warp_psf.shade.patches import Patches, PatchTables

# A proxy's turn to be lit: GLOSSY ones are lit by `gloss.py`; texels that lie BETWEEN coarse ones are mixed from them,
# or get the FINE turn.
GLOSSY, COARSE, FINE, BETWEEN = 0, 1, 2, 3
# Along shorter sides of a face every texel is lit.
FEWEST_TO_SKIP = 8
# Texels around which light differs by no more than this share lie in even light: what is mixed is off by a part of it.
UNLIKE = 0.2


@wp.func
def coarse_around(place: int, count: int):
    """The coarse texels before and after a place along a side of `count` texels: itself, twice, where it is one."""
    if count < wp.static(FEWEST_TO_SKIP) or place % 2 == 0 or place == count - 1:
        return place, place
    return place - 1, place + 1


@wp.kernel(enable_backward=False, module="unique")
def _refine_texels(
    first: int,
    patches: PatchTables,
    proxies: ReceiverTable,
    first_texel: int,
    turns: wp.array2d(dtype=wp.int32),  # (world, proxy)
    diffuse: wp.array2d(dtype=wp.vec3),  # (world, proxy)
    glossy: wp.array2d(dtype=wp.vec3),  # (world, proxy)
):
    world, texel = wp.tid()
    texel += first
    proxy = first_texel + texel
    if turns[world, proxy] == wp.static(COARSE) or proxies.entity[world, proxy] < 0:
        return
    face = patches[0].texel_face[texel]
    size = patches[0].size[face]
    start = first_texel + patches[0].first_texel[face]
    left, right = coarse_around((proxy - start) % size[0], size[0])
    above, below = coarse_around((proxy - start) / size[0], size[1])
    a = start + above * size[0] + left
    b = start + above * size[0] + right
    c = start + below * size[0] + left
    d = start + below * size[0] + right
    highest = wp.max(wp.max(diffuse[world, a], diffuse[world, b]), wp.max(diffuse[world, c], diffuse[world, d]))
    lowest = wp.min(wp.min(diffuse[world, a], diffuse[world, b]), wp.min(diffuse[world, c], diffuse[world, d]))
    if wp.max(highest - lowest) > wp.static(UNLIKE) * wp.max(highest):
        turns[world, proxy] = wp.static(FINE)
        return
    turns[world, proxy] = wp.static(BETWEEN)
    diffuse[world, proxy] = 0.25 * (diffuse[world, a] + diffuse[world, b] + diffuse[world, c] + diffuse[world, d])
    glossy[world, proxy] = 0.25 * (glossy[world, a] + glossy[world, b] + glossy[world, c] + glossy[world, d])


def first_turns(patches: Patches) -> np.ndarray:
    """The turn of each texel before any is refined, int32 [texels]."""
    turns = [np.zeros(0, np.int32)]
    for width, height in patches.table.size.numpy():
        x, y = (_is_coarse(int(count)) for count in (width, height))
        turns.append(np.where(y[:, None] & x, COARSE, BETWEEN).ravel())
    return np.concatenate(turns).astype(np.int32)


def _is_coarse(count: int) -> np.ndarray:
    places = np.arange(count)
    return (places % 2 == 0) | (places == count - 1) | (count < FEWEST_TO_SKIP)


def refine_texels(
    patches: Patches,
    first_texel: int,
    proxies: ReceiverTable,
    turns: wp.array,
    diffuse: wp.array,
    glossy: wp.array,
    device: wp.Device,
) -> None:
    """Mixes the light of texels in even light from the coarse ones around them, and gives the others their turn."""
    dim = (in_use(proxies)[0], patches.texels)
    launch(_refine_texels, dim, [patches.tables, proxies, first_texel, turns, diffuse, glossy], [], device)

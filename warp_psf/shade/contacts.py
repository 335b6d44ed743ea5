"""Contacts: where bodies touch on the film, receivers look at the sky themselves, as probes are too far apart there."""

import warp as wp

from warp_psf.scene.receiver import ReceiverTable

# Beside a contact the sky's light has a kink that no probe would find. So receivers on edges between two bodies that
# are within so many pixels of one another in depth look at the sky themselves, and where that differs from what probes
# say by more than a share, those so many pixels around on the same body do.
CONTACT_REACH = 40
KINKED, KINK_REACH = 0.1, 2
BY_PROBES, ON_CONTACT, BESIDE_KINK = 0, 1, 2


@wp.func
def touches(receivers: ReceiverTable, world: int, pixel: int, other: int, pixel_size: wp.vec2) -> bool:
    """Whether two neighbouring pixels see two bodies that are near one another."""
    entity = receivers.entity[world, other]
    if entity < 0 or entity == receivers.entity[world, pixel]:
        return False
    apart = wp.abs(receivers.depth[world, other] - receivers.depth[world, pixel])
    size = pixel_size[0] + pixel_size[1] * receivers.depth[world, pixel]
    return apart < wp.static(float(CONTACT_REACH)) * size


@wp.kernel(enable_backward=False, module="unique")
def settle_contacts(
    first: int,
    receivers: ReceiverTable,
    pixel_of: wp.array2d(dtype=wp.int32),  # (world, slot)
    width: int,
    seen: wp.array2d(dtype=wp.vec3),  # (world, slot): irradiance that receivers on contacts found themselves
    seen_glossy: wp.array2d(dtype=wp.vec3),  # (world, slot)
    looks_up: wp.array2d(dtype=wp.int32),  # (world, slot)
    diffuse: wp.array2d(dtype=wp.vec3),  # (world, slot): from probes; receivers on contacts get their own
    glossy: wp.array2d(dtype=wp.vec3),  # (world, slot)
):
    world, slot = wp.tid()
    slot += first
    if looks_up[world, slot] != wp.static(ON_CONTACT) or receivers.entity[world, slot] < 0:
        return
    own = seen[world, slot]
    difference = wp.max(wp.abs(own - diffuse[world, slot]))
    diffuse[world, slot] = own
    glossy[world, slot] = seen_glossy[world, slot]
    if difference <= wp.static(KINKED) * wp.max(own):
        return
    pixel = pixel_of[world, slot]
    x = pixel % width
    y = pixel / width
    pixels = pixel_of.shape[1]
    for row in range(wp.max(y - wp.static(KINK_REACH), 0), y + wp.static(KINK_REACH + 1)):
        for column in range(wp.max(x - wp.static(KINK_REACH), 0), wp.min(x + wp.static(KINK_REACH + 1), width)):
            near = row * width + column
            if near < pixels:
                if pixel_of[world, near] == near and looks_up[world, near] == wp.static(BY_PROBES):
                    if receivers.entity[world, near] == receivers.entity[world, slot]:
                        looks_up[world, near] = wp.static(BESIDE_KINK)

"""Receivers: the points that are shaded, be they what pixels see or vertices."""

import warp as wp


@wp.struct
class ReceiverTable:
    """Points to be shaded: slots (world, slot); an entity of -1 is an empty slot."""

    entity: wp.array2d(dtype=wp.int32)
    face: wp.array2d(dtype=wp.int32)  # of the entity's mesh
    uv: wp.array2d(dtype=wp.vec2)  # weights of the face's first two vertices
    position: wp.array2d(dtype=wp.vec3)  # world, metres
    normal: wp.array2d(dtype=wp.vec3)  # world, unit; a pixel's is turned towards the viewer
    depth: wp.array2d(dtype=wp.float32)  # metres along the optical axis
    weight: wp.array2d(dtype=wp.float32)  # share of its pixel
    count: wp.int32  # slots of each world that are in use, the first ones


def make_receivers(shape: tuple[int, int], device: wp.Device) -> ReceiverTable:
    """Room for receivers: (worlds, slots)."""
    receivers = ReceiverTable()
    receivers.entity = wp.zeros(shape, dtype=wp.int32, device=device)
    receivers.face = wp.zeros(shape, dtype=wp.int32, device=device)
    receivers.uv = wp.zeros(shape, dtype=wp.vec2, device=device)
    receivers.position = wp.zeros(shape, dtype=wp.vec3, device=device)
    receivers.normal = wp.zeros(shape, dtype=wp.vec3, device=device)
    receivers.depth = wp.zeros(shape, dtype=wp.float32, device=device)
    receivers.weight = wp.zeros(shape, dtype=wp.float32, device=device)
    receivers.count = shape[1]
    return receivers


def in_use(receivers: ReceiverTable) -> tuple[int, int]:
    """Worlds, and the slots of each that are in use."""
    return receivers.entity.shape[0], receivers.count

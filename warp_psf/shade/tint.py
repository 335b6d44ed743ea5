"""What textures multiply the colours of proxies with: red tiles send on red light."""

import warp as wp

from warp_psf.basis import sphere
from warp_psf.device import launch
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, part_of
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.scene.texture import Wrap
from warp_psf.scene.tint import TextureTable, tint_of
from warp_psf.shade.bounce import BounceState
from warp_psf.shade.patches import PatchTables, axis_vector, slab_from_world, texel_center


@wp.func
def texel_sides(world: int, texel: int, poses: PoseTables, patches: PatchTables):
    """The two sides of a texel of a slab's face, in the world."""
    face = patches[0].texel_face[texel]
    size = patches[0].size[face]
    part = patches[0].part[world, face]
    focus = patches[0].focus[world, face]
    index = texel - patches[0].first_texel[face]
    u = index % size[0]
    v = index / size[0]
    across = texel_center(u + 1, size[0], part[1], focus[0], focus[1])
    across -= texel_center(u, size[0], part[1], focus[0], focus[1])
    down = texel_center(v + 1, size[1], part[3], focus[2], focus[3])
    down -= texel_center(v, size[1], part[3], focus[2], focus[3])
    to_world = wp.transpose(slab_from_world(world, patches[0].entity[face], poses, patches))
    axis = patches[0].axis[face]
    return to_world * (across * axis_vector((axis + 1) % 3)), to_world * (down * axis_vector((axis + 2) % 3))


@wp.kernel(enable_backward=False, module="unique")
def _tint_proxies(
    first: int,
    proxies: ReceiverTable,
    geometry: GeometryTables,
    poses: PoseTables,
    patches: PatchTables,
    textures: TextureTable,
    spacing: wp.array(dtype=wp.float32),  # (body proxy), metres
    tint_out: wp.array2d(dtype=wp.vec3),  # (world, proxy)
):
    world, proxy = wp.tid()
    proxy += first
    entity = proxies.entity[world, proxy]
    if entity < 0:
        return
    of_body = proxy < spacing.shape[0]
    face = proxies.face[world, proxy]
    part = part_of(geometry, entity, face)
    if textures.texture[part] >= 0:
        to_entity = wp.transpose(poses[0].rotation[world, entity])
        p_entity = to_entity * (proxies.position[world, proxy] - poses[0].position[world, entity])
        if textures.wrap[part] == wp.static(int(Wrap.GIVEN)):
            # Texels have no face, and proxies of convex bodies those of a finer mesh.
            mesh = geometry[0].mesh_id[geometry[0].entity_mesh[entity]]
            found = wp.mesh_query_point_no_sign(mesh, p_entity, geometry[0].radius[entity])
            face = wp.where(found.result, found.face, 0)
        frame = sphere.frame_of(proxies.normal[world, proxy])
        across = frame * wp.vec3(1.0, 0.0, 0.0)
        down = frame * wp.vec3(0.0, 1.0, 0.0)
        if of_body:
            across *= spacing[proxy]
            down *= spacing[proxy]
        else:
            across, down = texel_sides(world, proxy - spacing.shape[0], poses, patches)
        tint_out[world, proxy] = tint_of(
            textures,
            geometry,
            entity,
            part,
            face,
            p_entity,
            to_entity * proxies.normal[world, proxy],
            to_entity * across,
            to_entity * down,
        )


def tint_proxies(state: BounceState, scene: DeviceScene, textures: TextureTable, device: wp.Device) -> None:
    """Writes `state.tint` for the proxies as they are placed; without textures it stays 1."""
    if textures.levels.shape[0] == 0:
        return
    inputs = [state.proxies, scene.geometry, scene.poses, state.patches.tables, textures, state.spacing]
    launch(_tint_proxies, state.tint.shape, inputs, [state.tint], device)

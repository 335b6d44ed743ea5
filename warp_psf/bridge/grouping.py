"""Which geoms of one body make up one shape together: a link of a robot is often a dozen meshes of many colours."""

from __future__ import annotations

from collections import defaultdict

import mujoco
import numpy as np

from warp_psf.bridge.shapes import MESHES
from warp_psf.bridge.shown import OPAQUE, Shown

# A geom joins others when the sphere around all of them is no larger than this many times the largest one's: shells
# around a body serve what is about as large as the body, and not a hall with its furniture.
MOST_GROWTH = 1.5


def group_geoms(model: mujoco.MjModel, shown: Shown) -> list[tuple[int, ...]]:
    """The shown geoms, each alone or with the others of its body that it makes up one shape with, in the model's order.

    Only opaque meshes with the same lobe are put together: primitives have closed forms, which are faster and more
    exact than any field.
    """
    candidates: dict[tuple, list[int]] = defaultdict(list)
    for geom in shown.geoms:
        if mujoco.mjtGeom(model.geom_type[geom]) in MESHES and shown.geom_rgba[geom, 3] >= OPAQUE:
            candidates[int(model.geom_bodyid[geom]), *_lobe(model, geom)].append(geom)
    leader: dict[int, int] = {}
    members: dict[int, list[int]] = {}
    for geoms in candidates.values():
        for group in _cluster(model, geoms):
            members[min(group)] = sorted(group)
            leader |= dict.fromkeys(group, min(group))
    return [tuple(members.get(geom, [geom])) for geom in shown.geoms if leader.get(geom, geom) == geom]


def _lobe(model: mujoco.MjModel, geom: int) -> tuple:
    """What the lobe of a geom is made from; a metal's has the colour of the geom."""
    material = int(model.geom_matid[geom])
    if material < 0:
        return ()
    metal = float(model.mat_metallic[material]) if hasattr(model, "mat_metallic") else -1.0
    rough = float(model.mat_roughness[material]) if hasattr(model, "mat_roughness") else -1.0
    own = material if metal > 0.0 else -1
    return float(model.mat_specular[material]), float(model.mat_shininess[material]), metal, rough, own


def _cluster(model: mujoco.MjModel, geoms: list[int]) -> list[list[int]]:
    """Geoms of one body in clusters that grow from the largest on."""
    order = sorted(geoms, key=lambda geom: (-model.geom_rbound[geom], geom))
    clusters: list[list[int]] = []
    spheres: list[tuple[np.ndarray, float, float]] = []
    for geom in order:
        center, radius = np.array(model.geom_pos[geom], np.float64), float(model.geom_rbound[geom])
        for place, (middle, around, largest) in enumerate(spheres):
            joint = _enclose(middle, around, center, radius)
            if joint[1] <= MOST_GROWTH * largest:
                clusters[place].append(geom)
                spheres[place] = (*joint, largest)
                break
        else:
            clusters.append([geom])
            spheres.append((center, radius, radius))
    return clusters


def _enclose(a: np.ndarray, a_radius: float, b: np.ndarray, b_radius: float) -> tuple[np.ndarray, float]:
    """The smallest sphere around two spheres."""
    apart = float(np.linalg.norm(b - a))
    if apart + b_radius <= a_radius:
        return a, a_radius
    if apart + a_radius <= b_radius:
        return b, b_radius
    radius = 0.5 * (apart + a_radius + b_radius)
    return a + (radius - a_radius) / apart * (b - a), radius

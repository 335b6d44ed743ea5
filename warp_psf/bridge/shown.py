"""What a model shows: which geoms and sites the options of MuJoCo's visualiser leave, and how opaque they are."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

# The colour by which MuJoCo knows that a geom has none of its own, so that its material's counts.
NO_COLOR = np.array((0.5, 0.5, 0.5, 1.0), dtype=np.float32)
# MuJoCo draws what is more opaque than this as if it were opaque.
OPAQUE = 0.995
FLAG = mujoco.mjtVisFlag
# Everything that the shapes and looks of a scene are built from. Whoever changes one of these in a model that is being
# rendered (domain randomisation) sees the change in the next frame.
LOOKS = (
    *("geom_type", "geom_dataid", "geom_group", "geom_matid", "geom_rgba", "geom_size", "geom_pos", "geom_quat"),
    *("site_type", "site_group", "site_matid", "site_rgba", "site_size"),
    *("flex_group", "flex_matid", "flex_rgba", "flex_radius", "flex_flatskin", "flex_texcoord"),
    *("skin_group", "skin_matid", "skin_rgba", "skin_inflate", "skin_texcoord"),
    *("mat_rgba", "mat_emission", "mat_specular", "mat_shininess", "mat_texid", "mat_texrepeat", "mat_texuniform"),
    *("mat_metallic", "mat_roughness", "mat_reflectance"),
    *("light_type", "light_diffuse", "light_specular", "light_ambient", "light_attenuation", "light_cutoff"),
    *("light_exponent", "light_bulbradius", "light_castshadow", "light_range", "light_texid"),
)


FLEX_FLAGS = (FLAG.mjVIS_FLEXVERT, FLAG.mjVIS_FLEXEDGE, FLAG.mjVIS_FLEXFACE, FLAG.mjVIS_FLEXSKIN)


@dataclass(frozen=True)
class Shown:
    """What is drawn.

    geoms, sites, flexes, skins: ids, in order.
    geom_rgba, site_rgba, flex_rgba, skin_rgba: the colours and alphas of all of the model's as they are drawn, float32
        [ngeom, nsite, nflex or nskin, 4].
    textured: whether textures show.
    """

    geoms: tuple[int, ...]
    sites: tuple[int, ...]
    flexes: tuple[int, ...]
    skins: tuple[int, ...]
    geom_rgba: np.ndarray
    site_rgba: np.ndarray
    flex_rgba: np.ndarray
    skin_rgba: np.ndarray
    textured: bool


def find_shown(model: mujoco.MjModel, option: mujoco.MjvOption) -> Shown:
    """What `option` shows of a model, by the rules of MuJoCo's visualiser; see-through bodies stay separate bodies."""
    geom_rgba = _colors(model, model.geom_rgba, model.geom_matid)
    site_rgba = _colors(model, model.site_rgba, model.site_matid)
    flex_rgba = _colors(model, model.flex_rgba, flex_materials(model))
    skin_rgba = _colors(model, model.skin_rgba, model.skin_matid)
    static_geoms, static_sites = (model.body_weldid[body] == 0 for body in (model.geom_bodyid, model.site_bodyid))
    if option.flags[FLAG.mjVIS_TRANSPARENT]:
        geom_rgba[~static_geoms, 3] *= model.vis.map.alpha
        site_rgba[~static_sites, 3] *= model.vis.map.alpha
        # Whatever these hang on, they count as moving.
        flex_rgba[:, 3] *= model.vis.map.alpha
        skin_rgba[:, 3] *= model.vis.map.alpha
    geoms = _in_groups(model.geom_group, option.geomgroup) & (geom_rgba[:, 3] > 0.0)
    sites = _in_groups(model.site_group, option.sitegroup) & (site_rgba[:, 3] > 0.0)
    if not option.flags[FLAG.mjVIS_STATIC]:
        geoms, sites = geoms & ~static_geoms, sites & ~static_sites
    flexes = _in_groups(model.flex_group, option.flexgroup) & (flex_rgba[:, 3] > 0.0) & any(_flags(option, FLEX_FLAGS))
    skins = _in_groups(model.skin_group, option.skingroup) & (skin_rgba[:, 3] > 0.0) & option.flags[FLAG.mjVIS_SKIN]
    ids = (tuple(map(int, np.flatnonzero(mask))) for mask in (geoms, sites, flexes, skins))
    return Shown(*ids, geom_rgba, site_rgba, flex_rgba, skin_rgba, bool(option.flags[FLAG.mjVIS_TEXTURE]))


def flex_materials(model: mujoco.MjModel) -> np.ndarray:
    """The material of each flex, -1 for none: since MuJoCo 4 that of its first element."""
    if len(model.flex_matid) == model.nflex:
        return model.flex_matid
    return model.flex_matid[model.flex_elemadr]


def looks(model: mujoco.MjModel, option: mujoco.MjvOption) -> bytes:
    """Equal for as long as `build_scene` and `meet_deforming` would build the same of a model being rendered."""
    arrays = [getattr(model, name) for name in LOOKS if hasattr(model, name)]
    choices = [option.geomgroup, option.sitegroup]
    choices.append(_flags(option, (FLAG.mjVIS_TRANSPARENT, FLAG.mjVIS_STATIC, FLAG.mjVIS_TEXTURE)))
    if model.nflex > 0:
        choices += [option.flexgroup, _flags(option, FLEX_FLAGS), option.flex_layer]
    if model.nskin > 0:
        choices += [option.skingroup, _flags(option, (FLAG.mjVIS_SKIN,))]
    head = model.vis.headlight
    heads = (head.active, head.diffuse, head.specular, head.ambient)
    return b"".join(np.asarray(array).tobytes() for array in (*arrays, *heads, *choices))


def _flags(option: mujoco.MjvOption, flags: tuple[mujoco.mjtVisFlag, ...]) -> list[bool]:
    return [bool(option.flags[flag]) for flag in flags]


def _colors(model: mujoco.MjModel, own: np.ndarray, material: np.ndarray) -> np.ndarray:
    """The rgba of each object: its own, unless that is the default and it has a material (MuJoCo's setMaterial)."""
    colors = np.array(own, np.float32).reshape(-1, 4)
    plain = (colors == NO_COLOR).all(axis=1) & (np.asarray(material) >= 0)
    colors[plain] = model.mat_rgba[np.asarray(material)[plain]]
    return colors


def _in_groups(group: np.ndarray, shown: np.ndarray) -> np.ndarray:
    return np.asarray(shown, bool)[np.clip(group, 0, mujoco.mjNGROUP - 1)]

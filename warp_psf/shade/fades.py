"""How far an occluder matters: what small, low or far ones take from a receiver fades out, so that nothing pops."""

import warp as wp

# An occluder whose bounding sphere could take less than this share of a diffuse receiver's light is left out: seen
# face-on a sphere of radius R at distance d takes (R/d)^2. It fades in up to twice the share, so that nothing pops.
SMALLEST_SHARE = 1.0e-3
# A body whose bounding sphere lies below the receiver's horizon is left out too: what band-limited functions let
# through there is not real. It fades in as it rises by this share of its radius; slabs have a horizon of their own.
HORIZON_FADE = 0.6
# What can stand between a receiver and a light and what cannot is told by planes: of a slab's faces, when both lie
# before one, and of a flat light, when an occluder lies behind it. At a plane occluders fade over this share of the
# light's radius.
LIGHT_FADE = 0.25


@wp.struct
class Light:
    """An area light, for telling what is nearer."""

    center: wp.vec3  # of its bounding sphere, in the world
    radius: wp.float32  # of that, metres; below 0 where no light is asked for
    facing: wp.vec3  # the side to which a flat light shines, in the world; zero for others


@wp.func
def size_fade(radius: float, squared: float) -> float:
    """0 for a sphere that is too small to matter at a squared distance, 1 for one that is twice as large in area."""
    return wp.clamp(radius * radius / wp.max(squared, 1.0e-12) / wp.static(SMALLEST_SHARE) - 1.0, 0.0, 1.0)


@wp.func
def horizon_fade(height: float, radius: float) -> float:
    """0 for a sphere below the horizon, 1 for one that has risen; height: of its centre above the horizon."""
    risen = wp.clamp((height + radius) / (wp.static(HORIZON_FADE) * radius), 0.0, 1.0)
    return risen * risen * (3.0 - 2.0 * risen)


@wp.func
def fade_length(light: Light) -> float:
    """Over which length occluders fade at a light's plane, metres."""
    return wp.max(wp.static(LIGHT_FADE) * light.radius, 1.0e-9)


@wp.func
def before_plane(ahead: float, light: Light) -> float:
    """How far an occluder that reaches `ahead` metres beyond a flat light's plane stands before it, 1 for other lights.

    Nothing behind that plane stands in its way, however near it is: a ceiling above a lamp. What comes out from behind
    fades in.
    """
    if wp.length_sq(light.facing) > 0.0:
        return wp.clamp(ahead / fade_length(light), 0.0, 1.0)
    return 1.0


@wp.func
def sphere_nearness(p: wp.vec3, center: wp.vec3, radius: float, light: Light) -> float:
    """How far a sphere is nearer to p than a light: 1 in front of it, 0 behind it, smooth between."""
    further = wp.length(light.center - p) - wp.length(center - p)
    apart = wp.clamp(0.5 + further / wp.max(light.radius + radius, 1.0e-9), 0.0, 1.0)
    return apart * before_plane(wp.dot(light.facing, center - light.center) + radius, light)

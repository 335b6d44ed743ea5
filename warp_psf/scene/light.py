"""Lights: meshes that shine, and the lights without an extent that MJCF describes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from warp_psf.scene.mesh import Mesh
from warp_psf.scene.primitives import plane, sphere

if TYPE_CHECKING:
    from warp_psf.scene.scene import Scene

# R R^T may differ from the identity by this much: float32 matrices and printed decimals pass, a skewed one does not.
ORTHONORMAL_TOLERANCE = 1e-4
# Shorter than this (metres) a direction to a target, or a side of a rectangle, has no usable length.
SHORTEST_LENGTH = 1e-9


@dataclass(frozen=True, eq=False)
class AreaLight:
    """A mesh that shines with the same radiance in every direction from the front of every face.

    `rectangle_light` and `sphere_light` make the usual ones.

    ```python
    mesh = psf.load_mesh("mesh.obj")
    light = psf.AreaLight("glowing body", mesh, radiance=(4, 3, 2), position=(0, 0, 2))
    ```

    Attributes:
        name: what messages call it.
        mesh: its shape, in the light's own frame.
        radiance: linear Rec.709, float64 [3], finite and not negative.
        position: of the light's frame in its parent's, metres, float64 [3].
        rotation: parent_from_light rotation matrix, float64 [3, 3].
        body: name of the MuJoCo body that is the parent, so that the light moves with the simulation; None is the
            world.

    Raises:
        ValueError: a value is NaN or infinite, a radiance is negative, an array has another shape, or `rotation` is not
            a rotation.
        TypeError: `mesh` is not a `Mesh`.
    """

    name: str
    mesh: Mesh
    radiance: np.ndarray
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    body: str | None = None

    def __post_init__(self) -> None:
        owner = f"light {self.name!r}"
        if not isinstance(self.mesh, Mesh):
            raise TypeError(f"{owner}: mesh is a {type(self.mesh).__name__}; give a Mesh, from load_mesh or make_mesh")
        object.__setattr__(self, "radiance", _color(self.radiance, owner, "radiance"))
        object.__setattr__(self, "position", _numbers(self.position, (3,), owner, "position"))
        object.__setattr__(self, "rotation", _rotation(self.rotation, owner))


@dataclass(frozen=True, eq=False)
class DeltaLight:
    """A light as MJCF describes it: directional, spot or point, or MuJoCo's headlight.

    A renderer shows the model's own lights by itself; these are for such that the model lacks.

    ```python
    place = {"position": (0, 0, 3), "direction": (0, 0, -1)}
    colors = {"diffuse": (1, 1, 0.9), "specular": (0.3, 0.3, 0.3), "ambient": (0, 0, 0)}
    spot = psf.DeltaLight("spot", "spot", **place, **colors, cutoff=np.radians(30))
    ```

    The colours have MuJoCo's classic meaning: a white Lambert surface that faces the light has the colour `diffuse`.
    A light that reaches a receiver unhindered therefore causes, per unit of the cosine, the irradiance

        pi * diffuse * spot / (attenuation[0] + attenuation[1] d + attenuation[2] d^2),

    where d is the distance in metres and spot = cos(angle to `direction`)^exponent within `cutoff`, 0 outside it.
    A directional light has neither factor, a point light no spot factor. Beyond `range` spot and point lights end.

    Attributes:
        name: what messages call it.
        kind: "directional", "spot" or "point".
        position: in the world, metres, float64 [3]; of no matter for a directional light.
        direction: in the world, away from the light, float64 [3]; any length but 0 comes in, a unit vector is kept.
        diffuse, specular: what lights the Lambert part and the Phong lobe, linear, float64 [3], not negative.
        ambient: added to every surface as `ambient * albedo`, linear, float64 [3], not negative.
        attenuation: constant, linear (1/m) and quadratic (1/m^2) coefficients, float64 [3], not negative.
        cutoff: half-angle of a spot's cone, radians.
        exponent: how fast a spot fades towards its rim.
        range: metres; infinite by default.
        radius: of a spot's or point light's bulb (MJCF `bulbradius`), metres: wider ones cast softer shadows.
        castshadow: False lets its light through everything.
        index: of the model's light whose pose it takes in every frame; -1 is the headlight, which sits at the camera
            and looks where that looks; None stays where it is.

    Raises:
        ValueError: the kind is unknown, a value is NaN, negative where it must not be, infinite (but for `range`) or of
            another shape, or `direction` has no length.
    """

    name: str
    kind: Literal["directional", "spot", "point"]
    position: np.ndarray
    direction: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    ambient: np.ndarray
    attenuation: np.ndarray = field(default_factory=lambda: np.array((1.0, 0.0, 0.0)))
    cutoff: float = np.pi
    exponent: float = 0.0
    range: float = np.inf
    radius: float = 0.0
    castshadow: bool = True
    index: int | None = None

    def __post_init__(self) -> None:
        owner = f"light {self.name!r}"
        if self.kind not in ("directional", "spot", "point"):
            raise ValueError(f"{owner}: kind {self.kind!r} is unknown; choose directional, spot or point")
        for part in ("diffuse", "specular", "ambient", "attenuation"):
            object.__setattr__(self, part, _color(getattr(self, part), owner, part))
        object.__setattr__(self, "position", _numbers(self.position, (3,), owner, "position"))
        object.__setattr__(self, "direction", _unit(self.direction, owner, "direction"))
        for part in ("cutoff", "exponent", "range", "radius"):
            value = float(getattr(self, part))
            if not value >= 0.0:
                raise ValueError(f"{owner}: {part} is {value}; give a number of at least 0")
            if part != "range" and value == np.inf:
                raise ValueError(f"{owner}: {part} is inf; give a finite number")
            object.__setattr__(self, part, value)


Light: TypeAlias = AreaLight | DeltaLight


def rectangle_light(
    name: str,
    width: float,
    height: float,
    radiance,
    position,
    target=None,
    *,
    rotation=None,
    body: str | None = None,
) -> AreaLight:
    """A flat rectangle that shines along its own +z, turned towards `target` or as `rotation` says.

    ```python
    lamp = psf.rectangle_light("lamp", 1.0, 0.6, (8, 7, 6), (0, -1, 2), target=(0, 0, 0))
    ```

    Args:
        name: what messages call it.
        width, height: its sides along its own x and y, metres.
        radiance: linear Rec.709, 3 values.
        position: of its centre in the parent's frame, metres, [3].
        target: the point of the parent's frame it faces, [3]; its x axis then lies level, across the parent's z.
        rotation: parent_from_light, [3, 3]; without either the light faces the parent's +z.
        body: the parent, as in `AreaLight`.

    Raises:
        ValueError: a side is not positive, both `target` and `rotation` are given, `target` is `position`, or a value
            is not usable, as in `AreaLight`.
    """
    owner = f"light {name!r}"
    for side, value in (("width", width), ("height", height)):
        _check_length(value, owner, side)
    if target is not None and rotation is not None:
        raise ValueError(f"{owner}: both target and rotation are given; give one of them")
    position = _numbers(position, (3,), owner, "position")
    if target is not None:
        rotation = _facing(_numbers(target, (3,), owner, "target") - position, owner)
    elif rotation is None:
        rotation = np.eye(3)
    return AreaLight(name, plane(width / 2.0, height / 2.0, cells=1), radiance, position, rotation, body)


def sphere_light(name: str, radius: float, radiance, position, *, body: str | None = None) -> AreaLight:
    """A sphere that shines to all sides.

    Args:
        name: what messages call it.
        radius: metres.
        radiance: linear Rec.709, 3 values.
        position: of its centre in the parent's frame, metres, [3].
        body: the parent, as in `AreaLight`.

    Raises:
        ValueError: the radius is not positive, or a value is not usable.
    """
    _check_length(radius, f"light {name!r}", "radius")
    return AreaLight(name, sphere(radius), radiance, position, body=body)


def check_lights(lights: Sequence[Light], model_count: int) -> None:
    """Checks a list that a user gave; `model_count` lights are in the model.

    Raises:
        TypeError: it is no list, or holds something else than lights.
        ValueError: a light's index is not one of the model's.
    """
    if not isinstance(lights, Sequence) or isinstance(lights, str):
        raise TypeError(f"lights is a {type(lights).__name__}; give a list of AreaLight and DeltaLight")
    for light in lights:
        if not isinstance(light, (AreaLight, DeltaLight)):
            raise TypeError(f"lights holds a {type(light).__name__}; give AreaLight and DeltaLight only")
        if isinstance(light, DeltaLight) and light.index is not None and not -1 <= light.index < model_count:
            raise ValueError(
                f"light {light.name!r} follows light {light.index} of the model, which has {model_count}; give an "
                "index of the model, or None for a light of its own"
            )


def area_light_entities(scene: Scene) -> tuple[tuple[AreaLight, int], ...]:
    """The area lights of a scene, each with the index of the entity that is its shining body.

    Their entities are the scene's last ones, in the order in which the lights stand in `scene.lights`.
    """
    lights = [light for light in scene.lights if isinstance(light, AreaLight)]
    first = len(scene.entities) - len(lights)
    return tuple((light, first + offset) for offset, light in enumerate(lights))


def _check_length(value, owner: str, part: str) -> None:
    if not isinstance(value, Real) or not SHORTEST_LENGTH < value < np.inf:
        raise ValueError(f"{owner}: {part} is {value!r}; give a positive number of metres")


def _numbers(value, shape: tuple[int, ...], owner: str, part: str) -> np.ndarray:
    """`value` as float64 of `shape`; raises ValueError where it is not that, or not finite."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{owner}: {part} is {value!r}; give {_sizes(shape)} numbers") from error
    if numbers.shape != shape:
        raise ValueError(f"{owner}: {part} has shape {numbers.shape}; give {_sizes(shape)} numbers")
    if not np.isfinite(numbers).all():
        raise ValueError(f"{owner}: {part} is {numbers.tolist()}; every number must be finite")
    return numbers


def _sizes(shape: tuple[int, ...]) -> str:
    return " x ".join(str(size) for size in shape)


def _color(value, owner: str, part: str) -> np.ndarray:
    numbers = _numbers(value, (3,), owner, part)
    if (numbers < 0.0).any():
        raise ValueError(f"{owner}: {part} is {numbers.tolist()}; no value may be negative")
    return numbers


def _unit(value, owner: str, part: str) -> np.ndarray:
    vector = _numbers(value, (3,), owner, part)
    length = np.linalg.norm(vector)
    if length < SHORTEST_LENGTH:
        raise ValueError(f"{owner}: {part} is {vector.tolist()}, which has no length; give one that points somewhere")
    return vector / length


def _rotation(value, owner: str) -> np.ndarray:
    rotation = _numbers(value, (3, 3), owner, "rotation")
    skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if skew > ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise ValueError(
            f"{owner}: rotation is not a rotation matrix (R R^T differs from 1 by {skew:.2g}, determinant "
            f"{np.linalg.det(rotation):.3g}); give three unit columns at right angles, right-handed"
        )
    return rotation


def _facing(direction: np.ndarray, owner: str) -> np.ndarray:
    """The rotation whose +z is `direction` and whose x axis lies level."""
    z = _unit(direction, owner, "direction from position to target")
    x = np.cross((0.0, 0.0, 1.0), z)
    length = np.linalg.norm(x)
    # Straight up or down every x axis is level: keep the parent's.
    x = x / length if length > SHORTEST_LENGTH else np.array((1.0, 0.0, 0.0))
    return np.stack((x, np.cross(z, x), z), axis=1)

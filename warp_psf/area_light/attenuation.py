"""Light that moves over a shadow slab: template, differential map, attenuation map, screen buffer (Jeng 2005, 3.4).

Each pixel keeps what the shining light samples send to it, with what is in the way and without. Where the template
changes, only the samples that changed are asked again. The sums are kept in fixed point: a sample that is switched on
and off again leaves every pixel as it was, to the bit.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_psf.area_light.checks import MOST_RADIANCE, check_type, read_numbers
from warp_psf.area_light.scene_map import PixelTable, SceneMap, retrieve_pixels
from warp_psf.area_light.slab import ShadowSlab, SlabTable, upload_slab, visible_share
from warp_psf.device import find_device, launch

# Irradiance is kept in 2^-24ths of a W/m^2 in 64 bits: sums reach 5e11 W/m^2.
FIXED_POINT = wp.constant(wp.float32(2.0**24))
# No Lambert patch of radiance 1 causes more irradiance, however near a sample's middle a point lies; and the least
# squared distance, m^2: a point may lie on a sample.
MOST_FORM, NEAREST_SQUARED = wp.constant(float(np.pi)), wp.constant(1.0e-18)
# States of a light sample in the differential map.
NEVER, SWITCHED_ON, STAYS_ON, SWITCHED_OFF = 1, 2, 3, 4

long3 = wp.types.vector(3, wp.int64)


def next_states(states: np.ndarray, active: np.ndarray) -> np.ndarray:
    """The differential map after a change of the light template. Source: Jeng 2005, section 3.4.2.

    states, active: of each light sample, int8 and bool of one shape.
    """
    was_off = (states == NEVER) | (states == SWITCHED_OFF)
    on = np.where(was_off, SWITCHED_ON, STAYS_ON)
    return np.where(active, on, np.where(was_off, NEVER, SWITCHED_OFF)).astype(np.int8)


class SlabView:
    """A viewpoint of a still scene under the lights of shadow slabs, which shine as their templates say.

    All lights are off to begin with.

    ```python
    A = psf.area_light
    scene = psf.freeze_scene(model, data, cameras=["front"])
    lamp = psf.rectangle_light("lamp", 1.0, 1.0, (1, 1, 1), (0, 0, 2), target=(0, 0, 0))
    plane = A.make_light_plane(lamp, rows=5, columns=5)
    slab = A.bake_shadow_slab(scene, plane, size=65)
    view = A.SlabView(A.bake_scene_map(scene, width=160, height=120), [slab])
    pictures = []
    for x in (-0.4, 0.0, 0.4):
        view.set_light(0, 30.0 * A.templates.square(5, 5, side=0.5, at=(x, 0.0)))
        pictures.append(view.picture())
    ```

    Args:
        scene_map: of the viewpoint.
        slabs: one per light, of the scene map's scene.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.

    Raises:
        ValueError: there is no slab, one is of another scene, or there is no such device.
        TypeError: one of them is something else.
    """

    def __init__(self, scene_map: SceneMap, slabs: Sequence[ShadowSlab], *, device: str | None = None):
        if not isinstance(slabs, Sequence) or not slabs:
            raise ValueError("slabs must be a list of at least one shadow slab; make them with bake_shadow_slab")
        check_type("scene_map", scene_map, SceneMap, "bake_scene_map")
        for light, slab in enumerate(slabs):
            check_type(f"slab {light}", slab, ShadowSlab, "bake_shadow_slab")
            if slab.scene != scene_map.scene:
                raise ValueError(f"slab {light} is of another scene than the scene map; bake both from the same one")
        self._device = find_device(device)
        self._shape = (scene_map.height, scene_map.width)
        self._slabs = [upload_slab(slab, self._device) for slab in slabs]
        self._pixels = retrieve_pixels(scene_map, self._device)
        pixels = scene_map.width * scene_map.height
        self._lit, self._sent = (wp.zeros((1, pixels), dtype=long3, device=self._device) for _ in range(2))
        sizes = [(slab.plane.rows, slab.plane.columns) for slab in slabs]
        self._templates = [np.zeros((*size, 3), np.float32) for size in sizes]
        self._states = [np.full(size, NEVER, np.int8) for size in sizes]

    def set_light(self, light: int, template) -> int:
        """Lets the samples of a light shine, and returns how many of them were asked because they changed.

        A sample that is switched on and off again leaves every pixel as it was, to the bit.

        Args:
            light: the slab's place, counted from 0.
            template: radiance of each sample, linear, [rows, columns] or [rows, columns, 3], at most 1e8; 0 is off. Row
                0 is the plane's uppermost one. The functions of `warp_psf.area_light.templates` make shapes.

        Raises:
            IndexError: there is no such light.
            ValueError: the template has another shape, or a radiance is negative, too large or no number.
        """
        self._check_light(light)
        old = self._templates[light]
        new = read_numbers(f"the template of light {light}", template, np.float32)
        if new.shape not in (old.shape, old.shape[:2]):
            raise ValueError(f"the template has the shape {new.shape}; light {light} has the samples {old.shape[:2]}")
        if not ((new >= 0.0) & (new <= MOST_RADIANCE)).all():
            raise ValueError(f"a radiance of the template of light {light} is not within 0 and {MOST_RADIANCE:g}")
        new = np.broadcast_to(new if new.ndim == 3 else new[..., None], old.shape).copy()
        self._states[light] = next_states(self._states[light], (new > 0.0).any(axis=2))
        changed = np.flatnonzero((new != old).any(axis=2))
        if len(changed):
            self._update(light, changed, old.reshape(-1, 3)[changed], new.reshape(-1, 3)[changed])
        self._templates[light] = new
        return len(changed)

    def template(self, light: int) -> np.ndarray:
        """The radiance of a light's samples, float32 [rows, columns, 3]."""
        self._check_light(light)
        return self._templates[light].copy()

    def states(self, light: int) -> np.ndarray:
        """The differential map of a light after the last change, int8 [rows, columns].

        1: the sample never shone, or is off as before; 2: it was switched on; 3: it stays on; 4: it was switched off.
        Source: Jeng 2005, section 3.4.2.
        """
        self._check_light(light)
        return self._states[light].copy()

    def picture(self) -> np.ndarray:
        """The screen buffer: radiance with shadows, linear, float32 [height, width, 3]."""
        return self._reflected(self._lit)

    def shadowless(self) -> np.ndarray:
        """Radiance if nothing were in the way, linear, float32 [height, width, 3]."""
        return self._reflected(self._sent)

    def attenuation(self) -> np.ndarray:
        """The attenuation map: the share of light that arrives, float32 [height, width, 3]; 1 where none is sent."""
        lit, sent = self._lit.numpy().astype(np.float64), self._sent.numpy().astype(np.float64)
        share = np.divide(lit, sent, out=np.ones_like(lit), where=sent > 0)
        return share.reshape(*self._shape, 3).astype(np.float32)

    def _check_light(self, light: int) -> None:
        if not isinstance(light, (int, np.integer)) or not 0 <= light < len(self._slabs):
            raise IndexError(f"there is no light {light!r}; the view has {len(self._slabs)}, counted from 0")

    def _reflected(self, irradiance: wp.array) -> np.ndarray:
        albedo = self._pixels.albedo.numpy()
        radiance = albedo * (irradiance.numpy() * (1.0 / (float(FIXED_POINT) * np.pi)))
        return radiance.reshape(*self._shape, 3).astype(np.float32)

    def _update(self, light: int, changed: np.ndarray, old: np.ndarray, new: np.ndarray) -> None:
        inputs = [
            self._slabs[light],
            self._pixels,
            wp.array(changed.astype(np.int32), dtype=wp.int32, device=self._device),
            wp.array(old, dtype=wp.vec3, device=self._device),
            wp.array(new, dtype=wp.vec3, device=self._device),
        ]
        pixels = self._lit.shape[1]
        launch(_update_pixels, (1, pixels), inputs, [self._lit, self._sent], self._device)


@wp.func
def to_fixed_point(irradiance: wp.vec3) -> long3:
    """Irradiance, W/m^2, in the unit in which pixels keep it."""
    scaled = FIXED_POINT * irradiance
    return long3(wp.int64(scaled[0]), wp.int64(scaled[1]), wp.int64(scaled[2]))


@wp.kernel(enable_backward=False, module="unique")
def _update_pixels(
    first: int,
    slab: SlabTable,
    pixels: PixelTable,
    changed: wp.array(dtype=wp.int32),  # (place): light samples
    was: wp.array(dtype=wp.vec3),  # (place): radiance
    becomes: wp.array(dtype=wp.vec3),  # (place)
    lit_out: wp.array2d(dtype=long3),  # (world, pixel), added to
    sent_out: wp.array2d(dtype=long3),  # (world, pixel), added to
):
    world, pixel = wp.tid()
    pixel += first
    surface = pixels.surface[world, pixel]
    if surface < 0:
        return
    p = pixels.position[world, pixel]
    n = pixels.normal[world, pixel]
    flat = pixels.flat[world, pixel]
    shines = wp.vec3(slab.axes[0, 2], slab.axes[1, 2], slab.axes[2, 2])
    lit = lit_out[world, pixel]
    sent = sent_out[world, pixel]
    for place in range(changed.shape[0]):
        sample = changed[place]
        offset = p - slab.positions[sample]
        leaving = wp.dot(shines, offset)
        arriving = -wp.dot(n, offset)
        if leaving > 0.0 and arriving > 0.0:
            squared = wp.max(wp.length_sq(offset), NEAREST_SQUARED)
            # cos cos area / distance^2, with both cosines over the distance.
            form = wp.min(leaving * arriving * slab.cell_area / (squared * squared), MOST_FORM)
            before = form * was[place]
            after = form * becomes[place]
            sent += to_fixed_point(after) - to_fixed_point(before)
            share = visible_share(slab, sample, p, n, surface, flat)
            if share > 0.0:
                lit += to_fixed_point(share * after) - to_fixed_point(share * before)
    lit_out[world, pixel] = lit
    sent_out[world, pixel] = sent

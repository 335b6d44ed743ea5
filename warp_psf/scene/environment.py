"""Environments: distant light from every direction, as a latitude-longitude image or as spherical harmonics."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import overload

import av
import av.error
import numpy as np
import OpenEXR

from warp_psf.basis import sh, sphere

# Cells of the images made here: fine enough for a background, and 40 times finer than order 6 can tell apart.
BUILT_IN_ROWS, BUILT_IN_COLUMNS = 128, 256
# Larger images are box-filtered to this: the lighting is far smoother, and a background needs no more.
LARGEST_ROWS, LARGEST_COLUMNS = 512, 1024
# An image whose header promises more pixels than this (a 16k panorama) is not decoded: it would take gigabytes.
LARGEST_PIXELS = 16384 * 8192
# Gauss-Legendre nodes per row when projecting: with rows of a few degrees the error is that of the arithmetic.
NODES_PER_ROW = 4
# Fewer rows than this are taken as finer ones when projecting, so that the nodes lie close.
FEWEST_PROJECTED_ROWS = 64
# A Radiance header is a few lines; the line with the size stands within these bytes.
HDR_HEADER_BYTES = 8192
# Luminance of linear Rec.709.
LUMINANCE = np.array((0.2126, 0.7152, 0.0722))


@dataclass(frozen=True, eq=False)
class Environment:
    """Light from infinitely far away. `load_environment` makes one of a name, a file or an array.

    ```python
    dusk = psf.load_environment("sunset").rotated(np.pi / 2)
    upwards = dusk.lookup([0, 0, 1])  # radiance from straight above, [3]
    ```

    Attributes:
        name: what messages call it.
        radiance: linear Rec.709, float32 [rows, columns, 3]. Row 0 is +z, the last row -z; column c lies at azimuth
            2 pi (c + 1/2) / columns from +x towards +y. Photographs are read in this orientation too.
        coefficients: SH coefficients, float64 `[n*n, 3]`, where the light is exactly band-limited, else None; see
            `from_coefficients`.

    Raises:
        ValueError: `radiance` has another shape, no pixels, or pixels that are NaN, infinite or negative.
    """

    name: str
    radiance: np.ndarray
    coefficients: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "radiance", _checked(self.radiance, self.name))

    @staticmethod
    def from_coefficients(coefficients: np.ndarray, name: str = "coefficients") -> Environment:
        """The exactly band-limited light of SH `coefficients`, linear Rec.709.

        It may be negative where the coefficients make it so; `radiance`, the image for the background, is clamped.

        Args:
            coefficients: of real, orthonormal spherical harmonics without the Condon-Shortley phase, `[n*n, 3]`: that
                of band l and order m is number `l*l + l + m`.
            name: what messages call it.

        Raises:
            ValueError: the shape is another, or a coefficient is not finite.
        """
        coefficients = np.array(coefficients, dtype=np.float64)
        if coefficients.ndim != 2 or coefficients.shape[1] != 3:
            raise ValueError(f"environment {name!r}: coefficients have shape {coefficients.shape}; give [n*n, 3]")
        if not np.isfinite(coefficients).all():
            raise ValueError(f"environment {name!r}: coefficients are not all finite; replace NaN and infinity")
        order = sh.order_of(len(coefficients))
        directions = sphere.latlong_directions(BUILT_IN_ROWS, BUILT_IN_COLUMNS)
        return Environment(name, np.maximum(sh.evaluate(directions, order) @ coefficients, 0.0), coefficients)

    def project(self, order: int) -> np.ndarray:
        """SH coefficients, float64 `[order*order, 3]`, of `order` bands, at least 1; see `from_coefficients`.

        A cell has one radiance all over its solid angle. The integral over azimuth is exact; that over the polar angle
        is Gauss-Legendre's. Band-limited light is padded with zeros or truncated.

        Raises:
            ValueError: `order` is below 1.
        """
        if order < 1:
            raise ValueError(f"cannot project an environment onto {order} bands; choose at least 1")
        if self.coefficients is not None:
            kept = self.coefficients[: order * order]
            return np.concatenate((kept, np.zeros((order * order - len(kept), 3))))
        rows, columns = self.radiance.shape[:2]
        edges = 2.0 * np.pi * np.arange(columns + 1) / columns
        harmonics = [_azimuth_integrals(m, edges) for m in range(1 - order, order)]
        by_row = np.einsum("rcx,mc->rmx", self.radiance.astype(np.float64), np.stack(harmonics))

        repeats = -(-FEWEST_PROJECTED_ROWS // rows)
        polar = _polar_integrals(rows * repeats, order).reshape(rows, repeats, -1).sum(axis=1)
        band = sh.bands(order)
        m = np.arange(order * order) - band * band - band
        return np.einsum("rk,rkx->kx", polar, by_row[:, m + order - 1])

    def lookup(self, directions: np.ndarray) -> np.ndarray:
        """Radiance, float64 [..., 3], from where `directions` [..., 3] point (any length but 0).

        Bilinear in `radiance`, periodic in azimuth.
        """
        directions = np.asarray(directions, dtype=np.float64)
        rows, columns = self.radiance.shape[:2]
        x, y, z = np.moveaxis(directions, -1, 0)
        row = np.arctan2(np.hypot(x, y), z) * (rows / np.pi) - 0.5
        row = np.clip(row, 0.0, rows - 1.0)
        column = np.arctan2(y, x) * (columns / (2.0 * np.pi)) - 0.5
        top, left = np.floor(row).astype(int), np.floor(column).astype(int)
        down, right = (row - top)[..., None], (column - left)[..., None]
        bottom = np.minimum(top + 1, rows - 1)
        left, next_left = left % columns, (left + 1) % columns
        upper = (1.0 - right) * self.radiance[top, left] + right * self.radiance[top, next_left]
        lower = (1.0 - right) * self.radiance[bottom, left] + right * self.radiance[bottom, next_left]
        return (1.0 - down) * upper + down * lower

    def rotated(self, angle: float) -> Environment:
        """This environment turned about +z by `angle` radians, from +x towards +y.

        An image turns without loss by whole columns; between them neighbours are blended.
        """
        if self.coefficients is not None:
            cos, sin = np.cos(angle), np.sin(angle)
            turn = np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
            return Environment.from_coefficients(sh.rotate(self.coefficients.T, turn).T, self.name)
        shift = angle / (2.0 * np.pi) * self.radiance.shape[1]
        # A whole number of columns that rounding has missed stays whole.
        shift = round(shift) if abs(shift - round(shift)) < 1e-9 else shift
        whole = int(np.floor(shift))
        part = shift - whole
        near, far = np.roll(self.radiance, whole, axis=1), np.roll(self.radiance, whole + 1, axis=1)
        return Environment(self.name, (1.0 - part) * near + part * far)

    def mean_luminance(self) -> float:
        """The mean over the sphere of the luminance of `radiance`."""
        solid_angles = sphere.latlong_solid_angles(*self.radiance.shape[:2])
        return float(np.sum(solid_angles * (self.radiance @ LUMINANCE)) / (4.0 * np.pi))


@overload
def load_environment(value: None) -> None: ...
@overload
def load_environment(value: str | os.PathLike | np.ndarray | Environment) -> Environment: ...
def load_environment(value: str | os.PathLike | np.ndarray | Environment | None) -> Environment | None:
    """The environment that is named: by a built-in's name, a path, or an array.

    ```python
    sky = psf.load_environment("sky")
    from_above = np.zeros((2, 1, 3))
    from_above[0] = 1.5, 1.4, 1.3
    lit_from_above = psf.load_environment(from_above)
    ```

    Args:
        value: "studio", "sky", "sunset" or "overcast"; the path of an .exr or .hdr image; radiance, linear Rec.709,
            [rows, columns, 3], in the orientation of `Environment`; an `Environment`, which is returned as it is; or
            None, which is returned, too. Images larger than 512 x 1024 are box-filtered to that size.

    Raises:
        FileNotFoundError: there is no built-in and no file of that name.
        ValueError: the file cannot be read, or its radiance is not usable.
        TypeError: `value` is something else.
    """
    if value is None or isinstance(value, Environment):
        return value
    if isinstance(value, str) and value in BUILT_IN:
        return _built_in(value)
    if isinstance(value, (str, os.PathLike)):
        return _read(Path(value))
    if isinstance(value, (np.ndarray, list, tuple)):
        # A copy: the caller may go on writing to the array.
        return Environment("array", shrink(_checked(value, "array")).copy())
    raise TypeError(
        f"environment is a {type(value).__name__}; give a name ({', '.join(BUILT_IN)}), a path, an array or None"
    )


def shrink(radiance: np.ndarray) -> np.ndarray:
    """Box-filters an image [rows, columns, 3] to at most 512 x 1024, weighted by solid angle: its light is kept."""
    rows, columns = radiance.shape[:2]
    if rows <= LARGEST_ROWS and columns <= LARGEST_COLUMNS:
        return radiance
    fewer_rows, fewer_columns = min(rows, LARGEST_ROWS), min(columns, LARGEST_COLUMNS)
    bands = sphere.latlong_solid_angles(rows, 1)
    # A block of rows at a time: the sums are float64, and the image may be large.
    narrow = [_box_filter(block.swapaxes(0, 1), fewer_columns).swapaxes(0, 1) for block in _row_blocks(radiance)]
    weighted = _box_filter(np.concatenate(narrow) * bands[:, :, None], fewer_rows)
    return (weighted / _box_filter(bands, fewer_rows)[:, :, None]).astype(np.float32)


def _row_blocks(radiance: np.ndarray) -> list[np.ndarray]:
    return np.array_split(radiance, -(-len(radiance) // LARGEST_ROWS))


def _box_filter(values: np.ndarray, count: int) -> np.ndarray:
    """Means of `values` [n, ...] over `count` equal stretches of the first axis, which may cut through entries."""
    sums = np.concatenate((np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0, dtype=np.float64)))
    edges = np.arange(count + 1) * (len(values) / count)
    below = np.minimum(edges.astype(int), len(values) - 1)
    part = (edges - below).reshape(-1, *(1,) * (values.ndim - 1))
    at_edges = sums[below] + part * values[below]
    return np.diff(at_edges, axis=0) / (len(values) / count)


def _azimuth_integrals(m: int, edges: np.ndarray) -> np.ndarray:
    """The integral over every column of cos(m phi), or for m < 0 of sin(|m| phi)."""
    if m == 0:
        return np.diff(edges)
    return np.diff(np.sin(m * edges)) / m if m > 0 else -np.diff(np.cos(m * edges)) / -m


def _polar_integrals(rows: int, order: int) -> np.ndarray:
    """The integral over every row of y_lm without its factor cos(m phi) or sin(|m| phi), [rows, order*order]."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES_PER_ROW)
    theta = np.pi / rows * (np.arange(rows)[:, None] + 0.5 + 0.5 * nodes)
    # At azimuth 0 every cosine is 1: y_l|m| there is the polar factor of both y_lm and y_l-m.
    meridian = np.stack((np.sin(theta), np.zeros_like(theta), np.cos(theta)), axis=-1)
    band = sh.bands(order)
    m = np.arange(order * order) - band * band - band
    factors = sh.evaluate(meridian, order)[..., band * band + band + np.abs(m)]
    return np.einsum("rq,rqk->rk", 0.5 * np.pi / rows * weights * np.sin(theta), factors)


def _checked(radiance, name: str) -> np.ndarray:
    """`radiance` as float32 [rows, columns, 3], or a ValueError that says how many pixels are bad."""
    try:
        image = np.asarray(radiance, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(f"environment {name!r} is not an array of numbers; give floats [rows, columns, 3]") from error
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(
            f"environment {name!r} has shape {image.shape}; give [rows, columns, 3] with at least one pixel"
        )
    broken = int(np.count_nonzero(~np.isfinite(image).all(axis=2)))
    pixels = image.shape[0] * image.shape[1]
    if broken:
        raise ValueError(
            f"environment {name!r}: {broken} of {pixels} pixels are NaN or infinite; replace them, "
            "for example with numpy.nan_to_num(radiance, posinf=largest)"
        )
    negative = int(np.count_nonzero((image < 0.0).any(axis=2)))
    if negative:
        raise ValueError(
            f"environment {name!r}: {negative} of {pixels} pixels are negative (lowest {image.min():.3g}); "
            "clip them, for example with numpy.maximum(radiance, 0)"
        )
    return image


# Reading files


def _read(path: Path) -> Environment:
    if not path.is_file():
        raise FileNotFoundError(
            f"environment {str(path)!r} is neither a file nor a built-in; the built-in ones are {', '.join(BUILT_IN)}"
        )
    readers = {".exr": _read_exr, ".hdr": _read_hdr}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"environment {str(path)!r}: {path.suffix or 'no'} extension; give an .exr or .hdr image")
    return Environment(path.name, shrink(_checked(reader(path), path.name)))


def _check_size(rows: int, columns: int, path: Path) -> None:
    if rows < 1 or columns < 1 or rows * columns > LARGEST_PIXELS:
        raise ValueError(
            f"environment {str(path)!r} is {columns} x {rows} pixels; give 1 to {LARGEST_PIXELS} pixels, "
            f"of which {LARGEST_COLUMNS} x {LARGEST_ROWS} are kept"
        )


def _read_exr(path: Path) -> np.ndarray:
    """Pixels [rows, columns, 3] of an OpenEXR file's first part: its channels R, G, B, or Y for all three."""
    try:
        with OpenEXR.File(str(path), header_only=True) as header:
            low, high = header.header()["dataWindow"]
    except (RuntimeError, ValueError, KeyError) as error:
        raise ValueError(f"environment {str(path)!r} is not a readable OpenEXR image: {error}") from error
    _check_size(int(high[1] - low[1]) + 1, int(high[0] - low[0]) + 1, path)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"environment {str(path)!r} is damaged or cut short: {error}") from error
    for names in (("R", "G", "B"), ("Y", "Y", "Y")):
        if all(name in channels for name in names):
            return np.stack([channels[name].astype(np.float32) for name in names], axis=-1)
    raise ValueError(f"environment {str(path)!r} has channels {sorted(channels)}; give R, G and B, or Y")


def _read_hdr(path: Path) -> np.ndarray:
    """Pixels [rows, columns, 3] of a Radiance file (32-bit_rle_rgbe, rows from the top, columns from the left)."""
    content = path.read_bytes()
    lines = content[:HDR_HEADER_BYTES].split(b"\n")
    size = next((line.split() for line in lines if line.startswith((b"-Y ", b"+Y ", b"-X ", b"+X "))), [])
    if not content.startswith(b"#?") or len(size) != 4 or not (size[1].isdigit() and size[3].isdigit()):
        raise ValueError(f"environment {str(path)!r} is not a Radiance image: its header is missing or damaged")
    if (size[0], size[2]) != (b"-Y", b"+X") or b"FORMAT=32-bit_rle_xyze" in lines:
        raise ValueError(
            f"environment {str(path)!r}: only Radiance images in RGB and in the usual order (-Y +X) are read"
        )
    rows, columns = int(size[1]), int(size[3])
    _check_size(rows, columns, path)
    # The decoder alone, without FFmpeg's search for where images begin and end: that search is misled by some headers.
    # It notices a file that was cut short, unless the cut is within the last row.
    decoder = av.CodecContext.create("hdr", "r")
    try:
        frames = decoder.decode(av.Packet(content)) + decoder.decode(None)
    except av.error.FFmpegError as error:
        raise ValueError(f"environment {str(path)!r} is damaged or cut short: {error.strerror}") from error
    if len(frames) != 1 or (frames[0].height, frames[0].width) != (rows, columns):
        raise ValueError(f"environment {str(path)!r} does not decode to the {columns} x {rows} pixels of its header")
    return frames[0].to_ndarray()


# Built-in environments: smooth, so that few SH bands hold them. Each is scaled until an unhindered white floor has
# luminance 1, so that exposure 0 suits all of them.


@cache
def _built_in(name: str) -> Environment:
    radiance = BUILT_IN[name](sphere.latlong_directions(BUILT_IN_ROWS, BUILT_IN_COLUMNS))
    directions = sphere.latlong_directions(BUILT_IN_ROWS, BUILT_IN_COLUMNS)
    cosines = np.maximum(directions[..., 2], 0.0) * sphere.latlong_solid_angles(BUILT_IN_ROWS, BUILT_IN_COLUMNS)
    floor = np.sum(cosines * (radiance @ LUMINANCE)) / np.pi
    radiance = (radiance / floor).astype(np.float32)
    # The same object serves every renderer: nobody may write to it.
    radiance.setflags(write=False)
    return Environment(name, radiance)


def _panel(directions: np.ndarray, towards, half_width: float, half_height: float, color) -> np.ndarray:
    """A soft-edged rectangular light seen in the direction `towards`; half-sizes in radians, radiance [..., 3]."""
    frame = np.array(towards) / np.linalg.norm(towards)
    across = np.cross((0.0, 0.0, 1.0), frame)
    across /= np.linalg.norm(across)
    up = np.cross(frame, across)
    ahead = np.arctan2(np.linalg.norm(np.cross(directions, frame), axis=-1), directions @ frame)
    turn = np.arctan2(directions @ up, directions @ across)
    x, y = ahead * np.cos(turn) / half_width, ahead * np.sin(turn) / half_height
    # The third power is nearly flat inside and falls off over about half of the half-size: a box with a soft rim.
    return np.exp(-(np.abs(x) ** 3 + np.abs(y) ** 3))[..., None] * np.array(color)


def _glow(directions: np.ndarray, towards, sharpness: float, color) -> np.ndarray:
    """A round glow exp(sharpness (cos angle - 1)) around `towards`, radiance [..., 3]."""
    axis = np.array(towards) / np.linalg.norm(towards)
    return np.exp(sharpness * (directions @ axis - 1.0))[..., None] * np.array(color)


def _blend(height: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between, [..., 1]."""
    part = np.clip((height - low) / (high - low), 0.0, 1.0)
    return (part * part * (3.0 - 2.0 * part))[..., None]


def _studio(directions: np.ndarray) -> np.ndarray:
    # Named as a camera sees them that looks along +y, as MuJoCo's free camera does: left is -x, behind is +y.
    lift = _blend(directions[..., 2], -0.9, 0.9)
    surround = (1.0 - lift) * np.array((0.26, 0.26, 0.27)) + lift * np.array((0.46, 0.47, 0.49))
    key = _panel(directions, (-0.60, -0.42, 0.85), 0.82, 0.68, (2.35, 2.28, 2.18))
    fill = _panel(directions, (0.95, -0.35, 0.45), 0.60, 0.72, (0.52, 0.56, 0.63))
    rim = _panel(directions, (0.35, 0.95, 0.50), 0.85, 0.42, (1.00, 0.80, 0.58))
    return surround + key + fill + rim


def _sky(directions: np.ndarray) -> np.ndarray:
    z = directions[..., 2]
    rise = np.maximum(z, 0.0)[..., None] ** 0.6
    dome = (1.0 - rise) * np.array((0.80, 0.90, 1.00)) + rise * np.array((0.28, 0.48, 0.88))
    ground = np.array((0.30, 0.275, 0.24))
    above = _blend(z, -0.12, 0.08)
    sun = _glow(directions, (-0.60, -0.45, 0.85), 9.0, (3.4, 3.1, 2.6))
    return (1.0 - above) * ground + above * (dome + sun)


def _sunset(directions: np.ndarray) -> np.ndarray:
    z = directions[..., 2]
    rise = np.maximum(z, 0.0)[..., None] ** 0.5
    dome = (1.0 - rise) * np.array((0.85, 0.52, 0.40)) + rise * np.array((0.22, 0.32, 0.62))
    ground = np.array((0.26, 0.20, 0.18))
    above = _blend(z, -0.15, 0.08)
    towards = (-0.90, 0.25, 0.50)
    glow = _glow(directions, towards, 2.0, (0.9, 0.45, 0.20)) + _glow(directions, towards, 7.0, (2.6, 1.35, 0.55))
    return (1.0 - above) * ground + above * (dome + glow)


def _overcast(directions: np.ndarray) -> np.ndarray:
    # CIE standard overcast sky: the zenith is three times as bright as the horizon, (1 + 2 sin elevation) / 3.
    z = directions[..., 2]
    sky = ((1.0 + 2.0 * np.maximum(z, 0.0)) / 3.0)[..., None] * np.array((0.96, 1.00, 1.06))
    ground = np.array((0.19, 0.19, 0.18))
    above = _blend(z, -0.10, 0.05)
    return (1.0 - above) * ground + above * sky


BUILT_IN: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "studio": _studio,
    "sky": _sky,
    "sunset": _sunset,
    "overcast": _overcast,
}

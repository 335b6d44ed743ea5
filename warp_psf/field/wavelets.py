"""All-frequency shadow fields as the paper codes them (Tamura 2006, sections 3 and 6): sparse Haar vectors on shells.

A sample's vector is the Haar transform of a 64 x 64 map of what the body covers of the directions around the sample, or
of the radiance that comes from there (see `basis/haar.py` for the map and for the order of the coefficients). Of the
4,096 coefficients the largest twentieth is kept, in 8 bits each, with the places at which they stand.

A lookup adds eight sparse vectors up. What comes out is dense in the worst case, so a receiver gets room for a whole
vector; receivers are served in turns, and no more than `TURN` of them have such room at a time.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_psf.basis import haar
from warp_psf.device import find_device, launch, upload_tables
from warp_psf.field.shells import (
    CONTACT_POWER,
    FIRST_OUTER_SHELL,
    HEMISPHERE_SHARE,
    SHELL_SPACING,
    angles_of,
    between_shells,
    find_corners,
    nearest_four,
)

# Cells per axis of a map: Tamura 2006, section 6.
MAP_SIZE = 64
CELLS = MAP_SIZE * MAP_SIZE
# The mean, and the details of 1, 2, 4, ... blocks per axis: each has its own range, which is quantised to 8 bits.
LEVELS = MAP_SIZE.bit_length()
# What a place among 4,096 takes, bytes; how many of them a sample has, at most 205, takes one.
INDEX_BYTES = 1.5
COUNT_BYTES = 1
# Receivers that are served at a time: their dense vectors take 64 MB.
TURN = 4096


@dataclass(frozen=True)
class WaveletField:
    """One body's all-frequency field.

    center: centre of the shells in the body's frame, metres, float32 [3].
    radius: radius of the body's bounding sphere, metres.
    resolutions: samples per axis of each shell, R_c, int32 [shells]; shell c has R_c x R_c samples.
    first: a sample's first entry, and behind the last sample the number of entries, int32 [samples + 1]; samples
        stand shell after shell, rows (theta) before columns (phi).
    index: the entries' places in the vector, row * MAP_SIZE + column, uint16 [entries], rising within a sample.
    codes: coefficient = minimum + step * code; places without an entry are zero; uint8 [entries].
    minimum, step: float32 [shells, LEVELS]; see `coefficient_levels`.
    """

    center: np.ndarray
    radius: float
    resolutions: np.ndarray
    first: np.ndarray
    index: np.ndarray
    codes: np.ndarray
    minimum: np.ndarray
    step: np.ndarray

    @property
    def nbytes(self) -> int:
        """What a file of the field takes, bytes: codes, places of 12 bits, the samples' numbers of entries, constants.

        The arrays here take more, because places stand in 16 bits and `first` is a sum of the numbers of entries.
        """
        entries = (self.codes.itemsize + INDEX_BYTES) * len(self.codes)
        samples = COUNT_BYTES * (len(self.first) - 1)
        return math.ceil(entries) + samples + self.minimum.nbytes + self.step.nbytes

    def dequantised(self, samples: np.ndarray) -> np.ndarray:
        """The vectors of the numbered samples [n], float32 [n, MAP_SIZE, MAP_SIZE]."""
        starts, counts = self.first[samples], np.diff(self.first)[samples]
        row = np.repeat(np.arange(len(samples)), counts)
        entry = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts - starts, counts)
        index = self.index[entry]
        shell = np.searchsorted(np.cumsum(self.resolutions.astype(np.int64) ** 2), samples, side="right")[row]
        level = coefficient_levels()[index]
        vectors = np.zeros((len(samples), CELLS), np.float32)
        vectors[row, index] = self.minimum[shell, level] + self.step[shell, level] * self.codes[entry]
        return vectors.reshape(-1, MAP_SIZE, MAP_SIZE)

    def lookup(self, points_body: np.ndarray) -> np.ndarray:
        """The maps at points of the body's frame [N, 3], metres, float64 [N, MAP_SIZE, MAP_SIZE].

        Coverage, or radiance, by direction in the body's axes (`haar.map_directions`). Of truncated and quantised
        vectors: coverage can be a little below 0 or above 1. The twin of `lookup_vector`.
        """
        corners = find_corners(self.center, self.radius, self.resolutions, points_body)
        used, places = np.unique(corners.samples, return_inverse=True)
        vectors = self.dequantised(used).astype(np.float64)
        nearer, farther = replace(corners, samples=places.reshape(corners.samples.shape)).blend(vectors)
        weight = corners.contact_weight(HEMISPHERE_SHARE * nearer[:, 0, 0])[:, None, None]
        return haar.inverse(corners.scale[:, None, None] * ((1 - weight) * nearer + weight * farther))

    def double_products(self, points_body: np.ndarray, lights: np.ndarray, device: str | None = None) -> np.ndarray:
        """What would come from the covered directions of lights, float32 [..., N, lights].

        points_body: receivers in the body's frame, metres, [N, 3] or [worlds, N, 3]. lights: radiance by direction in
        the body's axes, [lights, MAP_SIZE, MAP_SIZE] (`haar.map_directions`).
        """
        points = np.asarray(points_body, np.float32)
        vectors = haar.transform(np.asarray(lights, np.float64)).reshape(-1, CELLS).astype(np.float32)
        products = _double_products(self, points.reshape(-1, *points.shape[-2:]), vectors, find_device(device))
        return products.reshape(*points.shape[:-1], len(vectors))


def coefficient_levels() -> np.ndarray:
    """The level of each place of a vector, uint8 [CELLS]: 0 the mean, 1 + k the details of 2^k x 2^k blocks."""
    place = np.arange(MAP_SIZE)
    level = np.ceil(np.log2(place + 1)).astype(np.uint8)
    return np.maximum(level[:, None], level[None, :]).ravel()


@wp.struct
class WaveletTable:
    """A field on the device."""

    first: wp.array(dtype=wp.int32)  # (sample + 1)
    index: wp.array(dtype=wp.uint16)  # (entry)
    codes: wp.array(dtype=wp.uint8)  # (entry)
    minimum: wp.array2d(dtype=wp.float32)  # (shell, level)
    step: wp.array2d(dtype=wp.float32)  # (shell, level)
    level: wp.array(dtype=wp.uint8)  # (cell)
    shell_first: wp.array(dtype=wp.int32)  # (shell): index of the shell's first sample
    shell_resolution: wp.array(dtype=wp.int32)  # (shell)
    center: wp.vec3  # in the body's frame
    radius: wp.float32


def upload_wavelets(field: WaveletField, device: wp.Device) -> WaveletTable:
    """The field on the device."""
    table = WaveletTable()
    counts = field.resolutions.astype(np.int64) ** 2
    table.first = wp.array(field.first, dtype=wp.int32, device=device)
    table.index = wp.array(field.index, dtype=wp.uint16, device=device)
    table.codes = wp.array(field.codes, dtype=wp.uint8, device=device)
    table.minimum = wp.array(field.minimum, dtype=wp.float32, ndim=2, device=device)
    table.step = wp.array(field.step, dtype=wp.float32, ndim=2, device=device)
    table.level = wp.array(coefficient_levels(), dtype=wp.uint8, device=device)
    table.shell_first = wp.array(np.cumsum(counts) - counts, dtype=wp.int32, device=device)
    table.shell_resolution = wp.array(field.resolutions, dtype=wp.int32, device=device)
    table.center = wp.vec3(*map(float, field.center))
    table.radius = field.radius
    return table


@wp.func
def add_sample(
    tables: wp.array(dtype=WaveletTable), shell: int, sample: int, share: float, vector: wp.array(dtype=wp.float32)
):
    """Adds a share of a sample's sparse vector to a dense one (cell)."""
    for entry in range(tables[0].first[sample], tables[0].first[sample + 1]):
        place = int(tables[0].index[entry])
        level = int(tables[0].level[place])
        value = tables[0].minimum[shell, level] + tables[0].step[shell, level] * float(tables[0].codes[entry])
        vector[place] = vector[place] + share * value


@wp.func
def first_coefficient(tables: wp.array(dtype=WaveletTable), shell: int, sample: int) -> float:
    """The mean's coefficient, which stands first in a sample that covers anything."""
    entry = tables[0].first[sample]
    value = float(0.0)
    if entry < tables[0].first[sample + 1]:
        if tables[0].index[entry] == wp.uint16(0):
            value = tables[0].minimum[shell, 0] + tables[0].step[shell, 0] * float(tables[0].codes[entry])
    return value


@wp.func
def lookup_vector(tables: wp.array(dtype=WaveletTable), p_body: wp.vec3, vector: wp.array(dtype=wp.float32)):
    """Writes the Haar vector (cell) at a point of the body's frame: bilinear on two shells, then between them.

    tables: one field, in an array so that a pointer is passed in place of all of it.
    """
    offset = p_body - tables[0].center
    distance = wp.length(offset)
    theta, phi = angles_of(offset, distance)
    count = tables[0].shell_resolution.shape[0]
    radius = distance / (tables[0].radius * wp.static(SHELL_SPACING))
    inner, weight = between_shells(radius, count)
    near, near_shares = nearest_four(tables[0].shell_first[inner], tables[0].shell_resolution[inner], theta, phi)
    far, far_shares = nearest_four(tables[0].shell_first[inner + 1], tables[0].shell_resolution[inner + 1], theta, phi)
    if inner == wp.static(FIRST_OUTER_SHELL):
        mean = float(0.0)
        for k in range(4):
            mean += near_shares[k] * first_coefficient(tables, inner, near[k])
        share = wp.clamp(wp.static(HEMISPHERE_SHARE) * mean, 0.0, 1.0)
        weight = wp.pow(weight, 1.0 - wp.static(CONTACT_POWER) * share)
    beyond = float(count) / wp.max(radius, float(count))
    scale = beyond * beyond
    for cell in range(vector.shape[0]):
        vector[cell] = 0.0
    for k in range(4):
        add_sample(tables, inner, near[k], scale * (1.0 - weight) * near_shares[k], vector)
        add_sample(tables, inner + 1, far[k], scale * weight * far_shares[k], vector)


@wp.kernel(enable_backward=False, module="unique")
def _multiply_lights(
    first: int,
    tables: wp.array(dtype=WaveletTable),  # (one)
    points_body: wp.array2d(dtype=wp.vec3),  # (world, receiver)
    lights: wp.array2d(dtype=wp.float32),  # (light, cell)
    vectors: wp.array3d(dtype=wp.float32),  # (world, receiver, cell), room for the dense vectors
    products_out: wp.array3d(dtype=wp.float32),  # (world, receiver, light)
):
    world, receiver = wp.tid()
    receiver += first
    lookup_vector(tables, points_body[world, receiver], vectors[world, receiver])
    for light in range(lights.shape[0]):
        total = float(0.0)
        for cell in range(lights.shape[1]):
            total += vectors[world, receiver, cell] * lights[light, cell]
        products_out[world, receiver, light] = total


def _double_products(field: WaveletField, points: np.ndarray, lights: np.ndarray, device: wp.Device) -> np.ndarray:
    worlds, receivers = points.shape[:2]
    table = upload_tables([upload_wavelets(field, device)], WaveletTable, device)
    light_vectors = wp.array(lights, dtype=wp.float32, ndim=2, device=device)
    turn = max(1, min(receivers, TURN // worlds))
    vectors = wp.empty((worlds, turn, CELLS), dtype=wp.float32, device=device)
    products = np.empty((worlds, receivers, len(lights)), np.float32)
    for begin in range(0, receivers, turn):
        part = points[:, begin : begin + turn]
        out = wp.empty((worlds, part.shape[1], len(lights)), dtype=wp.float32, device=device)
        inputs = [table, wp.array(part, dtype=wp.vec3, ndim=2, device=device), light_vectors, vectors]
        launch(_multiply_lights, (worlds, part.shape[1]), inputs, [out], device)
        products[:, begin : begin + turn] = out.numpy()
    return products

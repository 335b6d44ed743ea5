"""Files: EXR with named layers, PNG, H.264 film and contact sheet; each is whole under its name or not there at all."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import OpenEXR
from PIL import Image
from PIL.PngImagePlugin import PngInfo

# The channel names of the layers that do not follow the rule [height, width, 3] -> name.R, name.G, name.B.
# `color` has no prefix and `depth` is `Z`: these are what a viewer shows at once, and what a compositor calls depth.
LAYER_CHANNELS = {
    "color": ("R", "G", "B"),
    "depth": ("Z",),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "segmentation": ("segmentation.id", "segmentation.type"),
}
# Red, green, blue and white of Rec.709 with D65, as (x, y) pairs.
REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)

LARGEST_HALF = 65504.0
# Integers up to here are exact in float32.
LARGEST_EXACT_INTEGER = 2**24
# An EXR whose header asks for more than this is taken for damaged before anything of that size is allocated.
LARGEST_EXR_BYTES = 2**31

# 18 cannot be told from the source in normal viewing; the file is a small part of the frames' size.
VIDEO_QUALITY = 18
# One encoding thread: x264's decisions depend on the number of threads, and a film must not depend on the machine.
VIDEO_THREADS = 1
# Code points of ITU-T H.273 for BT.709 primaries, transfer and matrix, and FFmpeg's number for the limited range.
BT709 = 1
LIMITED_RANGE = 1

# zlib's run-length strategy after PNG's filters: on rendered pictures smaller than its fastest level, and as fast.
PNG_STRATEGY_RLE = 3

SHEET_FRAMES = 16
SHEET_PICTURE_WIDTH = 480
SHEET_GAP = 6
SHEET_BACKGROUND = 24


def write_exr(
    path: str | Path,
    layers: dict[str, np.ndarray],
    *,
    frames_per_second: float | Fraction | None = None,
    world_from_camera: np.ndarray | None = None,
) -> None:
    """Writes one part of ZIP-compressed scan lines (lossless; the smallest of the kinds that every reader knows).

    layers, all [height, width]:
        color [.., 3] -> R, G, B; normal [.., 3] -> normal.X, .Y, .Z; any other [.., 3] -> name.R, .G, .B: half floats,
            values beyond 65504 are cut there.
        depth -> Z; any other without a last axis -> name: float32.
        segmentation, integers [.., 2] -> segmentation.id, segmentation.type: float32, because EXR's integers have no
            sign and -1 marks the background.
    frames_per_second: becomes the attribute framesPerSecond, a ratio of integers.
    world_from_camera: camera pose [4, 4], metres, for column vectors. The attribute worldToCamera is its inverse,
        transposed, because OpenEXR multiplies row vectors (p_camera = p_world M): the translation is in the last row.

    Raises:
        ValueError: a layer holds NaN, has another shape, or the rate or pose is not usable.
        OSError: the file could not be written; nothing is left of it.
    """
    header: dict[str, Any] = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "chromaticities": REC709_CHROMATICITIES,
    }
    if frames_per_second is not None:
        header["framesPerSecond"] = frame_rate(frames_per_second)
    if world_from_camera is not None:
        header["worldToCamera"] = _world_to_camera(world_from_camera)
    channels = _channels_of_layers(layers)
    with replacing(path) as temporary:
        try:
            # No threads of its own: the cores belong to the renderer.
            OpenEXR.File(header, channels, num_threads=0).write(str(temporary))
        except RuntimeError as error:
            # The system's reason is the message's last sentence.
            raise OSError(errno.EIO, str(error).rstrip(".").rsplit(". ", 1)[-1]) from error


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """The layers of an EXR under the names that they were written by: float32, segmentation int32.

    ```python
    with psf.Renderer(model, height=60, width=80, bounces=0) as renderer:
        renderer.update_scene(data, camera="front")
        film = psf.FrameSequence("one frame", {}, frames=range(1), frames_per_second=24)
        with film as sequence:
            sequence.write(0, renderer.layers(), renderer.render(), None)
    depth = psf.read_exr("one frame/frame_0000.exr")["depth"]  # float32 [60, 80]
    ```

    Files of other programs are read too: R, G, B is `color`, a.R, a.G, a.B is `a`, Z is `depth`, and any other single
    channel keeps its name. Layers of three are [height, width, 3], single ones [height, width]. A `FrameSequence`
    writes those of three as half floats: they come back rounded to 11 bits.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no flat EXR, it is damaged, or it asks for more than 2 GiB.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there: give the path of an EXR file")
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"{path} is not an EXR file ({error}): give the path of one") from error
    _check_exr_header(path, header)
    try:
        # A file with damaged pixels comes back without parts, and asking for their channels is a ValueError.
        file = OpenEXR.File(str(path), separate_channels=True, num_threads=0)
        planes = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"{path} is damaged or cut off ({error}): write it again") from error
    return _layers_of_channels(planes)


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Writes uint8 [height, width, 3], sRGB.

    Raises:
        ValueError: the array is something else.
        OSError: the file could not be written; nothing is left of it.
    """
    _check_picture(image)
    tags = PngInfo()
    tags.add(b"sRGB", b"\0")  # 0: perceptual intent
    # Pillow's own writing to a file loses the system's reason when the disk is full.
    encoded = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(image))
    picture.save(encoded, "PNG", compress_level=1, compress_type=PNG_STRATEGY_RLE, pnginfo=tags)
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.getbuffer())


def read_png(path: str | Path) -> np.ndarray:
    """The picture of a PNG, uint8 [height, width, 3].

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a picture that can be read.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there: give the path of a PNG file")
    try:
        with Image.open(path) as picture:
            return np.array(picture.convert("RGB"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path} is not a picture that can be read ({error}): write it again") from error


def write_video(path: str | Path, images: Iterable[np.ndarray], frames_per_second: float | Fraction) -> None:
    """Writes pictures, uint8 [height, width, 3], as an MP4 that plays everywhere: H.264, yuv420p, BT.709, index first.

    Odd sizes are padded to even ones by repeating the last row and column. The same pictures give the same bytes.

    Raises:
        ValueError: no pictures, pictures of different sizes, or an unusable rate.
        OSError: the file could not be written; nothing is left of it.
    """
    rate = frame_rate(frames_per_second)
    with (
        replacing(path) as temporary,
        av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        stream: Any = None
        size = None
        for index, image in enumerate(images):
            _check_picture(image)
            if stream is None:
                size = image.shape
                stream = _open_video_stream(container, rate, image.shape[1], image.shape[0])
            if image.shape != size:
                raise ValueError(f"picture {index} of the film is {image.shape}, the first is {size}: render one size")
            frame = _video_frame(image)
            frame.pts, frame.time_base = index, 1 / rate
            container.mux(stream.encode(frame))
        if stream is None:
            raise ValueError(f"there are no pictures for {path}: render at least one frame")
        container.mux(stream.encode(None))


def contact_sheet(images: Sequence[np.ndarray], columns: int = 4) -> np.ndarray:
    """One picture, uint8, of up to 16 of the given ones in reading order, evenly chosen, with thin gaps.

    images: uint8 [height, width, 3], all of one size; wider than 480 pixels, they are scaled down.

    Raises:
        ValueError: no images, images of different sizes, or no columns.
    """
    if len(images) == 0 or columns < 1:
        raise ValueError(f"a contact sheet needs images and columns, got {len(images)} and {columns}: give one or more")
    chosen = [images[index] for index in sheet_indices(len(images), columns)]
    for image in chosen:
        _check_picture(image)
        if image.shape != chosen[0].shape:
            raise ValueError(f"a contact sheet got images of {chosen[0].shape} and {image.shape}: give one size")
    height, width = chosen[0].shape[:2]
    if width > SHEET_PICTURE_WIDTH:
        width, height = SHEET_PICTURE_WIDTH, max(1, round(height * SHEET_PICTURE_WIDTH / width))
    columns = min(columns, len(chosen))
    rows = -(-len(chosen) // columns)
    shape = (rows * (height + SHEET_GAP) + SHEET_GAP, columns * (width + SHEET_GAP) + SHEET_GAP, 3)
    sheet = np.full(shape, SHEET_BACKGROUND, np.uint8)
    for place, image in enumerate(chosen):
        top = SHEET_GAP + place // columns * (height + SHEET_GAP)
        left = SHEET_GAP + place % columns * (width + SHEET_GAP)
        small = Image.fromarray(np.ascontiguousarray(image)).resize((width, height), Image.Resampling.LANCZOS)
        sheet[top : top + height, left : left + width] = np.asarray(small)
    return sheet


def sheet_indices(count: int, columns: int = 4) -> list[int]:
    """Which of `count` images a contact sheet shows: at most 16, in full rows where there are several rows."""
    shown = min(count, SHEET_FRAMES)
    if shown > columns:
        shown -= shown % columns
    if shown == 1:
        return [0]
    return [round(place * (count - 1) / (shown - 1)) for place in range(shown)]


def image_difference(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """How far two arrays of one shape lie apart, in their own units: `rmse`, `maximum` and `mean_absolute`.

    ```python
    black, grey = np.zeros((60, 80, 3)), np.full((60, 80, 3), 0.1)
    rmse = psf.image_difference(black, grey)["rmse"]  # 0.1
    ```

    Args:
        a, b: arrays of one shape, both floats or both integers.

    Raises:
        ValueError: the shapes differ, there are no pixels, or one holds 8-bit values and the other linear floats.
    """
    a, b = np.asarray(a), np.asarray(b)
    if a.shape != b.shape or a.size == 0:
        raise ValueError(f"images of shapes {a.shape} and {b.shape} cannot be compared: render both at one size")
    if (a.dtype.kind == "f") != (b.dtype.kind == "f"):
        raise ValueError(f"images of {a.dtype} and {b.dtype} cannot be compared: compare PNG with PNG, EXR with EXR")
    difference = np.abs(a.astype(np.float64) - b.astype(np.float64))
    return {
        "rmse": float(np.sqrt(np.mean(difference**2))),
        "maximum": float(difference.max()),
        "mean_absolute": float(difference.mean()),
    }


def frame_rate(frames_per_second: float | Fraction) -> Fraction:
    """The rate as a ratio of small integers; 29.97002997 is 30000/1001.

    Raises:
        ValueError: it is not a number from 0.01 to 1000.
    """
    if not 0.01 <= frames_per_second <= 1000:
        raise ValueError(f"frames_per_second is {frames_per_second}, it must be from 0.01 to 1000: 24 is usual")
    return Fraction(frames_per_second).limit_denominator(1001)


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name when the body ends, or is removed when the body raises.

    Raises:
        OSError: of the body or of the renaming, as one sentence that says what, where and how to mend it.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.touch()
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        _remove_quietly(temporary)
        raise write_error(path, error) from error
    except BaseException:
        _remove_quietly(temporary)
        raise


def write_error(path: Path, error: OSError) -> OSError:
    """The same failure as one sentence: what could not be written, why, and how to mend it."""
    if error.errno is None:  # a sentence already
        return error
    if error.errno == errno.ENOENT:
        remedy = "create its folder first"
    elif error.errno in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
        remedy = "move away what is in its place, or choose another folder"
    elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        remedy = "choose a folder that you may write to"
    else:
        remedy = "free some space there, or choose another folder"
    return OSError(f"{path} could not be written ({error.strerror or error}): {remedy}")


def _remove_quietly(path: Path) -> None:
    # The error that led here is the one to report.
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return


def _check_picture(image: np.ndarray) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f"a picture must be uint8 [height, width, 3], but is {image.dtype} {list(image.shape)}: use to_display"
        )


def _world_to_camera(world_from_camera: np.ndarray) -> np.ndarray:
    pose = np.asarray(world_from_camera, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or abs(np.linalg.det(pose)) < 1e-12:
        raise ValueError(f"world_from_camera must be an invertible [4, 4] matrix, but is {pose.tolist()}")
    return np.ascontiguousarray(np.linalg.inv(pose).T, np.float32)


def _channels_of_layers(layers: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Checked planes [height, width] by channel name."""
    if not layers:
        raise ValueError("an EXR file needs at least one layer, none came: pass color")
    size = next(iter(layers.values())).shape[:2]
    channels = {}
    for name, layer in layers.items():
        names = LAYER_CHANNELS.get(name, (name,) if layer.ndim == 2 else tuple(f"{name}.{c}" for c in "RGB"))
        shape = size if len(names) == 1 else (*size, len(names))
        if layer.shape != shape or len(size) != 2 or 0 in size:
            raise ValueError(f"layer {name!r} has the shape {list(layer.shape)}, expected {list(shape)}: see write_exr")
        if name == "segmentation":
            if layer.dtype.kind not in "iu" or max(layer.max(), -int(layer.min())) > LARGEST_EXACT_INTEGER:
                raise ValueError("layer 'segmentation' must be integers of at most 2^24: pass ids and types of objects")
        elif layer.dtype.kind != "f" or np.isnan(layer).any():
            raise ValueError(
                f"layer {name!r} holds NaN or is not of floats: mend the renderer's input, nothing was written"
            )
        half = len(names) == 3
        for index, channel in enumerate(names):
            plane = layer if layer.ndim == 2 else layer[..., index]
            if half:
                plane = np.clip(plane, -LARGEST_HALF, LARGEST_HALF)
            channels[channel] = np.ascontiguousarray(plane, np.float16 if half else np.float32)
    return channels


def _check_exr_header(path: Path, header: dict[str, Any]) -> None:
    if header.get("type") not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise ValueError(f"{path} is a deep image, which cannot be read: flatten it first")
    low, high = (corner.astype(np.int64) for corner in header["dataWindow"])
    width, height = (high - low + 1).tolist()
    wanted = width * height * len(header["channels"]) * np.dtype(np.float32).itemsize
    if width < 1 or height < 1 or wanted > LARGEST_EXR_BYTES:
        raise ValueError(
            f"{path} claims {width} x {height} pixels of {len(header['channels'])} channels, more than 2 GiB or none: "
            "write it again, or smaller"
        )
    if any(channel.xSampling != 1 or channel.ySampling != 1 for channel in header["channels"]):
        raise ValueError(f"{path} has channels at reduced resolution, which cannot be read: save it as RGB")


def _layers_of_channels(planes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    layers = {}
    left = dict(planes)
    for prefix in dict.fromkeys(name.rpartition(".")[0] for name in planes):
        # Without a prefix, Z is depth and not the third part of a vector.
        for letters in ("RGB", "XYZ") if prefix else ("RGB",):
            names = [f"{prefix}.{letter}" if prefix else letter for letter in letters]
            if all(name in left for name in names):
                layers[prefix or "color"] = np.stack([left.pop(name).astype(np.float32) for name in names], axis=-1)
                break
    segmentation = LAYER_CHANNELS["segmentation"]
    if all(name in left for name in segmentation):
        layers["segmentation"] = np.stack([left.pop(name).astype(np.int32) for name in segmentation], axis=-1)
    for name, plane in left.items():
        layers["depth" if name == "Z" else name] = plane.astype(np.float32)
    return layers


def _open_video_stream(container: Any, rate: Fraction, width: int, height: int) -> Any:
    options = {"crf": str(VIDEO_QUALITY), "threads": str(VIDEO_THREADS)}
    stream = container.add_stream("libx264", rate=rate, options=options)
    stream.width, stream.height = width + width % 2, height + height % 2
    stream.pix_fmt = "yuv420p"
    context = stream.codec_context
    context.color_primaries = context.color_trc = context.colorspace = BT709
    context.color_range = LIMITED_RANGE
    return stream


def _video_frame(image: np.ndarray) -> Any:
    height, width = image.shape[:2]
    even = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
    return frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")

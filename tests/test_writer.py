"""EXR, PNG and video files: what comes back is what went in, and a failure leaves nothing behind."""

import resource
import signal
import struct
from fractions import Fraction

import av
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from warp_psf.film import writer
from warp_psf.film.writer import (
    contact_sheet,
    image_difference,
    read_exr,
    read_png,
    replacing,
    sheet_indices,
    write_exr,
    write_png,
    write_video,
)


def make_layers(height=23, width=37):
    generator = np.random.default_rng(3)
    colours = {name: generator.random((height, width, 3), np.float32) * 4 for name in ("color", "direct", "albedo")}
    normal = generator.standard_normal((height, width, 3)).astype(np.float32)
    depth = generator.random((height, width), np.float32) * 100
    segmentation = generator.integers(-1, 70000, (height, width, 2), dtype=np.int32)
    return {**colours, "normal": normal, "depth": depth, "segmentation": segmentation}


def make_pictures(count, height=48, width=64):
    rows, columns = np.mgrid[0:height, 0:width]
    smooth = [np.stack([rows + 3 * i, columns + 2 * i, rows + columns], axis=-1) for i in range(count)]
    return [(picture % 256).astype(np.uint8) for picture in smooth]


@pytest.fixture
def small_files():
    """Writing past 10 kB fails with the system's own error, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    signal.signal(signal.SIGXFSZ, handler)


def test_exr_round_trip(tmp_path):
    layers = make_layers()
    write_exr(tmp_path / "frame.exr", layers)
    back = read_exr(tmp_path / "frame.exr")
    assert sorted(back) == sorted(layers)
    for name in ("color", "direct", "albedo", "normal"):
        assert back[name].dtype == np.float32
        np.testing.assert_array_equal(back[name], layers[name].astype(np.float16))
    np.testing.assert_array_equal(back["depth"], layers["depth"])
    np.testing.assert_array_equal(back["segmentation"], layers["segmentation"])
    assert back["segmentation"].dtype == np.int32
    assert [path.name for path in tmp_path.iterdir()] == ["frame.exr"]


def test_exr_channels_and_attributes(tmp_path):
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    world_from_camera[:3, 3] = [1, 2, 3]
    path = tmp_path / "frame.exr"
    write_exr(path, make_layers(), frames_per_second=30000 / 1001, world_from_camera=world_from_camera)

    file = OpenEXR.File(str(path), separate_channels=True)
    types = {name: channel.pixels.dtype.name for name, channel in file.channels().items()}
    halves = [
        *"RGB",
        *(f"{layer}.{c}" for layer in ("direct", "albedo") for c in "RGB"),
        *(f"normal.{c}" for c in "XYZ"),
    ]
    singles = ["Z", "segmentation.id", "segmentation.type"]
    assert types == {**dict.fromkeys(halves, "float16"), **dict.fromkeys(singles, "float32")}

    header = file.header()
    assert header["framesPerSecond"] == Fraction(30000, 1001)
    assert header["chromaticities"] == pytest.approx((0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290))
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    point = np.array([0.3, -0.7, 5.0, 1.0])
    # Row vectors: p_camera = p_world M.
    np.testing.assert_allclose((world_from_camera @ point) @ header["worldToCamera"], point, atol=1e-6)
    # The sixteen numbers lie in the file row by row, the translation last.
    data = path.read_bytes()
    start = data.index(b"worldToCamera\0m44f\0") + len(b"worldToCamera\0m44f\0") + 4
    assert struct.unpack("<16f", data[start : start + 64]) == pytest.approx(np.linalg.inv(world_from_camera).T.ravel())


def test_half_layers_are_cut_at_their_range_and_depth_is_not(tmp_path):
    color = np.full((2, 2, 3), [1e6, -np.inf, 65504.0], np.float32)
    write_exr(tmp_path / "a.exr", {"color": color, "depth": np.full((2, 2), np.inf, np.float32)})
    back = read_exr(tmp_path / "a.exr")
    assert back["color"][0, 0].tolist() == [65504.0, -65504.0, 65504.0]
    assert np.isinf(back["depth"]).all()


@pytest.mark.parametrize("name", ["color", "albedo", "normal", "depth"])
def test_nan_is_refused_by_layer(tmp_path, name):
    layers = make_layers()
    layers[name][5, 6] = np.nan
    with pytest.raises(ValueError, match=f"'{name}' holds NaN"):
        write_exr(tmp_path / "a.exr", layers)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ({}, "at least one layer"),
        ({"color": np.zeros((4, 4), np.float32)}, "'color' has the shape"),
        ({"color": np.zeros((0, 4, 3), np.float32)}, "'color' has the shape"),
        ({"color": np.zeros((4, 4, 3), np.float32), "depth": np.zeros((4, 5), np.float32)}, "'depth' has the shape"),
        ({"color": np.zeros((4, 4, 3), np.uint8)}, "'color'.*floats"),
        ({"segmentation": np.zeros((4, 4, 2), np.float32)}, "integers"),
        ({"segmentation": np.full((4, 4, 2), -(2**31), np.int32)}, "integers"),
    ],
)
def test_layers_of_wrong_shape_are_named(tmp_path, layers, message):
    with pytest.raises(ValueError, match=message):
        write_exr(tmp_path / "a.exr", layers)


def test_bad_rate_and_pose_are_named(tmp_path):
    layers = {"color": np.zeros((2, 2, 3), np.float32)}
    for rate in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="frames_per_second"):
            write_exr(tmp_path / "a.exr", layers, frames_per_second=rate)
    for pose in (np.eye(3), np.zeros((4, 4)), np.full((4, 4), np.nan)):
        with pytest.raises(ValueError, match="world_from_camera"):
            write_exr(tmp_path / "a.exr", layers, world_from_camera=pose)


def test_exr_of_other_programs(tmp_path):
    generator = np.random.default_rng(5)
    names = ["R", "G", "B", "A", "Z", "N.X", "N.Y", "N.Z", "ao.Y"]
    planes = {name: generator.random((6, 7), np.float32) for name in names}
    path = str(tmp_path / "other.exr")
    OpenEXR.File({"type": OpenEXR.scanlineimage, "compression": OpenEXR.PIZ_COMPRESSION}, dict(planes)).write(path)
    back = read_exr(path)
    assert sorted(back) == ["A", "N", "ao.Y", "color", "depth"]
    np.testing.assert_array_equal(back["N"][..., 1], planes["N.Y"])
    np.testing.assert_array_equal(back["depth"], planes["Z"])


def test_damaged_exr_is_refused(tmp_path):
    path = tmp_path / "a.exr"
    write_exr(path, make_layers(90, 120))
    whole = path.read_bytes()
    with pytest.raises(FileNotFoundError, match="not there"):
        read_exr(tmp_path / "b.exr")
    for data in (b"", b"no picture", whole[:200], whole[: len(whole) * 9 // 10]):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"a\.exr"):
            read_exr(path)
    # A header that claims 2^30 x 2^30 pixels is refused before memory is asked for.
    start = whole.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    for corner in ((2**30, 2**30), (2**31 - 1, 0), (40_000, 40_000)):
        path.write_bytes(whole[: start + 8] + struct.pack("<2i", *corner) + whole[start + 16 :])
        with pytest.raises(ValueError, match=r"a\.exr"):
            read_exr(path)


def test_png_round_trip(tmp_path):
    picture = make_pictures(1)[0]
    write_png(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), picture)
    with Image.open(tmp_path / "a.png") as image:
        assert image.info["srgb"] == 0
    with pytest.raises(ValueError, match="uint8"):
        write_png(tmp_path / "b.png", picture.astype(np.float32))
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"a\.png"):
        read_png(tmp_path / "a.png")


@pytest.mark.parametrize(("height", "width", "count"), [(48, 64, 30), (35, 51, 5), (36, 64, 1), (1, 1, 2)])
def test_video_plays_everywhere(tmp_path, height, width, count):
    pictures = make_pictures(count, height, width)
    write_video(tmp_path / "film.mp4", iter(pictures), Fraction(30000, 1001))
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        assert (context.width, context.height) == (width + width % 2, height + height % 2)
        assert (context.color_primaries, context.color_trc, context.colorspace, context.color_range) == (1, 1, 1, 1)
        assert stream.average_rate == Fraction(30000, 1001)
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(frames) == count
    data = (tmp_path / "film.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_video_colours_are_bt709_and_padding_repeats_the_edge(tmp_path):
    picture = np.full((33, 33, 3), [200, 60, 30], np.uint8)
    write_video(tmp_path / "film.mp4", [picture], 24)
    with av.open(str(tmp_path / "film.mp4")) as container:
        planes = next(container.decode(video=0)).to_ndarray()
    red, green, blue = picture[0, 0] / 255
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    np.testing.assert_allclose(planes[:34], 16 + 219 * luma, atol=2.0)
    np.testing.assert_allclose(planes[34:].ravel()[0], 128 + 224 * (blue - luma) / 1.8556, atol=2.0)
    np.testing.assert_allclose(planes.ravel()[-1], 128 + 224 * (red - luma) / 1.5748, atol=2.0)


def test_video_of_nothing_or_of_two_sizes_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no pictures"):
        write_video(tmp_path / "film.mp4", [], 24)
    with pytest.raises(ValueError, match="picture 1"):
        write_video(tmp_path / "film.mp4", [*make_pictures(1), *make_pictures(1, 20, 20)], 24)
    assert not list(tmp_path.iterdir())


def test_contact_sheet_layout():
    pictures = [np.full((90, 160, 3), 10 * i, np.uint8) for i in range(25)]
    sheet = contact_sheet(pictures)
    gap = writer.SHEET_GAP
    assert sheet.shape == (4 * (90 + gap) + gap, 4 * (160 + gap) + gap, 3)
    assert (sheet[gap + 5, gap + 5] == 0).all()
    assert (sheet[-gap - 5, -gap - 5] == 240).all()
    assert (sheet[0] == writer.SHEET_BACKGROUND).all()
    assert contact_sheet([np.zeros((540, 960, 3), np.uint8)]).shape == (270 + 2 * gap, 480 + 2 * gap, 3)
    assert [len(sheet_indices(count)) for count in (1, 3, 4, 6, 13, 16, 500)] == [1, 3, 4, 4, 12, 16, 16]
    assert sheet_indices(500)[0] == 0
    assert sheet_indices(500)[-1] == 499
    with pytest.raises(ValueError, match="one size"):
        contact_sheet([*make_pictures(1), *make_pictures(1, 20, 20)])
    with pytest.raises(ValueError, match="give one or more"):
        contact_sheet([])


def test_image_difference():
    a = np.zeros((2, 2, 3), np.float32)
    b = a.copy()
    b[0, 0] = [3.0, 4.0, 0.0]
    assert image_difference(a, b) == pytest.approx({"rmse": np.sqrt(25 / 12), "maximum": 4.0, "mean_absolute": 7 / 12})
    assert image_difference(np.uint8([[250]]), np.uint8([[5]]))["maximum"] == 245
    with pytest.raises(ValueError, match="shapes"):
        image_difference(a, b[:1])
    with pytest.raises(ValueError, match="PNG with PNG"):
        image_difference(a, b.astype(np.uint8))


def write_each(folder):
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    return {
        "a.exr": lambda: write_exr(folder / "a.exr", make_layers(200, 200)),
        "a.png": lambda: write_png(folder / "a.png", noise),
        "a.mp4": lambda: write_video(folder / "a.mp4", [np.roll(noise, i * 17) for i in range(8)], 24),
    }


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.mp4"])
def test_full_disk_leaves_the_old_file_and_says_so(tmp_path, small_files, name):
    (tmp_path / name).write_bytes(b"old")
    with pytest.raises(OSError, match=rf"{name} could not be written \(File too large\): free some space"):
        write_each(tmp_path)[name]()
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.mp4"])
def test_folder_that_is_not_there(tmp_path, name):
    with pytest.raises(OSError, match=rf"{name} could not be written \(No such file or directory\): create its folder"):
        write_each(tmp_path / "none")[name]()
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=rf"{name} could not be written \(Not a directory\): move away"):
        write_each(tmp_path / "file")[name]()


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, RuntimeError])
def test_interruption_removes_the_temporary(tmp_path, interruption):
    with pytest.raises(interruption), replacing(tmp_path / "a.bin") as temporary:
        temporary.write_bytes(b"half")
        raise interruption

    def pictures():
        yield from make_pictures(3)
        raise interruption

    with pytest.raises(interruption):
        write_video(tmp_path / "a.mp4", pictures(), 24)
    assert not list(tmp_path.iterdir())

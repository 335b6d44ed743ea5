"""The cache on disk: what is kept comes back, and whatever else lies there is said and never trusted."""

import hashlib
import io
import multiprocessing
import os
import warnings
import zipfile

import numpy as np
import pytest

import warp_psf as psf
from warp_psf.field.store import cache_folder, load_arrays, save_arrays, store_key

ARRAYS = {
    "codes": np.arange(24, dtype=np.uint8).reshape(4, 6),
    "radius": np.array(0.5),
    "step": np.linspace(0, 1, 5, dtype=np.float32),
}
# A closed body without a closed form, as small as can be.
VERTICES = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.5]], np.float32) * 0.1
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def cheap_bake(monkeypatch):
    """Few rays: what is tested here is what is kept, not how good it is."""
    monkeypatch.setattr("warp_psf.bake.visibility.RAYS", ((0.0, 8),))
    monkeypatch.setattr("warp_psf.bake.visibility.RAYS_INSIDE_TEST", 3)
    monkeypatch.setattr("warp_psf.bake.transfer.RAYS_PER_VERTEX", 8)


def tetrahedron():
    return psf.make_mesh("tetrahedron", VERTICES, FACES)


def only_file(folder):
    (path,) = folder.iterdir()
    return path


def sealed(content: bytes) -> bytes:
    """A file with a right magic word and a right sum over any content."""
    return b"WPSFv1\n\0" + hashlib.sha256(content).digest() + content


def archive(**arrays) -> bytes:
    payload = io.BytesIO()
    np.savez(payload, **arrays)
    return payload.getvalue()


def assert_same_field(a, b):
    for name in ("center", "resolutions", "codes", "minimum", "step"):
        np.testing.assert_array_equal(getattr(a.field, name), getattr(b.field, name))
        assert getattr(a.field, name).dtype == getattr(b.field, name).dtype
    assert a.field.radius == b.field.radius


def test_arrays_come_back(folder):
    assert load_arrays("k") is None
    save_arrays("k", ARRAYS)
    found = load_arrays("k")
    assert found is not None
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
    assert [path.name for path in folder.iterdir()] == ["k.field"]


def test_the_folder_follows_the_environment(monkeypatch, tmp_path):
    assert cache_folder() == tmp_path / "cache"
    monkeypatch.delenv("WARP_PSF_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "warp_psf"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "warp_psf"


def test_a_key_changes_with_whatever_goes_in():
    a = np.arange(6, dtype=np.float32)
    keys = [
        store_key({"order": 4}, a),
        store_key({"order": 5}, a),
        store_key({"order": 4, "threshold": None}, a),
        store_key({"order": 4}, a + np.float32(1e-6)),
        store_key({"order": 4}, a.astype(np.float64)),
        store_key({"order": 4}, a.reshape(2, 3)),
        store_key({"order": 4}, a.view(np.int32)),
        store_key({"order": 4}, a, a),
        store_key({"order": 4}, a[:3], a[3:]),
        store_key({"order": 4}),
    ]
    assert len(set(keys)) == len(keys)
    assert store_key({"b": 1, "a": 2}, a) == store_key({"a": 2, "b": 1}, a.copy())
    # The layout in memory is not what an array is.
    assert store_key({}, np.arange(6).reshape(2, 3)) == store_key({}, np.asfortranarray(np.arange(6).reshape(2, 3)))


DAMAGE = [
    *("truncated", "cut to its head", "empty", "altered", "lengthened", "wrong magic", "foreign", "no archive"),
    *("bare array", "a pickle", "objects", "compressed", "promises more than it holds"),
]


def damaged(name: str, good: bytes) -> bytes:
    middle = len(good) // 2
    return {
        "truncated": good[:middle],
        "cut to its head": good[:20],
        "empty": b"",
        "altered": good[:middle] + bytes([good[middle] ^ 1]) + good[middle + 1 :],
        "lengthened": good + b"\0",
        "wrong magic": b"WPSFv0\n\0" + good[8:],
        "foreign": b"PK\3\4 not a field at all",
        "no archive": sealed(b"hello"),
        "bare array": sealed(_bare_array()),
        "a pickle": sealed(b"\x80\x04\x95\x00."),
        "objects": sealed(archive(codes=np.array([{"a": 1}], dtype=object))),
        "compressed": sealed(_compressed()),
        "promises more than it holds": sealed(_boastful()),
    }[name]


def _bare_array() -> bytes:
    payload = io.BytesIO()
    np.save(payload, np.arange(3))
    return payload.getvalue()


def _compressed() -> bytes:
    payload = io.BytesIO()
    np.savez_compressed(payload, codes=np.zeros(100000))
    return payload.getvalue()


def _boastful() -> bytes:
    """A faultless archive of an array whose header says more numbers than follow it."""
    bare = _bare_array()
    boast = bare.replace(b"(3,), }     ", b"(900000,), }")
    assert boast != bare
    payload = io.BytesIO()
    with zipfile.ZipFile(payload, "w") as file:
        file.writestr("codes.npy", boast)
    return payload.getvalue()


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_is_said_and_not_used(folder, name):
    save_arrays("k", ARRAYS)
    path = only_file(folder)
    path.write_bytes(damaged(name, path.read_bytes()))
    with pytest.warns(UserWarning, match="is damaged") as said:
        assert load_arrays("k") is None
    assert len(said) == 1
    assert str(path) in str(said[0].message)


def test_nothing_is_unpickled(folder):
    folder.mkdir()

    class Bomb:
        def __reduce__(self):
            return (os.mkdir, (str(folder / "exploded"),))

    (folder / "k.field").write_bytes(sealed(archive(codes=np.array([Bomb()], dtype=object))))
    with pytest.warns(UserWarning, match="is damaged"):
        assert load_arrays("k") is None
    assert not (folder / "exploded").exists()


def test_a_huge_file_is_not_read(folder):
    folder.mkdir()
    with open(folder / "k.field", "wb") as file:
        file.truncate(2**31)  # a hole: it takes no space
    with pytest.warns(UserWarning, match="larger than any field"):
        assert load_arrays("k") is None


def test_a_folder_in_the_place_of_the_file_is_said(folder):
    (folder / "k.field").mkdir(parents=True)
    with pytest.warns(UserWarning, match="is damaged"):
        assert load_arrays("k") is None
    with pytest.warns(UserWarning, match="could not be kept"):
        save_arrays("k", ARRAYS)
    assert [path.name for path in folder.iterdir()] == ["k.field"]


def test_a_folder_that_cannot_be_written_is_said(folder):
    folder.write_text("a file where the cache's folder should be")
    assert load_arrays("k") is None
    with pytest.warns(UserWarning, match="set WARP_PSF_CACHE"):
        save_arrays("k", ARRAYS)


@pytest.mark.parametrize("name", ["truncated", "altered", "wrong magic"])
def test_a_bake_mends_a_damaged_file(folder, cheap_bake, name):
    baked = psf.bake_mesh(tetrahedron(), 2)
    path = only_file(folder)
    good = path.read_bytes()
    path.write_bytes(damaged(name, good))
    with pytest.warns(UserWarning, match="is damaged"):
        again = psf.bake_mesh(tetrahedron(), 2)
    assert_same_field(again, baked)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same_field(psf.bake_mesh(tetrahedron(), 2), baked)


def test_a_bake_survives_a_folder_that_cannot_be_written(folder, cheap_bake):
    folder.write_text("a file where the cache's folder should be")
    with pytest.warns(UserWarning, match="could not be kept"):
        assert psf.bake_mesh(tetrahedron(), 2).field is not None


WRONG = {
    "codes": lambda a: a[:-1],
    "surface": lambda a: a[:, :3],
    "resolutions": lambda a: a * 0 + 12,
    "minimum": lambda a: a.astype(np.float64),
    "step": lambda a: a * np.nan,
}


@pytest.mark.parametrize("name", WRONG)
def test_a_well_formed_file_of_wrong_arrays_is_not_used(folder, cheap_bake, name):
    baked = psf.bake_mesh(tetrahedron(), 2)
    path = only_file(folder)
    arrays = load_arrays(path.stem)
    assert arrays is not None
    for content in ({**arrays, name: WRONG[name](arrays[name])}, {k: v for k, v in arrays.items() if k != name}):
        save_arrays(path.stem, content)
        with pytest.warns(UserWarning, match=f"wrong '{name}'"):
            again = psf.bake_mesh(tetrahedron(), 2)
        assert_same_field(again, baked)


def test_other_resolutions_and_foreign_arrays_are_not_used(folder, cheap_bake):
    psf.bake_mesh(tetrahedron(), 2)
    path = only_file(folder)
    arrays = load_arrays(path.stem)
    assert arrays is not None
    other = arrays["resolutions"].copy()
    other[0] = 64 if other[0] != 64 else 8  # a power of two, but the samples do not add up
    for content in ({**arrays, "resolutions": other}, {**arrays, "other": np.zeros(3)}, {}):
        save_arrays(path.stem, content)
        with pytest.warns(UserWarning, match="wrong"):
            assert psf.bake_mesh(tetrahedron(), 2).field is not None


def test_another_setting_is_another_file(folder, cheap_bake):
    psf.bake_mesh(tetrahedron(), 2)
    psf.bake_mesh(tetrahedron(), 3)
    psf.bake_mesh(tetrahedron(), 2, threshold=0.02)
    psf.bake_mesh(psf.make_mesh("tetrahedron", VERTICES * np.float32([1.5, 1, 1]), FACES), 2)
    assert len(list(folder.iterdir())) == 4
    psf.bake_mesh(psf.make_mesh("the same under another name", VERTICES, FACES), 2)
    psf.bake_mesh(tetrahedron(), 4, use_cache=False)
    assert len(list(folder.iterdir())) == 4


def test_a_shape_is_kept_once_whatever_its_size_and_place(folder, cheap_bake):
    baked = psf.bake_mesh(tetrahedron(), 2)
    moved = psf.make_mesh("large", VERTICES * np.float32(3.7) + np.float32([0.1, -0.2, 0.3]), FACES)
    large = psf.bake_mesh(moved, 2)
    only_file(folder)
    assert baked.field is not None and large.field is not None
    for name in ("resolutions", "codes", "minimum", "step"):
        np.testing.assert_array_equal(getattr(large.field, name), getattr(baked.field, name))
    np.testing.assert_allclose(large.field.center, moved.center, rtol=1e-6)
    assert large.field.radius == pytest.approx(3.7 * baked.field.radius, rel=1e-6)


@pytest.mark.parametrize(
    "turn",
    [
        np.diag([1.0, 1.0, -1.0]),  # a mirror image: turned inside out as well
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        np.diag([1.0, 1.0, 1.001]),
    ],
    ids=["mirrored", "turned", "stretched"],
)
def test_another_shape_is_kept_apart(folder, cheap_bake, turn):
    baked = psf.bake_mesh(tetrahedron(), 2)
    faces = FACES if np.linalg.det(turn) > 0 else FACES[:, ::-1]
    other = psf.bake_mesh(psf.make_mesh("other", (VERTICES @ turn.T).astype(np.float32), faces), 2)
    assert baked.field is not None and other.field is not None
    assert len(list(folder.iterdir())) == 2
    assert (other.field.minimum != baked.field.minimum).any()


def test_a_shape_is_told_from_another_of_the_same_key(folder, cheap_bake, monkeypatch):
    monkeypatch.setattr("warp_psf.bake.shape.MOMENT_STEP", 1e6)  # every shape of these faces has the same key
    baked = psf.bake_mesh(tetrahedron(), 2)
    longer = psf.make_mesh("longer", VERTICES * np.float32([1, 1, 1.2]), FACES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing is damaged
        other = psf.bake_mesh(longer, 2)
    only_file(folder)
    assert baked.field is not None and other.field is not None
    assert (other.field.minimum != baked.field.minimum).any()
    assert_same_field(other, psf.bake_mesh(longer, 2, use_cache=False))


def _bake_in_child(barrier, results):
    from warp_psf.bake import visibility

    visibility.RAYS, visibility.RAYS_INSIDE_TEST = ((0.0, 8),), 3
    barrier.wait()
    field = psf.bake_mesh(tetrahedron(), 2).field
    assert field is not None
    results.put(hashlib.sha256(field.codes.tobytes()).hexdigest())


def test_two_processes_that_bake_the_same_body_do_no_harm(folder, cheap_bake):
    context = multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(2), context.Queue()
    children = [context.Process(target=_bake_in_child, args=(barrier, results)) for _ in range(2)]
    for child in children:
        child.start()
    found = {results.get(timeout=60) for _ in children}
    for child in children:
        child.join(60)
        assert child.exitcode == 0
    assert len(found) == 1
    assert only_file(folder).suffix == ".field"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        field = psf.bake_mesh(tetrahedron(), 2).field
    assert field is not None
    assert hashlib.sha256(field.codes.tobytes()).hexdigest() in found

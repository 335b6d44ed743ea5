"""The cache on disk: arrays under a key made of everything they were computed from.

A file is a magic word, the SHA-256 of the rest, and a NumPy archive that is read with pickling off: nothing in it is
executed. A file that is cut short or altered does not match its sum; it is reported and computed again.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import tempfile
import warnings
import zipfile
from pathlib import Path

import numpy as np

_MAGIC = b"WPSFv1\n\0"
_DIGEST_BYTES = 32
# Larger than any field this library writes (at most 5 MB each, transfers of a million vertices 300 MB).
_MOST_BYTES = 2**30


def cache_folder() -> Path:
    """Where fields are kept: $WARP_PSF_CACHE, else $XDG_CACHE_HOME/warp_psf, else ~/.cache/warp_psf."""
    if chosen := os.environ.get("WARP_PSF_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "warp_psf"


def store_key(settings: dict, *arrays: np.ndarray) -> str:
    """A name for the result of computing with `settings` on `arrays`: equal input, equal name."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:40]


def save_arrays(key: str, arrays: dict[str, np.ndarray]) -> None:
    """Keeps arrays under a key. Readers and writers in other processes see the whole file or none.

    A cache that cannot be written (full disk, read-only folder) is worth a warning, not the loss of the result.
    """
    payload = io.BytesIO()
    np.savez(payload, **arrays)
    content = payload.getvalue()
    if len(_MAGIC) + _DIGEST_BYTES + len(content) > _MOST_BYTES:
        return  # it would be refused when read
    folder = cache_folder()
    temporary = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(prefix=f".{key}-", dir=folder)
        with os.fdopen(descriptor, "wb") as file:
            file.write(_MAGIC + hashlib.sha256(content).digest() + content)
        os.replace(temporary, _path(key))
        temporary = None
    except OSError as error:
        warnings.warn(
            f"the field could not be kept in {folder} ({error.strerror}) and will be baked again next time; "
            "set WARP_PSF_CACHE to a folder that can be written",
            stacklevel=2,
        )
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def load_arrays(key: str) -> dict[str, np.ndarray] | None:
    """The arrays kept under a key, or None when there are none or the file is damaged (which is said)."""
    path = _path(key)
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError("it is larger than any field")
        content = path.read_bytes()
        head = len(_MAGIC) + _DIGEST_BYTES
        if content[: len(_MAGIC)] != _MAGIC:
            raise ValueError("it does not begin as a field does")
        if hashlib.sha256(content[head:]).digest() != content[len(_MAGIC) : head]:
            raise ValueError("its check sum does not match")
        return _read_archive(content[head:])
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        warnings.warn(f"the cached field {path} is damaged ({error}); it is baked again", stacklevel=2)
        return None


def _read_archive(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of an archive; a ValueError when it is not one that `save_arrays` writes."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            arrays = {}
            for entry in archive.infolist():
                # Stored as it is, an array is never larger than the file, whatever its header says.
                if entry.compress_type != zipfile.ZIP_STORED:
                    raise ValueError(f"{entry.filename} is compressed")
                # Reading from memory checks the promised size against what is there, and unpickles nothing.
                array = np.lib.format.read_array(io.BytesIO(archive.read(entry)), allow_pickle=False)
                arrays[entry.filename.removesuffix(".npy")] = array
            return arrays
    except Exception as error:  # zipfile and NumPy meet a broken archive with many types of error
        raise ValueError(str(error) or type(error).__name__) from error


def _path(key: str) -> Path:
    return cache_folder() / f"{key}.field"

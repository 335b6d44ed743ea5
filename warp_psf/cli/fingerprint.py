"""Short sums of everything that frames are made from, so that a folder never mixes two runs."""

from __future__ import annotations

import hashlib
import os
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from warp_psf.cli.options import NO_ENVIRONMENT


def fingerprint(value: Any) -> str:
    """Twelve hexadecimal digits that change when any array or number in `value` does, however deep inside it lies."""
    digest = hashlib.sha256()
    _fold(value, digest)
    return digest.hexdigest()[:12]


def _fold(value: Any, digest: Any) -> None:
    if isinstance(value, (str, bytes, int, float, type(None), os.PathLike)):
        digest.update(repr(value).encode())
    elif hasattr(value, "tobytes"):
        digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    elif isinstance(value, dict):
        _fold(list(value.items()), digest)
    elif isinstance(value, (list, tuple)):
        for item in value:
            _fold(item, digest)
    else:
        # A dataclass, or MuJoCo's structures: MjModel, MjOption, MjVisual, whose public attributes are their content.
        names = [field.name for field in fields(value)] if is_dataclass(value) else dir(value)
        for name in names:
            content = None if name.startswith("_") else getattr(value, name)
            if not callable(content):
                _fold((name, content), digest)


def describe_environment(environment: Any) -> str:
    if environment is None:
        return NO_ENVIRONMENT
    if not isinstance(environment, (str, os.PathLike)):
        return fingerprint(environment)
    path = Path(environment)
    return f"{path.name} {fingerprint(path.read_bytes())}" if path.is_file() else str(environment)

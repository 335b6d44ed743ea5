"""Models: loading, names, and data that fits its model."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco


def load_model(path: str | os.PathLike) -> mujoco.MjModel:
    """The model of an MJCF or URDF file (.xml, .urdf), or of a compiled one (.mjb).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: MuJoCo cannot read it; the message carries MuJoCo's reason.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"model {str(path)!r} does not exist; give the path of an .xml, .urdf or .mjb file")
    load = mujoco.MjModel.from_binary_path if path.suffix.lower() == ".mjb" else mujoco.MjModel.from_xml_path
    try:
        return load(str(path))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"model {str(path)!r} cannot be loaded: {reason}") from error


def check_data(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Raises ValueError unless `data` was made for `model`, TypeError unless it is MuJoCo's."""
    if not isinstance(data, mujoco.MjData):
        raise TypeError(f"data is a {type(data).__name__}; give the mujoco.MjData of the model")
    sizes = {
        "nq": (model.nq, len(data.qpos)),
        "nv": (model.nv, len(data.qvel)),
        "nbody": (model.nbody, len(data.xpos)),
        "ngeom": (model.ngeom, len(data.geom_xpos)),
        "nlight": (model.nlight, len(data.light_xpos)),
        "ncam": (model.ncam, len(data.cam_xpos)),
    }
    different = [f"{name} {theirs} instead of {ours}" for name, (ours, theirs) in sizes.items() if ours != theirs]
    # The first MuJoCo 3.3 has no signature of a compiled model: there the sizes have to do.
    if not different and getattr(model, "signature", None) != getattr(data, "signature", None):
        different = ["another signature"]
    if different:
        raise ValueError(f"data is of another model ({', '.join(different)}); make it with mujoco.MjData(model)")


def label(model: mujoco.MjModel, kind: str, index: int) -> str:
    """The name of an object for messages: its own, or what it is and its number."""
    own = mujoco.mj_id2name(model, mujoco.mju_str2Type(kind), index)
    return own or f"{kind} {index}"

"""Light templates: shapes that an area light may take on a plane of samples (Jeng 2005, 3.4.1 and figure 15).

Each is float32 [rows, columns]: the share of each sample's cell that the shape covers, so that a shape can move by less
than a cell and keep its light. Times a radiance it is what `warp_psf.area_light.SlabView` takes.
"""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

# Letters are drawn so many times as large as they are shown.
FINER = 8


def square(rows: int, columns: int, side: float = 0.5, at: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A square about a point of the plane.

    Args:
        rows, columns: of the plane's samples.
        side: in shares of the plane's shorter side.
        at: the middle, right and up, from -1 to 1 across the plane.
    """
    x, y = _places(rows, columns, at)
    reach = side * min(rows, columns) / 2.0
    return (_overlap(x, reach) * _overlap(y, reach)).astype(np.float32)


def line(rows: int, columns: int, angle: float = 0.0, at: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A line of one sample's width across the plane, with soft rims.

    Args:
        rows, columns: of the plane's samples.
        angle: to the plane's rows, radians, counter-clockwise where row 0 is the uppermost.
        at: a point that it goes through, right and up, from -1 to 1 across the plane.
    """
    x, y = _places(rows, columns, at)
    return np.clip(1.0 - np.abs(y * np.cos(angle) - x * np.sin(angle)), 0.0, 1.0).astype(np.float32)


def ring(rows: int, columns: int, radius: float = 0.7, width: float = 0.25) -> np.ndarray:
    """A ring about the middle.

    Args:
        rows, columns: of the plane's samples.
        radius: of its middle line, in shares of half the plane's shorter side.
        width: across the line, in the same shares.
    """
    x, y = _places(rows, columns, (0.0, 0.0))
    half = min(rows, columns) / 2.0
    aside = np.abs(np.hypot(x, y) - radius * half)
    return np.clip(0.5 * width * half + 0.5 - aside, 0.0, 1.0).astype(np.float32)


def letters(rows: int, columns: int, text: str = "A") -> np.ndarray:
    """Letters as large as the plane allows.

    Args:
        rows, columns: of the plane's samples.
        text: what is written.

    Raises:
        ValueError: the text is empty.
    """
    if not text.strip():
        raise ValueError("the text of a light template is empty; give at least one letter")
    size = FINER * rows
    font = ImageFont.load_default(size)
    left, top, right, bottom = font.getbbox(text)
    sheet = Image.new("L", (int(right - left) + 2, int(bottom - top) + 2))
    ImageDraw.Draw(sheet).text((1 - left, 1 - top), text, fill=255, font=font)
    scale = min(columns / sheet.width, rows / sheet.height)
    shown = max(1, round(scale * sheet.width)), max(1, round(scale * sheet.height))
    small = np.asarray(sheet.resize(shown, Image.Resampling.BOX), np.float32) / 255.0
    template = np.zeros((rows, columns), np.float32)
    row, column = (rows - shown[1]) // 2, (columns - shown[0]) // 2
    template[row : row + shown[1], column : column + shown[0]] = small
    return template


def _places(rows: int, columns: int, at: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """How far each sample lies to the right of and above a point of the plane, in samples [rows, columns]."""
    x = np.arange(columns) + 0.5 - 0.5 * columns * (1.0 + at[0])
    y = 0.5 * rows * (1.0 - at[1]) - np.arange(rows) - 0.5
    return np.broadcast_to(x, (rows, columns)), np.broadcast_to(y[:, None], (rows, columns))


def _overlap(x: np.ndarray, reach: float) -> np.ndarray:
    """Which share of cells of width 1 about x lies within -reach and reach."""
    return np.clip(np.minimum(x + 0.5, reach) - np.maximum(x - 0.5, -reach), 0.0, 1.0)


SHAPES = {"square": square, "line": line, "ring": ring, "letters": letters}

"""Pictures as text, so that a record in JSON can hold what is to be looked at."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

COLOURS = 64  # of a picture: enough for drawings, and a third of the bytes
WIDTH = 150  # pixels, of lines of text


def png(picture: NDArray[np.uint8]) -> str:
    """A picture uint8 [H, W, 3] as PNG in base64; of many colours the most frequent are kept."""
    image = Image.fromarray(picture).quantize(COLOURS, dither=Image.Dither.NONE)
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def pixels(text: str) -> NDArray[np.uint8]:
    """The picture uint8 [H, W, 3] that :func:`png` made a text of; only for texts of our own."""
    with Image.open(io.BytesIO(base64.b64decode(text)), formats=["PNG"]) as image:
        return np.asarray(image.convert("RGB"))


def written(lines: Sequence[str]) -> NDArray[np.uint8]:
    """Lines of text as a picture, uint8 [H, W, 3]."""
    image = Image.new("RGB", (WIDTH, 8 + 14 * len(lines)), (250, 250, 250))
    ImageDraw.Draw(image).multiline_text((4, 4), "\n".join(lines), (45, 45, 45))
    return np.asarray(image)

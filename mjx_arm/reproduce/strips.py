"""Frames of an episode side by side as PNG, and moving ones as GIF."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjx_arm.envs.env import Env
from mjx_arm.kinematics import make_kinematics
from mjx_arm.render import rgb
from mjx_arm.varies import Params

_FONT_SIZE = 15
_LABEL = 22
_GAP = 4
_COLOURS = 128
_COLOURS_OF_FRAMES = 64
_AT_ONCE = 16

# `(qpos [K, nq], params)` -> `[K, H, W, 3] uint8`.
RenderFrames = Callable[[np.ndarray, Params], np.ndarray]


def make_frames(env: Env, *, edge: int | None = None) -> RenderFrames:
    """Makes the function that renders frames of an episode; it compiles once.

    Args:
      env: whose first camera looks.
      edge: of square images with shadows, pixels; None for exactly what the agent sees.
    """
    camera = env.config.cameras[0]
    options = {} if edge is None else {"size": (edge, edge), "shadows": True}
    looking = env.with_cameras(camera=camera, **options)
    kinematics = make_kinematics(env.scene.mj_model, env.varies)

    @jax.jit
    def render(qpos: jax.Array, params: Params) -> jax.Array:
        def one(qpos: jax.Array) -> jax.Array:
            return rgb(looking.render(qpos, kinematics(qpos, params), params)[0])

        return jax.lax.map(one, qpos)

    return functools.partial(_render_all, render)


def _render_all(
    render: Callable[[Any, Params], jax.Array], qpos: np.ndarray, params: Params
) -> np.ndarray:
    frames = []
    for start in range(0, len(qpos), _AT_ONCE):
        some = qpos[start : start + _AT_ONCE]
        # All parts have one length: another length would compile again.
        padded = np.concatenate([some, np.repeat(some[-1:], _AT_ONCE - len(some), axis=0)])
        frames.append(np.asarray(render(padded, params))[: len(some)])
    return np.concatenate(frames)


def enlarge(images: np.ndarray, edge: int) -> np.ndarray:
    """Images `[K, H, W, 3]` with each pixel repeated, so that they are `edge` pixels wide."""
    rows, columns = (np.arange(edge) * size // edge for size in images.shape[1:3])
    return images[:, rows][:, :, columns]


def strip(rows: Sequence[np.ndarray], labels: Sequence[Sequence[str]]) -> bytes:
    """Rows of images as one PNG, each image with a label below it.

    Args:
      rows: of images `[K, H, W, 3] uint8`, all of one size.
      labels: for each row as many texts as it has images; an empty row of labels takes no room.
    """
    height, width = rows[0].shape[1:3]
    font = ImageFont.load_default(_FONT_SIZE)
    most = max(map(len, rows))
    heights = [height + (_LABEL if texts else 0) + _GAP for texts in labels]
    sheet = Image.new("RGB", (most * (width + _GAP) - _GAP, sum(heights) - _GAP), "white")
    draw, top = ImageDraw.Draw(sheet), 0
    for images, texts, own in zip(rows, labels, heights, strict=True):
        for i, image in enumerate(images):
            sheet.paste(Image.fromarray(image), (i * (width + _GAP), top))
        for i, text in enumerate(texts):
            middle = (i * (width + _GAP) + width / 2, top + height + 3)
            draw.text(middle, text, fill="black", font=font, anchor="ma")
        top += own
    return png(sheet)


def png(image: Image.Image) -> bytes:
    """An image as PNG with at most 128 colours, so that a page of many stays small."""
    few = image.quantize(_COLOURS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    content = io.BytesIO()
    few.save(content, "PNG", optimize=True)
    return content.getvalue()


def animation(frames: np.ndarray, labels: Sequence[str], *, milliseconds: int) -> bytes:
    """Frames `[K, H, W, 3] uint8` as a GIF that repeats, each with a label in its corner."""
    font = ImageFont.load_default(_FONT_SIZE)
    images = []
    for frame, text in zip(frames, labels, strict=True):
        image = Image.fromarray(frame)
        draw = ImageDraw.Draw(image)
        draw.text((6, 4), text, fill="white", stroke_width=2, stroke_fill="black", font=font)
        images.append(
            image.quantize(
                _COLOURS_OF_FRAMES, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
            )
        )
    content = io.BytesIO()
    images[0].save(
        content, "GIF", save_all=True, append_images=images[1:], duration=milliseconds, loop=0
    )
    return content.getvalue()

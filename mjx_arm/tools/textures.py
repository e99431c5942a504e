"""Makes the texture images of the desk scene, the same ones at every call.

    python -m mjx_arm.tools.textures xml

They are files, so that MuJoCo's own renderer samples the same ones. All are square and continue at
their opposite edges.
"""

from __future__ import annotations

import argparse
import pathlib
import sys
from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image

EDGE = 128
# Larger, because the table is close to the camera and fills most of the image.
_TABLE_EDGE = 256

Texture = Callable[[], np.ndarray]


def wood() -> np.ndarray:
    """Planks along the first axis of the table, `[256, 256, 3] uint8`."""
    return _planks(seed=1, dark=(0.42, 0.27, 0.15), light=(0.66, 0.47, 0.29), planks=4)


def oak() -> np.ndarray:
    """Pale, fine-grained wood in one piece, `[256, 256, 3] uint8`."""
    return _planks(seed=2, dark=(0.62, 0.49, 0.34), light=(0.80, 0.68, 0.51), planks=1)


def plaster() -> np.ndarray:
    """A painted wall, `[128, 128, 3] uint8`."""
    share = _noise(3, (4, 4)) * 0.5 + _noise(4, (16, 16)) * 0.3 + _noise(5, (64, 64)) * 0.2
    return _ramp(share, (0.72, 0.72, 0.68), (0.86, 0.85, 0.80))


def cloth() -> np.ndarray:
    """Woven cloth, `[128, 128, 3] uint8`."""
    rows, columns = np.mgrid[:EDGE, :EDGE]
    weave = np.where((rows // 2 + columns // 2) % 2, 0.62, 0.38) + 0.5 * (_noise(6, (32, 32)) - 0.5)
    return _ramp(weave, (0.20, 0.30, 0.33), (0.42, 0.55, 0.58))


def stone() -> np.ndarray:
    """Speckled grey stone, `[128, 128, 3] uint8`."""
    share = _noise(7, (8, 8)) * 0.5 + _noise(8, (64, 64)) * 0.5
    return _ramp(share, (0.30, 0.31, 0.33), (0.66, 0.66, 0.64))


def checker() -> np.ndarray:
    """Eight by eight fields of two colours, `[128, 128, 3] uint8`."""
    rows, columns = np.mgrid[:EDGE, :EDGE] // (EDGE // 8)
    return _ramp(((rows + columns) % 2).astype(float), (0.25, 0.32, 0.42), (0.85, 0.83, 0.76))


def carton() -> np.ndarray:
    """One face of a carton, taped across, `[128, 128, 3] uint8`."""
    share = 0.6 * _noise(9, (4, 32)) + 0.4 * _noise(10, (64, 64))
    face = _ramp(share, (0.60, 0.44, 0.28), (0.72, 0.55, 0.37)).astype(float)
    middle = slice(EDGE // 2 - 10, EDGE // 2 + 10)
    face[middle] = 0.45 * face[middle] + 0.55 * np.asarray([196, 178, 140])
    for border in (slice(0, 3), slice(EDGE - 3, EDGE)):
        face[border] *= 0.8
        face[:, border] *= 0.8
    return face.round().astype(np.uint8)


TEXTURES: dict[str, Texture] = {
    texture.__name__: texture for texture in (wood, oak, plaster, cloth, stone, checker, carton)
}


def write_textures(folder: pathlib.Path) -> list[pathlib.Path]:
    """Writes every texture to `FOLDER/desk_NAME.png`, and returns the paths."""
    paths = []
    for name, texture in TEXTURES.items():
        paths.append(folder / f"desk_{name}.png")
        Image.fromarray(texture()).save(paths[-1], optimize=True)
    return paths


def _planks(seed: int, dark: Sequence[float], light: Sequence[float], planks: int) -> np.ndarray:
    """Grain along the columns, which is wavy, and in planks of different shades."""
    edge = _TABLE_EDGE
    rows, columns = np.mgrid[:edge, :edge] / edge
    plank = np.floor(rows * planks).astype(int) % planks
    random = np.random.RandomState(seed)
    shade, shift = random.uniform(0, 1, planks)[plank], random.uniform(0, 1, planks)[plank]
    wave = 0.03 * np.sin(2 * np.pi * (columns + shift)) + 0.05 * (_noise(seed + 20, (4, 8), edge))
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (12 * rows + 12 * wave + 3 * shift))
    grain = _noise(seed + 30, (64, 4), edge)
    share = 0.25 * rings + 0.35 * grain + 0.40 * (0.25 + 0.5 * shade)
    if planks > 1:
        joint = np.abs((rows * planks) % 1.0 - 0.5) > 0.5 - 0.012 * planks
        share = np.where(joint, 0.1 * share, share)
    # Few colours, so that the file is small.
    return _ramp(np.round(share * 31) / 31, dark, light)


def _noise(seed: int, cells: tuple[int, int], edge: int = EDGE) -> np.ndarray:
    """Smooth noise in 0..1 between random numbers on a grid, `[edge, edge]`, which repeats."""
    # Not a Generator: only the numbers of RandomState are promised never to change.
    values = np.random.RandomState(seed).uniform(0, 1, cells)
    steps = [np.arange(edge) * count / edge for count in cells]
    lower = [np.floor(step).astype(int) for step in steps]
    share = [step - low for step, low in zip(steps, lower, strict=True)]
    share = [x * x * (3 - 2 * x) for x in share]
    rows = [(lower[0] + i) % cells[0] for i in (0, 1)]
    columns = [(lower[1] + i) % cells[1] for i in (0, 1)]
    upper, under = (
        values[row][:, columns[0]] * (1 - share[1]) + values[row][:, columns[1]] * share[1]
        for row in rows
    )
    return upper * (1 - share[0][:, None]) + under * share[0][:, None]


def _ramp(share: np.ndarray, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Colours between two, `[H, W, 3] uint8`, from shares `[H, W]` and colours in 0..1."""
    share = np.clip(share, 0, 1)[..., None]
    colour = (1 - share) * np.asarray(low) + share * np.asarray(high)
    return np.round(255 * colour).astype(np.uint8)


def main() -> None:
    """Writes the textures into the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Writes the textures of the desk scene.")
    parser.add_argument("folder", type=pathlib.Path, help="where the scenes are")
    folder = parser.parse_args().folder
    if not folder.is_dir():
        parser.error(f"{folder} is not a folder")
    for path in write_textures(folder):
        sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    main()

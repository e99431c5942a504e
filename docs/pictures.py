"""Makes the pictures of the page about the renderer; needs no OpenGL.

python docs/pictures.py docs/images
"""

from __future__ import annotations

import pathlib
import sys

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from PIL import Image

import mjx_arm

# The row of the image that is cut, as a share of its height.
CUT = 0.42
EDGE = 64
FINE = 512


def main(folder: pathlib.Path) -> None:
    """Writes `outputs.png`, `background.png`, `inverse_depth.png` and `randomised.png`."""
    folder.mkdir(parents=True, exist_ok=True)
    env = mjx_arm.make("A", observation="state", joint_noise=12.0)
    _, state = jax.jit(env.reset)(jax.random.key(3))
    poses = state.physics.poses
    for name, draw in {
        "outputs": _draw_outputs,
        "background": _draw_background,
        "inverse_depth": _draw_inverse_depth,
    }.items():
        # Without the version of matplotlib, so that the same picture is the same file.
        figure = draw(env, poses)
        figure.savefig(folder / f"{name}.png", dpi=110, metadata={"Software": None})
    Image.fromarray(_draw_randomised()).save(folder / "randomised.png", optimize=True)


def _render(env: mjx_arm.Env, poses: object, **options: object) -> tuple[np.ndarray, np.ndarray]:
    """Packed pixels and depth."""
    render = mjx_arm.make_renderer(env.scene, depth=True, **options)
    packed, depth = render(poses.geom_xpos, poses.geom_xmat)
    return packed, np.asarray(depth)


def _draw_outputs(env: mjx_arm.Env, poses: object) -> Figure:
    packed, depth = _render(env, poses, size=(EDGE, EDGE))
    shadowed, _ = _render(env, poses, size=(EDGE, EDGE), shadows=True)
    ids = np.asarray(mjx_arm.segmentation(packed))
    colours = ListedColormap(np.random.default_rng(1).uniform(0.1, 1, (ids.max() + 2, 3)))
    figure, axes = _row(4)
    _show(axes[0], "rgb", np.asarray(mjx_arm.rgb(packed)))
    _show(axes[1], "segmentation", ids, cmap=colours, vmin=-1, vmax=ids.max())
    _show(axes[2], "depth", np.where(np.isfinite(depth), depth, np.nan), cmap="viridis", vmax=2.0)
    _show(axes[3], "shadows=True", np.asarray(mjx_arm.rgb(shadowed)))
    return figure


def _draw_background(env: mjx_arm.Env, poses: object) -> Figure:
    packed, _ = _render(env, poses, size=(4 * EDGE, 4 * EDGE))
    image, ids = np.asarray(mjx_arm.rgb(packed)), np.asarray(mjx_arm.segmentation(packed))
    model = env.scene.mj_model
    moves = (ids >= 0) & (model.body_weldid[model.geom_bodyid[np.maximum(ids, 0)]] != 0)
    # With the moving geoms far below the table only the background is left.
    away = np.asarray(poses.geom_xpos) + np.array([0.0, 0.0, -100.0], np.float32)
    render = mjx_arm.make_renderer(env.scene, size=(4 * EDGE, 4 * EDGE))
    background = np.asarray(mjx_arm.rgb(render(away, poses.geom_xmat)))
    figure, axes = _row(3)
    _show(axes[0], "rendered once", background)
    _show(axes[1], "rendered in each image", np.where(moves[..., None], image, 255))
    _show(axes[2], "the image", image)
    return figure


def _draw_inverse_depth(env: mjx_arm.Env, poses: object) -> Figure:
    packed, depth = _render(env, poses, size=(FINE, FINE))
    ids, row = np.asarray(mjx_arm.segmentation(packed)), round(CUT * FINE)
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 2))
    _show(left, "the row", np.asarray(mjx_arm.rgb(packed)))
    left.axhline(row, color="white", linewidth=1.5)
    for geom in np.unique(ids[row]):
        here = ids[row] == geom
        name = env.scene.mj_model.geom(int(geom)).name if geom >= 0 else "nothing"
        label = name or f"geom {geom}"
        right.plot(np.flatnonzero(here), 1 / depth[row, here], ".", markersize=3, label=label)
    right.set(title="1 / depth along the row", xlabel="pixel", ylabel="1 / m")
    right.legend(fontsize="small", markerscale=3, loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def _draw_randomised() -> np.ndarray:
    """Eight episodes of the desk scene: small images above larger ones, each in its own pixels."""
    strips = []
    for edge, zoom, samples in ((EDGE, 2, 1), (2 * EDGE, 1, 4)):
        env = mjx_arm.make(
            "B",
            scene="arm_cube_desk",
            physics="native",
            size=(edge, edge),
            samples=samples,
            shadows=True,
            randomisation="standard",
        )
        images, _ = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(12), 8))
        images = np.asarray(images).repeat(zoom, axis=1).repeat(zoom, axis=2)
        strips.append(np.concatenate([*images], axis=1))
    return np.concatenate(strips)


def _row(count: int) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(2.3 * count, 2.6), layout="constrained")
    return figure, figure.subplots(1, count)


def _show(axes: Axes, title: str, image: np.ndarray, **options: object) -> None:
    axes.imshow(image, interpolation="nearest", **options)
    axes.set(title=title, xticks=[], yticks=[])


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))

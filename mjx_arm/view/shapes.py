"""Triangles of the primitive shapes of a scene."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from mjx_arm.render.geoms import SUPPORTED_TYPES, geom_rgba, texture_of, visible_geoms
from mjx_arm.render.texture import mean_colour
from mjx_arm.varies import Params, Varies, fill

_ROUND = 24
# Half the edge of what is shown of an infinite plane, m.
_PLANE = 1.5


@dataclasses.dataclass(frozen=True)
class Shape:
    """One visible geom, in its own frame.

    Attributes:
      geom: its id.
      name: its name, or its id where it has none.
      vertices: `[V, 3] float32`, m.
      faces: `[F, 3] uint32`, counter-clockwise from outside.
      colour: red, green and blue, 0 to 255.
      opacity: 0 to 1.
    """

    geom: int
    name: str
    vertices: np.ndarray
    faces: np.ndarray
    colour: tuple[int, int, int]
    opacity: float


def make_shapes(
    mj_model: mujoco.MjModel, varies: Varies | None = None, params: Params | None = None
) -> list[Shape]:
    """The shapes of all geoms that the renderer shows.

    Args:
      mj_model: the model.
      varies: rows of the model that vary by episode.
      params: their values in this episode.
    """
    sizes = np.asarray(fill(mj_model, varies, params, "geom_size"))
    colours = geom_rgba(mj_model)
    varying = list((varies or {}).get("geom_rgba", ()))
    if varying:
        colours[varying] = np.asarray((params or {})["geom_rgba"])
    for geom in np.flatnonzero(visible_geoms(mj_model, varies)).tolist():
        texture = texture_of(mj_model, geom)
        if texture >= 0:
            # The viewer shows plain colours.
            colours[geom, :3] *= mean_colour(mj_model, texture).astype(np.float32)
    shapes = []
    for geom in np.flatnonzero(visible_geoms(mj_model, varies)).tolist():
        kind = SUPPORTED_TYPES[int(mj_model.geom_type[geom])]
        vertices, faces = triangles(kind, sizes[geom])
        red, green, blue, alpha = colours[geom].clip(0.0, 1.0).tolist()
        colour = (round(255 * red), round(255 * green), round(255 * blue))
        name = mj_model.geom(geom).name or str(geom)
        shapes.append(Shape(geom, name, vertices, faces, colour, alpha))
    return shapes


def triangles(kind: str, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a primitive.

    Args:
      kind: `"plane"`, `"box"`, `"sphere"`, `"capsule"` or `"cylinder"`.
      size: `[3]`, as MuJoCo gives it, m.

    Returns:
      Vertices `[V, 3] float32` and faces `[F, 3] uint32`.
    """
    radius, half = float(size[0]), float(size[1])
    if kind == "plane":
        x, y = (float(edge) or _PLANE for edge in size[:2])
        vertices = np.asarray([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]], np.float32)
        return vertices, np.asarray([[0, 1, 2], [0, 2, 3]], np.uint32)
    if kind == "box":
        return _box(size)
    if kind == "sphere":
        return _revolve(_arc(radius, -0.5, 0.5, 0.0))
    if kind == "capsule":
        return _revolve([*_arc(radius, -0.5, 0.0, -half), *_arc(radius, 0.0, 0.5, half)])
    # Edges twice, so that the light does not round them off.
    low, high = (radius, -half), (radius, half)
    return _revolve([(0.0, -half), low, low, high, high, (0.0, half)])


def _box(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Four vertices for each side, so that each has its own normal."""
    corners: list[np.ndarray] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            around = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
            start = len(corners)
            for u, v in around if sign > 0 else around[::-1]:
                corner = np.zeros(3)
                corner[axis], corner[(axis + 1) % 3], corner[(axis + 2) % 3] = sign, u, v
                corners.append(corner * size)
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return np.asarray(corners, np.float32), np.asarray(faces, np.uint32)


def _arc(radius: float, low: float, high: float, height: float) -> list[tuple[float, float]]:
    """Points of a half circle's part, from `low` to `high` in units of pi around `height`."""
    angles = np.linspace(low, high, _ROUND // 2 + 1) * np.pi
    return [(radius * float(np.cos(a)), height + radius * float(np.sin(a))) for a in angles]


def _revolve(profile: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """The surface that points `(radius, z)`, from below to above, describe around z."""
    angles = np.linspace(0.0, 2 * np.pi, _ROUND, endpoint=False)
    radii, heights = np.asarray(profile).T
    vertices = np.stack(
        [
            np.outer(radii, np.cos(angles)),
            np.outer(radii, np.sin(angles)),
            np.repeat(heights[:, None], _ROUND, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    faces = []
    for ring in range(len(profile) - 1):
        for i in range(_ROUND):
            low, low_next = ring * _ROUND + i, ring * _ROUND + (i + 1) % _ROUND
            high, high_next = low + _ROUND, low_next + _ROUND
            faces += [[low, low_next, high_next], [low, high_next, high]]
    return vertices.astype(np.float32), np.asarray(faces, np.uint32)


def varying_look(varies: Varies) -> bool:
    """Whether shapes differ from episode to episode."""
    return bool({"geom_size", "geom_rgba"} & set(varies))


__all__ = ["Shape", "make_shapes", "triangles", "varying_look"]

"""The scene in three dimensions, in the browser."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from mjx_arm.view.session import Look
from mjx_arm.view.shapes import Shape

if TYPE_CHECKING:
    import viser

# From where a new visitor looks, in units of the scene's extent, beside its centre.
_EYE = np.asarray([0.95, -0.95, 0.6])
_HANDLE = "/hand"


class Stage:
    """The shapes of a scene in a viser server, and a handle to drag an object by.

    Args:
      server: of viser.
      on_drag: called with a position `[3]`, m, while a visitor drags the object, and with None
        when it is let go.
    """

    def __init__(self, server: viser.ViserServer, on_drag: Callable[[np.ndarray | None], None]):
        self._server, self._on_drag = server, on_drag
        self._meshes: dict[int, Any] = {}
        self._handle: Any = None
        self._dragging = False
        server.scene.set_up_direction("+z")

    def build(self, model: mujoco.MjModel, shapes: list[Shape], *, handle: bool) -> None:
        """Shows other shapes, all of them at the origin until `show` is called.

        Args:
          model: whose centre and extent new visitors look at.
          shapes: of the scene.
          handle: there is an object to drag.
        """
        scene = self._server.scene
        with self._server.atomic():
            for mesh in self._meshes.values():
                mesh.remove()
            self._meshes = {
                shape.geom: scene.add_mesh_simple(
                    f"/geoms/{shape.geom}",
                    vertices=shape.vertices,
                    faces=shape.faces,
                    color=shape.colour,
                    opacity=None if shape.opacity >= 1.0 else shape.opacity,
                    side="double" if len(shape.faces) == 2 else "front",
                    cast_shadow=len(shape.faces) > 2,
                )
                for shape in shapes
            }
            if self._handle is not None:
                self._handle.remove()
            # A handle that is removed while it is dragged is never let go.
            self._dragging = False
            self._handle = self._make_handle() if handle else None
        centre, extent = np.array(model.stat.center), float(model.stat.extent)
        self._server.initial_camera.position = centre + extent * _EYE
        self._server.initial_camera.look_at = centre

    def _make_handle(self) -> Any:
        handle = self._server.scene.add_transform_controls(
            _HANDLE, scale=0.12, disable_rotations=True, depth_test=False, opacity=0.6
        )

        # Not a plain function: those run in a pool, and may overtake each other.
        @handle.on_update
        async def _(event: Any) -> None:
            self._dragging = event.phase != "end"
            self._on_drag(np.array(event.target.position) if self._dragging else None)

        return handle

    def show(self, look: Look, held: np.ndarray | None) -> None:
        """Moves all shapes to where they are, and the handle to the object at `held [3]`, m."""
        turns = Rotation.from_matrix(np.asarray(look.geom_xmat)).as_quat(scalar_first=True)
        with self._server.atomic():
            for geom, mesh in self._meshes.items():
                mesh.position = look.geom_xpos[geom]
                mesh.wxyz = turns[geom]
            if self._handle is not None and held is not None and not self._dragging:
                self._handle.position = held

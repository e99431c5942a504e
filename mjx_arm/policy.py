"""A policy as a program of its own: an image in, Q-values and an action out."""

from __future__ import annotations

import jax
import numpy as np
from jax import export


class Policy:
    """A policy from the bytes that `mjx_arm.export.export_policy` returns.

    Args:
      data: StableHLO, serialised by `jax.export`.
      where: what an error calls the bytes, such as the name of their file.

    Attributes:
      image_shape: `(H, W, 3)`, or `(C, H, W, 3)` for several cameras.
      num_actions: number of actions A.

    Raises:
      ValueError: the bytes are something else.
    """

    def __init__(self, data: bytes, where: str = "the policy") -> None:
        try:
            exported = export.deserialize(bytearray(data))
            (image,), (q, _action) = exported.in_avals, exported.out_avals
            (num_actions,) = q.shape
            if image.dtype != np.uint8:
                raise TypeError(f"its input is of type {image.dtype}")
        except Exception as error:  # flatbuffers raises whatever the wrong bytes lead to
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            raise ValueError(f"{where} is no exported policy ({reason})") from error
        self.image_shape: tuple[int, ...] = tuple(image.shape)
        self.num_actions: int = num_actions
        self._call = jax.jit(exported.call)

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, int]:
        """Computes Q-values.

        Args:
          image: of the shape `image_shape`, uint8: red, green, blue.

        Returns:
          Q-values `[A] float32`, and the action with the largest one.

        Raises:
          ValueError: the image has another shape or dtype.
        """
        check_image(image, self.image_shape)
        q, action = self._call(image)
        return np.asarray(q), int(action)


def check_image(image: object, shape: tuple[int, ...]) -> None:
    """Checks that an image is an array of a given shape, uint8.

    Raises:
      ValueError: it is something else.
    """
    if not isinstance(image, np.ndarray):
        raise ValueError(f"an image must be an array of numpy, got {type(image).__name__}")
    if image.dtype != np.uint8 or image.shape != shape:
        raise ValueError(
            f"an image must be of shape {list(shape)} and type uint8, got {list(image.shape)} and "
            f"{image.dtype}"
        )

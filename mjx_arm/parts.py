"""Large batches in parts that fit a CPU's cache."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

# 64 images of 64 by 64 pixels, and what makes or reads them, stay in a cache of some megabytes.
_ROWS = 64


def in_parts(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The same function of a batch, worked on 64 rows at a time where they are a multiple of that.

    On CPU only: drawing or judging 4,096 images at once takes twice as long there as 64 times 64.

    Args:
      function: maps a tree of arrays `[N, ...]` to one of arrays `[N, ...]`, each row by itself.
    """

    def apply(batch: Any) -> Any:
        rows = len(jax.tree.leaves(batch)[0])
        if jax.default_backend() != "cpu" or rows <= _ROWS or rows % _ROWS:
            return function(batch)
        parts = jax.tree.map(lambda x: x.reshape(-1, _ROWS, *x.shape[1:]), batch)
        results = jax.lax.map(function, parts)
        return jax.tree.map(lambda x: x.reshape(rows, *x.shape[2:]), results)

    return apply

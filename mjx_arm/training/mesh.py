"""Meshes of devices: which devices a run uses, and how its arrays are spread over them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from mjx_arm.config import TrainConfig
from mjx_arm.shard import WHOLE, Shard

AXIS = "device"
# What each device takes an equal part of.
_DIVIDED = ("batch_size", "teacher_batch_size", "student_batch_size")


def make_mesh(devices: int, *, of_all: bool = True) -> Mesh | None:
    """A mesh of one axis over some local devices of every process, or of this one alone.

    Args:
      devices: number of devices of each process.
      of_all: whether those of the other processes belong to it too.

    Returns:
      The mesh, or None where that is one device in all: the program without a mesh.

    Raises:
      ValueError: this process has fewer devices.
    """
    here = jax.local_device_count()
    if devices > here:
        raise ValueError(
            f"devices must be at most {here}, the number of local devices, got {devices}"
        )
    processes = range(jax.process_count()) if of_all else [jax.process_index()]
    chosen = [
        device
        for process in processes
        for device in jax.local_devices(process_index=process)[:devices]
    ]
    if len(chosen) == 1:
        return None
    return Mesh(np.asarray(chosen), (AXIS,), axis_types=(AxisType.Auto,))


def shard_of(mesh: Mesh | None) -> Shard:
    """The part of one device of a mesh of one axis; the whole without a mesh.

    Raises:
      ValueError: the mesh has several axes.
    """
    if mesh is None:
        return WHOLE
    if len(mesh.axis_names) != 1:
        raise ValueError(f"mesh must have one axis, got {mesh.axis_names}")
    return Shard(str(mesh.axis_names[0]), mesh.size)


def shards_seeds(config: TrainConfig, devices: int) -> bool:
    """Whether each device takes some of the seeds, and not some of the environments of each."""
    return config.num_seeds > 1 and config.num_seeds % devices == 0


def check_division(config: TrainConfig, devices: int) -> None:
    """Rejects a number of devices that does not divide the work.

    Raises:
      ValueError: it divides neither the seeds nor the environments and each batch.
    """
    if shards_seeds(config, devices):
        return
    values = {"num_envs": config.num_envs}
    values |= {name: getattr(config.algo, name) for name in _DIVIDED if hasattr(config.algo, name)}
    for name, value in values.items():
        if value % devices:
            raise ValueError(
                f"{name} must be a multiple of the number of devices, {devices}, got {value}"
            )


def most_devices(config: TrainConfig) -> int:
    """The largest number of local devices that divides the work of a run; at least 1."""
    for devices in range(jax.local_device_count(), 1, -1):
        try:
            check_division(config, devices * jax.process_count())
        except ValueError:
            continue
        return devices
    return 1


def sharded(
    function: Callable[..., Any], mesh: Mesh | None, in_specs: Any, out_specs: Any
) -> Callable[..., Any]:
    """The function on every device of a mesh, each with its part; as it is without a mesh."""
    if mesh is None:
        return function
    # Unchecked: callbacks and scans would need a cast of each constant to one that varies.
    mapped: Callable[..., Any] = jax.shard_map(
        function, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
    )
    return mapped


def with_shardings(shapes: Any, mesh: Mesh | None, specs: Any) -> Any:
    """Shapes with the shardings of `specs`, a tree of which each leaf stands for a whole branch."""
    if mesh is None:
        return shapes

    def of_branch(spec: PartitionSpec, branch: Any) -> Any:
        sharding = NamedSharding(mesh, spec)
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), branch
        )

    return jax.tree.map(of_branch, specs, shapes, is_leaf=lambda x: isinstance(x, PartitionSpec))


def place(tree: Any, shapes: Any) -> Any:
    """The arrays of a tree with the shardings of `shapes`, where those have any.

    An array that is not spread over the processes yet must be the same in each.
    """
    return jax.tree.map(lambda x, like: _move(x, getattr(like, "sharding", None)), tree, shapes)


def _move(x: Any, sharding: Any) -> Any:
    if sharding is None or getattr(x, "sharding", None) == sharding:
        return x
    if sharding.is_fully_addressable:
        return jax.device_put(x, sharding)
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        data = _move(jax.random.key_data(x), sharding)
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(x))
    if isinstance(x, jax.Array) and not x.is_fully_addressable:
        return jax.device_put(x, sharding)
    whole = np.asarray(x)
    return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])


def replicate(tree: Any, mesh: Mesh | None) -> Any:
    """The arrays of a tree on every device of a mesh; as they are without a mesh."""
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda x: _move(x, sharding), tree)


def fetch(tree: Any) -> Any:
    """The whole arrays of a tree on this host. With several processes all of them must call it."""

    def whole(x: jax.Array) -> Any:
        if x.is_fully_addressable:
            return jax.device_get(x)
        if x.is_fully_replicated:
            return np.asarray(x.addressable_data(0))
        return multihost_utils.process_allgather(x, tiled=True)

    return jax.tree.map(whole, tree)

"""Number of lanes that run together on a device (a tile), for processors and for accelerators.

A processor's core runs few lanes at a time, whose state fits into its cache. An accelerator (graphics card)
starts one operation after the other, each for all lanes of a tile; with few lanes, the accelerator is idle
most of the time. All lanes of a batch therefore run in one tile, as far as the accelerator's memory allows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

MEMORY_SHARE = 0.5  # share of an accelerator's memory for the tile; the rest is for inputs and results [1]
# Memory of a running tile, divided by the memory of its inputs and state [1]: each operation of a loop may
# need a second copy of the state, and keeps its intermediate results.
COPIES = 4
UNKNOWN_MEMORY = 4 << 30  # assumed memory of an accelerator that does not report it [bytes]
MAX_ACCELERATOR_LANES = 1 << 20  # maximum number of lanes per tile; more lanes are not faster


class DeviceDescription(NamedTuple):
    """Properties of JAX's devices that determine how many lanes run together in a tile."""

    is_cpu: bool  # whether the devices are cores of the processor
    memory: int = UNKNOWN_MEMORY  # memory of one device that JAX may use [bytes]


def describe_devices() -> DeviceDescription:
    """Return the description of JAX's devices, which are all alike."""
    device = jax.local_devices()[0]
    if device.platform == "cpu":
        return DeviceDescription(is_cpu=True)
    # The memory in use is not subtracted: it changes from call to call, and so would the compiled programs.
    memory = (device.memory_stats() or {}).get("bytes_limit", UNKNOWN_MEMORY)
    return DeviceDescription(is_cpu=False, memory=memory)


def choose_tile_size(device: DeviceDescription, lanes: int, cpu_size: int, lane_bytes: int) -> int:
    """Return the maximum number of lanes per tile (group of lanes that run together).

    Args:
        device: Description of the devices.
        lanes: Number of lanes that each device has to run.
        cpu_size: Number of lanes per tile on a processor.
        lane_bytes: Memory of the inputs and the state of a lane [bytes].

    Returns:
        `cpu_size` on a processor. On an accelerator all lanes, or, if their memory does not suffice, a power
        of two.
    """
    if device.is_cpu:
        return cpu_size
    affordable = max(1, int(MEMORY_SHARE * device.memory) // (COPIES * max(1, lane_bytes)))
    affordable = min(affordable, MAX_ACCELERATOR_LANES)
    return lanes if lanes <= affordable else 1 << (affordable.bit_length() - 1)


def find_tile_size(lanes: int, cpu_size: int, lane_bytes: Callable[[], int] = lambda: 0) -> int:
    """Return the maximum number of lanes that run together (a tile) on JAX's devices; see `choose_tile_size`.

    `lane_bytes` is a function that returns the memory of a lane [bytes]. This function is called only if
    there is an accelerator.
    """
    device = describe_devices()
    return choose_tile_size(device, lanes, cpu_size, 0 if device.is_cpu else lane_bytes())


def count_bytes(arrays: Any) -> int:
    """Return the memory [bytes] of all arrays of a pytree, computed from their shapes and types alone."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(arrays))

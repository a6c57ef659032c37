"""Device: arrays and launches of NVIDIA Warp on one device, and the kernels of this room."""

from __future__ import annotations

from math import prod
from typing import Any, NamedTuple

import numpy as np

from lightdepth import native


class Runs(NamedTuple):
    """Equal keys among n: each one's run (n,), the runs being in order of their keys (k,), and the first place of each
    (k,). Arrays of Warp."""

    numbers: Any
    keys: Any
    firsts: Any


class Device:
    """`name` is Warp's: "cuda:0", "cpu". Raises InputError where Warp is not installed."""

    def __init__(self, name: str) -> None:
        self.warp: Any = native.warp()
        from densify.fusion.on_device import adding, cutting, naming

        self.name = name
        self.naming: Any = naming
        self.adding: Any = adding
        self.cutting: Any = cutting

    def array(self, values: Any, dtype: type) -> Any:
        """Values as they are, of a NumPy type, on the device."""
        held: np.ndarray = np.ascontiguousarray(values, dtype)
        return self.warp.array(held, dtype=self._kind(dtype), device=self.name)

    def zeros(self, shape: int | tuple[int, ...], dtype: type = np.int32) -> Any:
        return self.warp.zeros(shape, dtype=self._kind(dtype), device=self.name)

    def empty(self, shape: int | tuple[int, ...], dtype: type = np.int32) -> Any:
        return self.warp.empty(shape, dtype=self._kind(dtype), device=self.name)

    def _kind(self, dtype: type) -> Any:
        return self.warp.dtype_from_numpy(np.dtype(dtype))

    def launch(self, kernel: Any, dim: int | tuple[int, ...], *inputs: Any) -> None:
        """A thread for each place of `dim`; none at all where that is empty."""
        if prod((dim,) if isinstance(dim, int) else dim):
            self.warp.launch(kernel, dim, inputs, device=self.name)

    def longer(self, array: Any, rows: int) -> Any:
        """An array with more rows, the new ones 0."""
        made = self.warp.zeros((rows, *array.shape[1:]), dtype=array.dtype, device=self.name)
        self.warp.copy(made, array, count=array.size)
        return made

    def running_sums(self, counts: Any) -> Any:
        """Of counts (n,), each one's own included."""
        summed = self.empty(counts.shape[0])
        self.warp.utils.array_scan(counts, summed)
        return summed

    def runs(self, keys: Any, below: int) -> Runs:
        """Of keys (2 n,), of which n are given, from 0 to less than `below`; they are sorted in their place."""
        n = keys.shape[0] // 2
        order, marks, numbers = self.empty(2 * n), self.empty(n), self.empty(n)
        self.launch(self.naming.count_up, n, order)
        self.warp.utils.radix_sort_pairs(keys, order, n, end_bit=below.bit_length())
        self.launch(self.cutting.mark_first, n, keys, marks)
        counted = self.running_sums(marks)
        found = int(counted[n - 1 :].numpy()[0])
        kept, firsts = self.empty(found, np.int64), self.empty(found)
        self.launch(self.cutting.number_runs, n, keys, order, counted, numbers, kept, firsts)
        return Runs(numbers, kept, firsts)

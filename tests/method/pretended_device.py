"""A pretended GPU: tensors of PyTorch's device type `lazy` with values on the CPU.

It refuses what a GPU refuses: tensors of CPU and GPU in one operation, NumPy arrays of its tensors, random numbers from
a generator of the CPU, and float64 where the GPU is Apple's.
"""

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

NAME = "lazy"
"""Autograd runs backward passes of this device type in the calling thread, and those of GPUs in a GPU's thread."""

_aten = torch.ops.aten
_BETWEEN_DEVICES = (_aten.copy_.default, _aten._to_copy.default)
_INDEXING = (_aten.index.Tensor, _aten.index_put.default, _aten.index_put_.default)


class OnDevice(Tensor):
    """A tensor of the device."""

    values_on_cpu: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> "OnDevice":
        layout = values.shape, values.stride(), values.storage_offset()
        result: OnDevice = Tensor._make_wrapper_subclass(cls, *layout, dtype=values.dtype, device=NAME)
        result.values_on_cpu = values
        return result

    @classmethod
    def __torch_function__(cls, function: Any, _types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Make tensors from lists, which PyTorch creates on the device without an operation that a mode intercepts."""
        if function is Tensor.new_tensor:
            return torch.tensor(args[1], dtype=args[0].dtype).to(args[0].device)
        if function in (Tensor.__getitem__, Tensor.__setitem__):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            args = args[0], tuple(torch.tensor(i) if isinstance(i, list) else i for i in index), *args[2:]
        with torch._C.DisableTorchFunctionSubclass():
            return function(*args, **(kwargs or {}))

    @classmethod
    def __torch_dispatch__(cls, operation: Any, _types: Any, _args: Any = (), _kwargs: Any = None) -> Any:
        raise AssertionError(f"{operation}: no PretendedDevice is active in this thread")


class PretendedDevice(TorchDispatchMode):
    """Run each operation of the device on the values of its tensors."""

    def __init__(self, *, has_float64: bool) -> None:
        super().__init__()
        self.has_float64 = has_float64
        self.operations = 0

    def __torch_dispatch__(self, operation: Any, _types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = _tensors((args, kwargs))
        is_used = any(isinstance(t, OnDevice) for t in tensors)
        is_target = is_used if kwargs.get("device") is None else torch.device(kwargs["device"]).type == NAME
        if not is_used and not is_target:
            return operation(*args, **kwargs)
        self.operations += 1
        if kwargs.get("device") is not None:
            kwargs["device"] = "cpu"
        if kwargs.get("generator") is not None:
            raise RuntimeError(f"{operation}: the generator is on the CPU")
        if operation not in _BETWEEN_DEVICES:
            # A GPU takes indices, and single values in arithmetic, from the CPU.
            if operation in _INDEXING:
                tensors = _tensors((args[0], args[2:]))
            elif torch.Tag.pointwise in operation.tags:
                tensors = [t for t in tensors if t.ndim > 0]
            if not all(isinstance(t, OnDevice) for t in tensors):
                raise RuntimeError(f"{operation}: expected all tensors on one device, but found {NAME} and cpu")
        values, options = tree_map_only(OnDevice, lambda t: t.values_on_cpu, (args, kwargs))
        result = operation(*values, **options)
        if operation._schema.is_mutable:
            return args[0]
        return tree_map_only(Tensor, self._on_device, result) if is_target else result

    def _on_device(self, values: Tensor) -> OnDevice:
        if values.dtype == torch.float64 and not self.has_float64:
            raise TypeError("the device has no float64")
        return OnDevice(values)


def _tensors(nested: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(nested) if isinstance(leaf, Tensor)]

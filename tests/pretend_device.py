"""A pretend device: runs code that is meant for a GPU where there is none, and counts what a GPU would wait for.

    with PretendDevice() as device:
        policy.to(DEVICE)
        with device.count() as counts:
            simulate(policy, batch.to(DEVICE), ...)

Tensors on it keep their values on the CPU and say that they lie on cuda:0. Values are those of the CPU's kernels. What
CUDA refuses is refused: a CPU tensor with dimensions beside a tensor of the device, `.numpy()`. Counted, by line, are

* launches: operations on the device that are no views. A kernel each is a lower bound of what CUDA launches.
* waits: the host needs a value or a shape of the device before it can go on.
* copies: values go from the host to the device.

Underneath, a tensor is on torch's device "meta", since a CPU build of torch has no cuda device to put it on. So two
modes are needed: one of functions, in which cuda is another name of meta, and one of operations, which computes them.
It cannot see autocast, rounding that differs on a GPU, limits of grids, and kernels that CUDA lacks.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

import rlftsim

DEVICE = torch.device("cuda:0")
META = torch.device("meta")
GET_DEVICE = Tensor.device.__get__  # type: ignore[attr-defined]
SOURCE = f"{Path(rlftsim.__file__).parent}/"
WAITING = {"_local_scalar_dense", "_unique2", "bincount", "equal", "masked_select", "nonzero", "unique_consecutive"}
"""Operations whose value or shape the host needs."""
NO_KERNEL = {"_unsafe_view", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided"}
"""Operations without a kernel, beside views."""


@dataclass
class Counts:
    """What happened, by line of the package."""

    launches: Counter[str] = field(default_factory=Counter)
    waits: Counter[str] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)
    operations: list[tuple[str, tuple[torch.Size, ...]]] = field(default_factory=list)
    """Every operation on the device with the shapes that it reads: what a CUDA graph would repeat."""

    @property
    def totals(self) -> tuple[int, int, int]:
        """Launches, waits, copies."""
        return self.launches.total(), self.waits.total(), self.copies.total()


class DeviceTensor(Tensor):
    """A tensor on the pretend device; `inner` has its values."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "DeviceTensor":
        self = torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=META,
        )  # fmt: skip
        self.inner = inner
        return self

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"DeviceTensor({self.inner!r})"

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return PretendDevice.current.run(func, args, kwargs or {})


class PretendDevice:
    """Makes the pretend device usable in a `with` block."""

    current: "PretendDevice"

    def __init__(self) -> None:
        self._counts: list[Counts] = []
        self._exit = ExitStack()

    def __enter__(self) -> "PretendDevice":
        PretendDevice.current = self
        # parameters cannot change their class in place
        overwrites = torch.__future__.get_overwrite_module_params_on_conversion()
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        self._exit.callback(torch.__future__.set_overwrite_module_params_on_conversion, overwrites)
        self._exit.enter_context(mock.patch("torch.cuda.synchronize"))
        self._exit.enter_context(_Operations(self))
        self._exit.enter_context(_Functions(self))
        return self

    def __exit__(self, *error: object) -> None:
        self._exit.close()

    @contextmanager
    def count(self) -> Iterator[Counts]:
        """What happens inside of the block."""
        self._counts.append(Counts())
        try:
            yield self._counts[-1]
        finally:
            self._counts.pop()

    def add(self, kind: str, what: str = "") -> None:
        """Count an event at the innermost line of the package."""
        if self._counts:
            place = f"{find_line()} {what}".rstrip()
            for counts in self._counts:
                getattr(counts, kind)[place] += 1

    def run(self, func, args, kwargs):
        """An operation, computed on the CPU; its result lies on the device if its inputs do or it is made there."""
        name = func._schema.name.removeprefix("aten::")
        on_device: list[Tensor] = []
        on_host: list[Tensor] = []
        each_tensor((args, kwargs), lambda v: (on_device if isinstance(v, DeviceTensor) else on_host).append(v))
        target = kwargs.get("device")
        is_there = bool(on_device) if target is None else target == META
        assert not any(value.is_meta for value in on_host), f"a tensor without values in {name} at {find_line()}"
        # 1. what CUDA refuses, what it waits for
        if name in ("_to_copy", "copy_"):
            source = args[-1 if name == "_to_copy" else 1]
            goes_there = is_there if name == "_to_copy" else isinstance(args[0], DeviceTensor)
            if isinstance(source, DeviceTensor) != goes_there:
                self.add(*(("copies",) if goes_there else ("waits", "copy to the host")))
        elif on_device:
            self._look_at(name, args, on_host)
        # 2. the same on the CPU. What is written in place comes back as the tensor it was
        on_cpu = each_tensor((args, kwargs), lambda v: v.inner if isinstance(v, DeviceTensor) else v)
        wrappers = {id(value.inner): value for value in on_device}
        if target == META:
            on_cpu[1]["device"] = torch.device("cpu")
        result = func(*on_cpu[0], **on_cpu[1])
        if (on_device or is_there) and has_kernel(func):
            self.add("launches")
            for counts in self._counts:
                counts.operations.append((name, tuple(value.shape for value in on_device)))
        if not is_there and name != "copy_":
            return result
        return each_tensor(result, lambda v: wrappers[id(v)] if id(v) in wrappers else DeviceTensor(v))

    def _look_at(self, name: str, args: tuple, on_host: list[Tensor]) -> None:
        """Refuse tensors of both sides, count waits. CUDA takes single numbers of the host, and copies indices."""
        beside = [value for value in on_host if value.dim()]
        is_indexing = name in ("index", "index_put_", "_index_put_impl_") and isinstance(args[0], DeviceTensor)
        if is_indexing:
            indices = [index for index in args[1] if index is not None]
            of_host = [index for index in indices if not isinstance(index, DeviceTensor)]
            for _ in of_host:
                self.add("copies", "index of the host")
            beside = [value for value in beside if not any(value is index for index in of_host)]
            fills = name != "index" and args[2].numel() == 1  # a number at the places of a mask is a masked_fill
            if any(index.dtype == torch.bool for index in indices) and not fills:
                self.add("waits", "index by a mask")
        if beside:
            raise RuntimeError(
                f"Expected all tensors to be on the same device, but found {DEVICE} and cpu in {name} at {find_line()}"
            )
        if name in WAITING or (name == "repeat_interleave" and len(args) < 3):
            self.add("waits", name)


class _Operations(TorchDispatchMode):
    """Hands every operation to the device."""

    def __init__(self, device: PretendDevice) -> None:
        super().__init__()
        self._device = device

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return self._device.run(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Says cuda where torch says meta, and meta where the caller says cuda."""

    def __init__(self, device: PretendDevice) -> None:
        super().__init__()
        self._device = device

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func == GET_DEVICE:
            return DEVICE if isinstance(args[0], DeviceTensor) else func(*args)
        if func is Tensor.tolist and isinstance(args[0], DeviceTensor):
            self._device.add("waits", "tolist")
            return args[0].inner.tolist()
        if func is Tensor.backward:
            with self:  # what is recomputed there asks for devices, too
                return torch.autograd.backward(*args, grad_tensors=kwargs.pop("gradient"), **kwargs)
        args = tuple(_as_meta(value) for value in args)
        kwargs = {name: _as_meta(value) for name, value in kwargs.items()}
        # on meta these make no values, nor does a list as an index
        if func in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[0], DeviceTensor):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            place = tuple(torch.tensor(v).to(META) if isinstance(v, list) else v for v in index)
            return func(args[0], place, *args[2:])
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") == META:
            return func(*args, **{**kwargs, "device": "cpu"}).to(META)
        if func is Tensor.new_tensor and isinstance(args[0], DeviceTensor):
            return torch.tensor(*args[1:], **{"dtype": args[0].dtype, **kwargs}).to(META)
        return func(*args, **kwargs)


def _as_meta(value: object) -> object:
    is_cuda = isinstance(value, str | torch.device) and str(value).split(":")[0] == "cuda"
    return META if is_cuda else value


def each_tensor(value: object, function: Callable[[Tensor], object]) -> Any:
    """Arguments or results of an operation with a function applied to each tensor. (Torch's own tree_map is slow.)"""
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, list | tuple):
        return type(value)([each_tensor(v, function) for v in value])
    if isinstance(value, dict):
        return {name: each_tensor(v, function) for name, v in value.items()}
    return value


@cache
def has_kernel(func: torch._ops.OpOverload) -> bool:
    """False for views, for memory that is not filled, and for questions that torch asks itself."""
    returned = func._schema.returns
    is_view = any(value.alias_info is not None and not value.alias_info.is_write for value in returned)
    has_tensors = any("Tensor" in str(value.type) or str(value.type) == "number" for value in returned)
    return has_tensors and not is_view and func._schema.name.removeprefix("aten::") not in NO_KERNEL


def find_line() -> str:
    """Innermost line of the package that is being run, as file:line."""
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code.co_filename.startswith(SOURCE):
            return f"{frame.f_code.co_filename.removeprefix(SOURCE)}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"

"""NumPy functions that compiled JAX programs on a CPU call through a name.

`jax.pure_callback` puts a function's address into the program, which JAX therefore cannot cache. Here the program has a name,
as an attribute of a call of XLA's foreign function interface. The structs below are declared in xla/ffi/api/c_api.h, a stable
binary interface.
"""

import atexit
import contextlib
import ctypes
import functools
import math
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.types import Array

_Function = Callable[[np.ndarray, np.ndarray], None]  # writes outputs [..., n] for inputs [..., m], float32
_methods: dict[str, list[weakref.WeakMethod[_Function]]] = {}
_lock = threading.Lock()
_calls, _ends = 0, False  # calls so far; whether Python ends
_TARGET = "mjx_dher_host"
_MAJOR, _MINOR = 0, 1  # supported interface; later minor versions append fields to structs
_METADATA, _EXECUTE = 1, 3
_INTERNAL = 13  # error code

_pointer, _int, _int64 = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64


class _Struct(ctypes.Structure):
    """First fields of most XLA structs."""

    _fields_: ClassVar[Any] = (("struct_size", ctypes.c_size_t), ("extension", _pointer))


class _Version(_Struct):
    _fields_ = (("major", _int), ("minor", _int))


class _Metadata(ctypes.Structure):
    _fields_ = (("struct_size", ctypes.c_size_t), ("version", _Version))


class _Extension(ctypes.Structure):
    """Extension of a frame, with `metadata` if `type` is _METADATA."""

    _fields_ = (("struct_size", ctypes.c_size_t), ("type", _int), ("next", _pointer), ("metadata", ctypes.POINTER(_Metadata)))


class _Buffer(_Struct):
    _fields_ = (("dtype", _int), ("data", _pointer), ("rank", _int64), ("dims", _pointer))


class _Buffers(_Struct):
    _fields_ = (("size", _int64), ("types", _pointer), ("items", _pointer))


class _Attributes(_Struct):
    _fields_ = (("size", _int64), ("types", _pointer), ("names", _pointer), ("items", _pointer))


class _Error(_Struct):
    _fields_ = (("message", ctypes.c_char_p), ("code", _int))


class _Api(_Struct):
    _fields_ = (
        ("version", _Version),
        ("internal", _pointer),
        ("make_error", ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_Error))),
    )


class _Frame(_Struct):
    _fields_ = (
        ("api", ctypes.POINTER(_Api)),
        ("context", _pointer),
        ("stage", _int),
        ("arguments", _Buffers),
        ("results", _Buffers),
        ("attributes", _Attributes),
    )


def register(name: str, method: _Function) -> None:
    """Makes a bound method available to programs as `name`, while its object lives.

    All methods of one name must compute the same. They must use only NumPy, because calling JAX in a callback could deadlock.
    """
    _register_target()
    with _lock:
        for key in [key for key, methods in _methods.items() if not any(each() for each in methods)]:
            del _methods[key]
        _methods[name] = [*_methods.get(name, ()), weakref.WeakMethod(method)]  # a new list, because others may read the old


def call(name: str, shape: tuple[int, ...], inputs: Array) -> Array:
    """Calls the method registered as `name` with `inputs` [m]. Returns its outputs, float32 of `shape`.

    Under `vmap` it is called once, with [..., m]. Programs for devices other than CPUs are not cached. Outside a program, it is
    called without JAX, and NumPy inputs give NumPy outputs.
    """
    if not isinstance(inputs, jax.core.Tracer):
        outputs = np.empty(shape, np.float32)
        if outputs.size:
            _method(name)(np.asarray(inputs, np.float32), outputs)
        return outputs if isinstance(inputs, np.ndarray) else jnp.asarray(outputs)
    result = jax.ShapeDtypeStruct(shape, np.float32)
    inputs = inputs.astype(np.float32)  # JAX may compute in 64 bits
    if jax.default_backend() != "cpu":
        return jax.pure_callback(functools.partial(_answer, name, shape), result, inputs, vmap_method="broadcast_all")
    return jax.ffi.ffi_call(_TARGET, result, vmap_method="broadcast_all")(inputs, name=name)


def _answer(name: str, shape: tuple[int, ...], inputs: Any) -> np.ndarray:
    outputs = np.empty((*inputs.shape[:-1], *shape), np.float32)
    _method(name)(np.asarray(inputs), outputs)
    return outputs


def _method(name: str) -> _Function:
    for each in _methods.get(name, ()):
        if method := each():
            return method
    raise RuntimeError("the simulator of this program no longer exists; keep it as long as the program")


@functools.cache
def _register_target() -> Any:
    """Registers `_handle` with XLA. Returns the C function, which must not be freed."""
    handler = ctypes.CFUNCTYPE(_pointer, _pointer)(_handle)
    jax.ffi.register_ffi_target(_TARGET, jax.ffi.pycapsule(ctypes.cast(handler, _pointer)), platform="cpu")
    atexit.register(_end)
    return handler


def _end() -> None:
    """Lets programs that still run fail at their next call: a call after the end of Python would crash or hang the process."""
    global _ends  # noqa: PLW0603
    jax.effects_barrier()
    _ends = True
    with contextlib.suppress(Exception):
        jax.block_until_ready(jax.live_arrays())
    seen = -1
    for _ in range(100):  # programs without live outputs
        if seen == (seen := _calls):
            break
        time.sleep(0.02)


# Offsets in a frame, in words of 8 bytes: reading fields of ctypes structs takes longer than a small simulation.
_STAGE = _Frame.stage.offset // 8
_ARGUMENTS, _RESULTS, _ATTRIBUTES = (
    (getattr(_Frame, name).offset + kind.items.offset) // 8
    for name, kind in (("arguments", _Buffers), ("results", _Buffers), ("attributes", _Attributes))
)
_DATA, _RANK, _DIMS = (getattr(_Buffer, name).offset // 8 for name in ("data", "rank", "dims"))


def _handle(address: int) -> int | None:
    """Answers a call of XLA with this version or the outputs. Returns None, or an error."""
    global _calls  # noqa: PLW0603
    _calls += 1
    try:
        if _ends:
            raise RuntimeError("Python ends")
        frame = _words(address)
        if frame[1] and (extension := ctypes.cast(frame[1], ctypes.POINTER(_Extension)).contents).type == _METADATA:
            version = extension.metadata.contents.version
            version.major, version.minor = _MAJOR, _MINOR
        elif frame[_STAGE] & 0xFFFFFFFF == _EXECUTE:
            begin, length = _first(frame[_ATTRIBUTES])[:2]
            _method(ctypes.string_at(begin, length).decode())(_buffer(frame[_ARGUMENTS]), _buffer(frame[_RESULTS]))
    except Exception as error:
        message = f"{type(error).__name__}: {error}".encode()
        described = _Error(ctypes.sizeof(_Error), None, message, _INTERNAL)
        return ctypes.cast(address, ctypes.POINTER(_Frame)).contents.api.contents.make_error(ctypes.byref(described))
    return None


@functools.lru_cache(maxsize=4096)  # XLA uses the same memory again
def _words(address: int) -> Any:
    """A window on memory, as words of 8 bytes. It may be longer than the struct: read only the struct's words."""
    return (ctypes.c_uint64 * 32).from_address(address)


def _first(items: int) -> Any:
    """Returns the first of several structs that are given by pointers."""
    return _words(_words(items)[0])


def _buffer(items: int) -> np.ndarray:
    """Returns the first of several buffers as an array of float32."""
    buffer = _first(items)
    return _view(buffer[_DATA], tuple(_words(buffer[_DIMS])[: buffer[_RANK]]) if buffer[_RANK] else ())


@functools.lru_cache(maxsize=4096)
def _view(data: int, shape: tuple[int, ...]) -> np.ndarray:
    memory: Any = (ctypes.c_float * math.prod(shape)).from_address(data)
    return np.ndarray(shape, np.float32, memory)

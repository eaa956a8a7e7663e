"""NumPy functions that compiled JAX programs on a CPU call through a name.

`jax.pure_callback` puts a function's address into the program, which JAX therefore cannot cache. Here the program has a name,
as an attribute of a call of XLA's foreign function interface. The structs below are declared in xla/ffi/api/c_api.h, a stable
binary interface.
"""

from __future__ import annotations

import ctypes
import functools
import threading
import weakref
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import numpy as np

from mjx_dher.types import Array

_Function = Callable[[np.ndarray], np.ndarray]  # inputs [..., m] -> outputs [..., n], float32
_methods: dict[str, list[weakref.WeakMethod[_Function]]] = {}
_lock = threading.Lock()
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

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("type", _int),
        ("next", _pointer),
        ("metadata", ctypes.POINTER(_Metadata)),
    )


class _Buffer(_Struct):
    _fields_ = (("dtype", _int), ("data", _pointer), ("rank", _int64), ("dims", ctypes.POINTER(_int64)))


class _Buffers(_Struct):
    _fields_ = (("size", _int64), ("types", _pointer), ("items", ctypes.POINTER(ctypes.POINTER(_Buffer))))


class _Text(ctypes.Structure):
    _fields_ = (("begin", _pointer), ("length", ctypes.c_size_t))


class _Attributes(_Struct):
    _fields_ = (("size", _int64), ("types", _pointer), ("names", _pointer), ("items", ctypes.POINTER(ctypes.POINTER(_Text))))


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

    Under `vmap` it is called once, with [..., m]. Programs for devices other than CPUs are not cached.
    """
    result = jax.ShapeDtypeStruct(shape, np.float32)
    inputs = inputs.astype(np.float32)  # JAX may compute in 64 bits
    if jax.default_backend() != "cpu":
        return jax.pure_callback(functools.partial(_answer, name), result, inputs, vmap_method="broadcast_all")
    return jax.ffi.ffi_call(_TARGET, result, vmap_method="broadcast_all")(inputs, name=name)


def _answer(name: str, inputs: np.ndarray) -> np.ndarray:
    method = next(filter(None, (each() for each in _methods.get(name, ()))), None)
    if method is None:
        raise RuntimeError("the simulator of this program no longer exists; keep it as long as the program")
    return method(inputs)


@functools.cache
def _register_target() -> Any:
    """Registers `_handle` with XLA. Returns the C function, which must not be freed."""
    handler = ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_Frame))(lambda frame: _handle(frame.contents))
    jax.ffi.register_ffi_target(_TARGET, jax.ffi.pycapsule(ctypes.cast(handler, _pointer)), platform="cpu")
    return handler


def _handle(frame: Any) -> int | None:
    """Answers a call of XLA with this version or the outputs. Returns None, or an error."""
    try:
        extension = ctypes.cast(frame.extension, ctypes.POINTER(_Extension))
        if extension and extension.contents.type == _METADATA:
            version = extension.contents.metadata.contents.version
            version.major, version.minor = _MAJOR, _MINOR
        elif frame.stage == _EXECUTE:
            name = frame.attributes.items[0].contents
            text = ctypes.string_at(name.begin, name.length).decode()
            outputs, expected = _answer(text, _view(frame.arguments)), _view(frame.results)
            if np.shape(outputs) != expected.shape:
                raise ValueError(f"a function that JAX calls must give {list(expected.shape)}; it gives {np.shape(outputs)}")
            expected[...] = outputs
    except Exception as error:
        message = f"{type(error).__name__}: {error}".encode()
        described = _Error(ctypes.sizeof(_Error), None, message, _INTERNAL)
        return frame.api.contents.make_error(ctypes.byref(described))
    return None


def _view(buffers: Any) -> np.ndarray:
    """First of the buffers, as a float32 array."""
    buffer = buffers.items[0].contents
    shape = tuple(buffer.dims[: buffer.rank])
    return np.ctypeslib.as_array(ctypes.cast(buffer.data, ctypes.POINTER(ctypes.c_float)), shape)

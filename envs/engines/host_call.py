"""NumPy functions that compiled JAX programs on a CPU look up by a name.

`jax.pure_callback` puts a function's address into the program, which JAX therefore cannot keep for the next process. Here the
program holds a name, through XLA's foreign function interface. The structs below are declared in xla/ffi/api/c_api.h, a stable
binary interface.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import numpy as np

from mjx_dher.types import Array

_Function = Callable[[np.ndarray], np.ndarray]  # inputs [..., m] -> outputs [..., n], float32
_functions: dict[str, _Function] = {}
_handlers: dict[str, Any] = {}  # C functions, which must not be freed
_MAJOR, _MINOR = 0, 1  # of the interface that this is written for: later minor versions add to the ends of structs
_METADATA, _EXECUTE = 1, 3
_INTERNAL = 13  # error code

_pointer, _int, _int64 = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64


class _Struct(ctypes.Structure):
    """The first fields of most of XLA's structs."""

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
    )


_handler = ctypes.CFUNCTYPE(_pointer, ctypes.POINTER(_Frame))


def register(name: str, function: _Function) -> None:
    """Makes `function` the one that programs call under `name`, instead of an earlier one.

    It must use NumPy alone: calls of JAX in a callback could deadlock.
    """
    _functions[name] = function
    if name not in _handlers:
        _handlers[name] = _handler(lambda frame: _handle(name, frame.contents))
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(ctypes.cast(_handlers[name], _pointer)), platform="cpu")


def call(name: str, shape: tuple[int, ...], inputs: Array) -> Array:
    """Calls the function registered under `name` with `inputs` [m]. Returns its outputs, float32 of `shape`.

    Under `vmap` it is called once, with [..., m]. A program for another device than a CPU holds the function's address.
    """
    result = jax.ShapeDtypeStruct(shape, np.float32)
    inputs = inputs.astype(np.float32)  # which the function reads them as; JAX may compute in 64 bits
    if jax.default_backend() != "cpu":
        return jax.pure_callback(_functions[name], result, inputs, vmap_method="broadcast_all")
    return jax.ffi.ffi_call(name, result, vmap_method="broadcast_all")(inputs)


def _handle(name: str, frame: Any) -> int | None:
    """Answers a call of XLA with this version or the outputs. Returns None, or an error."""
    try:
        extension = ctypes.cast(frame.extension, ctypes.POINTER(_Extension))
        if extension and extension.contents.type == _METADATA:
            version = extension.contents.metadata.contents.version
            version.major, version.minor = _MAJOR, _MINOR
        elif frame.stage == _EXECUTE:
            outputs, expected = _functions[name](_view(frame.arguments)), _view(frame.results)
            if np.shape(outputs) != expected.shape:
                raise ValueError(f"a function that JAX calls must give {list(expected.shape)}; it gives {np.shape(outputs)}")
            expected[...] = outputs
    except Exception as error:
        text = f"{type(error).__name__}: {error}".encode()
        described = _Error(ctypes.sizeof(_Error), None, text, _INTERNAL)
        return frame.api.contents.make_error(ctypes.byref(described))
    return None


def _view(buffers: Any) -> np.ndarray:
    """Returns the first of the buffers as an array of float32."""
    buffer = buffers.items[0].contents
    shape = tuple(buffer.dims[: buffer.rank])
    return np.ctypeslib.as_array(ctypes.cast(buffer.data, ctypes.POINTER(ctypes.c_float)), shape)

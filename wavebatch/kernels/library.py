"""The compiled library of the kernels: its structures, and arrays checked before they are handed over.

Used by kernels/fit and kernels/signal. The source is kernels/c; `pip install` builds it, and in a checkout it is built
again when its source has changed (build_kernels.py).
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.kernels.build_kernels import LIBRARY, SOURCES, compile_library, is_outdated, is_whole

_POINTER = ctypes.c_void_p


def _fields(kind: type, names: str) -> list[tuple[str, type]]:
    return [(name, kind) for name in names.split()]


class Pulse(ctypes.Structure):
    """`Pulse` of kernels/c/types.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "kind"),
        *_fields(ctypes.c_double, "skew power"),
        *_fields(ctypes.c_int64, "n_components"),
        *_fields(_POINTER, "components"),
        *_fields(ctypes.c_int64, "n_rows"),
        *_fields(ctypes.c_double, "first step"),
        *_fields(_POINTER, "value slope"),
        *_fields(ctypes.c_int64, "from_waveform"),
    ]
    SUM_OF_GAUSSIANS, SKEWED, POWER, TABLE, LOG_NORMAL = range(5)


class Settings(ctypes.Structure):
    """`Settings` of kernels/c/types.h."""

    _fields_ = [
        ("pulse", Pulse),
        *_fields(
            ctypes.c_double,
            "width_ref width_low width_high clip noise_gain tolerance acceptance misfit prior_spread gate_residual "
            "gate_hermite skew_mean skew_spread",
        ),
        *_fields(ctypes.c_int64, "max_iterations max_echoes grow undamped"),
    ]


class Block(ctypes.Structure):
    """`Block` of kernels/c/types.h."""

    _fields_ = [
        *_fields(_POINTER, "samples"),
        *_fields(ctypes.c_int64, "length bytes"),
        *_fields(_POINTER, "baseline"),
        *_fields(ctypes.c_int64, "baseline_per_sample"),
        *_fields(_POINTER, "std missing"),
    ]


class Clusters(ctypes.Structure):
    """`Clusters` of kernels/c/types.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "n"),
        *_fields(_POINTER, "waveform low high first number amplitude time width"),
    ]


class Echoes(ctypes.Structure):
    """`Echoes` of kernels/c/types.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "room"),
        *_fields(_POINTER, "number converged misfit cost parameters errors shared at_bound"),
    ]


@cache
def load() -> ctypes.CDLL:
    """The library.

    Raises
    ------
    InputError
        It cannot be built, is missing or damaged, or was built for another machine.
    """
    in_checkout = SOURCES.is_dir()
    try:
        if is_outdated():
            compile_library()
    except (OSError, RuntimeError) as error:
        raise InputError(f"{LIBRARY}: cannot be built from its C sources: {error}") from error
    try:
        if not is_whole(LIBRARY):
            raise OSError("its end is missing")
        library = ctypes.CDLL(str(LIBRARY))
        for function in (library.decompose_clusters, library.promise_echoes):
            function.restype = ctypes.c_int64
    except (OSError, AttributeError) as error:
        again = "remove it, it is then built again" if in_checkout else "install wavebatch again on this machine"
        raise InputError(
            f"{LIBRARY}: cannot be loaded ({_reason(error)}): it is missing, damaged or of another machine; {again}"
        ) from error
    return library


def _reason(error: Exception) -> str:
    """What the system says, without the path that the message begins with."""
    text = getattr(error, "strerror", None) or str(error)
    return text.removeprefix(f"{LIBRARY}: ")


def place(array: np.ndarray, dtype: type) -> int:
    """Address of a contiguous array of this type, for a structure whose owner keeps the array."""
    if array.dtype != dtype or not array.flags.c_contiguous:
        raise ValueError(f"expected a contiguous array of {np.dtype(dtype)}, got {array.dtype}")
    return array.ctypes.data

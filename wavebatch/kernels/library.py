"""The compiled library of the kernels: its structures, and arrays checked before they are handed over.

Used by kernels/fit and kernels/signal. The source is kernels/c; `pip install` builds it, and in a checkout it is built
again when its source has changed (build_kernels.py).
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import NamedTuple
from wavebatch.kernels.build_kernels import LIBRARY, SOURCES, compile_library, is_outdated, is_whole

_POINTER = ctypes.c_void_p
_ADDRESS = object.__basicsize__
"""Place of an array's address in NumPy's structure of it, which begins as each object of CPython does."""

FUNCTIONS = (
    "decompose_clusters", "promise_echoes", "quiet_levels", "filter_rows", "find_maxima", "find_correlated",
    "group_candidates", "exponentials", "logarithms", "solve_equations", "decode_packets", "describe_waveforms",
    "describe_widths", "learn_pulse", "render_pulses", "pair_differences", "judge_packets",
    "interpolate_columns", "fit_stack", "describe_echoes", "keep_echoes", "match_returns", "weigh_fits",
    "finish_echoes", "find_pulses", "find_nearest", "number_returns", "share_offsets", "find_around",
    "measure_lobes", "find_two_lines", "trim_planes", "coloured_variance", "fit_factors",
    "compare_halves", "explain_tails", "find_levels",
)  # fmt: skip
"""What the library offers; each returns an int64, below 0 where there is no memory."""


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


class CSettings(ctypes.Structure):
    """`Settings` of kernels/c/types.h."""

    _fields_ = [
        ("pulse", Pulse),
        *_fields(
            ctypes.c_double,
            "width_ref width_low width_high clip floor noise_gain tolerance acceptance misfit prior_spread "
            "gate_residual gate_hermite known skew_mean skew_spread",
        ),
        *_fields(ctypes.c_int64, "max_iterations max_echoes grow thorough free_levels undamped whitened"),
        ("whitening", ctypes.c_double * 9),
    ]


class Block(ctypes.Structure):
    """`Block` of kernels/c/types.h."""

    _fields_ = [
        *_fields(_POINTER, "samples"),
        *_fields(ctypes.c_int64, "length bytes"),
        *_fields(_POINTER, "baseline"),
        *_fields(ctypes.c_int64, "baseline_per_sample"),
        *_fields(_POINTER, "std missing level_err"),
    ]


class CClusters(ctypes.Structure):
    """`Clusters` of kernels/c/types.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "n"),
        *_fields(_POINTER, "waveform low high first number amplitude time width"),
    ]


class Echoes(ctypes.Structure):
    """`Echoes` of kernels/c/types.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "room"),
        *_fields(_POINTER, "number converged cost misfit parameters errors shared at_bound"),
    ]


class CDescribed(ctypes.Structure):
    """`Described` of kernels/c/describe.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "n length"),
        *_fields(_POINTER, "left model used first amplitude time width"),
        ("pulse", Pulse),
        *_fields(ctypes.c_double, "variance gain change"),
        ("ahead", ctypes.c_double * 2),
        ("left_over", ctypes.c_double),
    ]


class CStacked(ctypes.Structure):
    """`Stacked` of kernels/c/stack.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "n m"),
        *_fields(_POINTER, "lag value weight"),
        *_fields(ctypes.c_double * 3, "low high"),
        *_fields(ctypes.c_double, "early onset last end damping most_damping settled"),
        ("most", ctypes.c_int64),
    ]


class CCandidates(ctypes.Structure):
    """`Candidates` of kernels/c/signal.h."""

    _fields_ = [*_fields(ctypes.c_int64, "room"), *_fields(_POINTER, "waveform amplitude time width")]


class Detector(ctypes.Structure):
    """`Detector` of kernels/c/signal.h."""

    _fields_ = [
        *_fields(ctypes.c_double, "threshold width_ref broad"),
        *_fields(_POINTER, "taps"),
        *_fields(ctypes.c_int64, "reach"),
    ]


class Grouping(ctypes.Structure):
    """`Grouping` of kernels/c/signal.h."""

    _fields_ = [*_fields(ctypes.c_int64, "margin reach most"), *_fields(_POINTER, "tail")]


class CQuiet(ctypes.Structure):
    """`Quiet` of kernels/c/signal.h."""

    _fields_ = [*_fields(ctypes.c_float, "width extra strong"), *_fields(ctypes.c_int64, "reach recovery least")]


class CTail(ctypes.Structure):
    """`Tail` of kernels/c/signal.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "n after"), *_fields(ctypes.c_double, "first step"),
        *_fields(_POINTER, "value highest"),
    ]  # fmt: skip


class CGroups(ctypes.Structure):
    """`Groups` of kernels/c/signal.h."""

    _fields_ = _fields(_POINTER, "waveform low high first number")


class CPoints(ctypes.Structure):
    """`Points` of kernels/c/packets.h."""

    _fields_ = [*_fields(ctypes.c_int64, "n stride"), *_fields(_POINTER, "index offset size location x y z")]


class CRules(ctypes.Structure):
    """`Rules` of kernels/c/packets.h."""

    _fields_ = [
        *_fields(_POINTER, "known good odd packs width samples packed"),
        *_fields(ctypes.c_int64, "least end is_range"),
        *_fields(ctypes.c_double, "unit longest furthest"),
    ]


class CJudged(ctypes.Structure):
    """`Judged` of kernels/c/packets.h."""

    _fields_ = _fields(_POINTER, "reason n_samples keys short packed")


class CWhole(ctypes.Structure):
    """`Whole` of kernels/c/echoes.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "kind n_near n_wide"),
        *_fields(_POINTER, "near_width near wide_width wide"),
        *_fields(ctypes.c_double, "datum ref least"),
    ]


class CKeeping(ctypes.Structure):
    """`Keeping` of kernels/c/echoes.h."""

    _fields_ = [
        *_fields(_POINTER, "std level_err factors"),
        *_fields(ctypes.c_double, "spacing last significance"),
    ]


class CTable(ctypes.Structure):
    """`Table` of kernels/c/echoes.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "m"),
        *_fields(
            _POINTER,
            "waveform time amplitude sigma time_err amplitude_err sigma_err relative_energy_err residual flags row",
        ),
    ]


class COffsets(ctypes.Structure):
    """`Offsets` of kernels/c/returns.h."""

    _fields_ = _fields(_POINTER, "offset doubt known")


class CCurve(ctypes.Structure):
    """`Curve` of kernels/c/neighbours.h."""

    _fields_ = [*_fields(ctypes.c_int64, "n"), *_fields(_POINTER, "lag value")]


class CFaintness(ctypes.Structure):
    """`Faintness` of kernels/c/neighbours.h."""

    _fields_ = [
        *_fields(ctypes.c_double, "share nearest furthest"),
        *_fields(ctypes.c_int64, "after"),
        *_fields(ctypes.c_double, "top clipped"),
        ("tail", CCurve),
        *_fields(ctypes.c_double, "close apart beside factor far_factor known"),
    ]


class CUnexplained(ctypes.Structure):
    """`Unexplained` of kernels/c/neighbours.h."""

    _fields_ = [
        *_fields(ctypes.c_double, "core misfit clear beside energy"),
        ("left", CCurve),
        *_fields(ctypes.c_double, "unit spacing variance misfit2 samples limit"),
    ]


class CFlagging(ctypes.Structure):
    """`Flagging` of kernels/c/neighbours.h."""

    _fields_ = _fields(ctypes.c_double, "spacing last sigma_ref narrow level reach unreliable")


class CFinishing(ctypes.Structure):
    """`Finishing` of kernels/c/finish.h."""

    _fields_ = [
        *_fields(ctypes.c_int64, "sort"),
        *_fields(ctypes.c_double, "gaps twins overlap unresolved"),
        *_fields(_POINTER, "unproven unexplained"),
        *_fields(ctypes.c_int64, "others lone"),
        *_fields(_POINTER, "flagging ringing factors"),
    ]


class Samples(NamedTuple):
    """n waveforms of s samples, with their noise."""

    counts: np.ndarray
    """uint8, uint16, uint32 or float32 (n, s) [DN]."""
    baseline: np.ndarray
    """Level of each waveform, float32 (n,), or of each sample (n, s) [DN]."""
    std: np.ndarray
    """Noise of each waveform, float32 (n,) [DN]."""
    missing: np.ndarray | None = None
    """Samples that were not recorded, bool (n, s); None where there is none."""
    level_err: np.ndarray | None = None
    """Standard deviation of the error of each level, float32 (n,) [DN]; None where they are not known."""

    def checked(self, *, finite: bool = True) -> Samples:
        """The same as the library reads it; raises ValueError where it would read outside of the arrays.

        finite: values must be, for arithmetic; comparisons need only the shapes.
        """
        counts, baseline, std, missing, level_err = self
        n, s = counts.shape
        if counts.dtype not in (np.uint8, np.uint16, np.uint32, np.float32):
            raise ValueError(f"samples of type {counts.dtype} cannot be read")
        if baseline.shape not in ((n,), (n, s)) or std.shape != (n,):
            raise ValueError(f"levels or noise do not have the shape of {n} waveforms of {s} samples")
        if missing is not None and missing.shape != (n, s):
            raise ValueError(f"gaps do not have the shape of {n} waveforms of {s} samples")
        if level_err is not None and level_err.shape != (n,):
            raise ValueError(f"errors of levels do not have the shape of {n} waveforms")
        if finite:
            self._check_values()
        flat = (np.ascontiguousarray(baseline, np.float32), np.ascontiguousarray(std, np.float32))
        gaps = None if missing is None else np.ascontiguousarray(missing, np.bool_)
        errors = None if level_err is None else np.ascontiguousarray(level_err, np.float32)
        return Samples(np.ascontiguousarray(counts), *flat, gaps, errors)

    def _check_values(self) -> None:
        counts, baseline, std, missing, level_err = self
        if not (np.isfinite(baseline).all() and np.isfinite(std).all() and (std > 0).all()):
            raise ValueError("levels and noise must be finite, and the noise above 0")
        if level_err is not None and not np.isfinite(level_err).all():
            raise ValueError("errors of levels must be finite")
        known = np.True_ if counts.dtype != np.float32 else np.isfinite(counts)
        if not (known if missing is None else known | missing).all():
            raise ValueError("samples must be finite where they are not missing")

    def as_block(self) -> Block:
        """The structure, which points into these arrays."""
        counts, baseline, std, missing, level_err = self
        kind = 0 if counts.dtype == np.float32 else counts.dtype.itemsize
        block = Block(
            address(counts), counts.shape[1], kind, place(baseline, np.float32), baseline.ndim - 1,
            place(std, np.float32), None if missing is None else place(missing, np.bool_),
            None if level_err is None else place(level_err, np.float32),
        )  # fmt: skip
        block.arrays = self  # they must live as long as the structure
        return block


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
        for name in FUNCTIONS:
            getattr(library, name).restype = ctypes.c_int64
    except (OSError, AttributeError) as error:
        again = "remove it, it is then built again" if in_checkout else "install wavebatch again on this machine"
        # What the system says, without the path that the message begins with.
        reason = (getattr(error, "strerror", None) or str(error)).removeprefix(f"{LIBRARY}: ")
        raise InputError(
            f"{LIBRARY}: cannot be loaded ({reason}): it is missing, damaged or of another machine; {again}"
        ) from error
    return library


def call(name: str, *arguments: Any) -> int:
    """Calls a function of the library: structures and arrays by reference.

    Raises
    ------
    MemoryError
        There is not enough for its largest waveform or window.
    """
    given = [
        ctypes.c_void_p(address(part))
        if isinstance(part, np.ndarray)  # a survey calls 3,000 times
        else ctypes.byref(part) if isinstance(part, ctypes.Structure) else part
        for part in arguments
    ]  # fmt: skip
    result = getattr(load(), name)(*given)
    if result < 0:
        raise MemoryError("no memory for a window of so many samples and echoes")
    return result


def place(array: np.ndarray, dtype: type) -> int:
    """Address of a contiguous array of this type, for a structure whose owner keeps the array."""
    if array.dtype != dtype or not array.flags.c_contiguous:
        raise ValueError(f"expected a contiguous array of {np.dtype(dtype)}, got {array.dtype}")
    return address(array)


def address(array: np.ndarray) -> int:
    """Address of an array's first value: `array.ctypes.data`, in a fifteenth of the time: surveys ask 10,000 times."""
    return ctypes.c_size_t.from_address(id(array) + _ADDRESS).value

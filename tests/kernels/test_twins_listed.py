"""Compiled kernels, and the hardest of the others, have a slow twin: a plain loop that a test compares with them."""

import ast
from functools import cache
from pathlib import Path

from wavebatch.kernels import library

TESTS = Path(__file__).resolve().parents[1]

COMPILED = {
    "decompose_clusters": ("decompose_clusters", "naive_fit.decompose"),
    "promise_echoes": ("promise_echoes", "naive_fit.propose"), "quiet_levels": ("quiet_levels", "naive.smooth_121"),
    "filter_rows": ("filter_symmetric", "naive.correlate_symmetric"),
    "find_maxima": ("find_maxima", "naive.find_peaks"),
    "find_correlated": ("find_correlated", "test_maxima.naive_matches"),
    "group_candidates": ("cluster_candidates", "test_maxima.naive_clusters"), "exponentials": ("exp", "math.exp"),
    "logarithms": ("log", "math.log"), "solve_equations": ("solve", "np.linalg.solve"),
    "decode_packets": ("decode_packets", "naive_wdz.compress"),
    "describe_waveforms": ("describe_left", "naive_describe.describe"),
    "describe_widths": ("describe_widths", "naive_describe.describe_widths"),
    "learn_pulse": ("gather_pulse", "naive_describe.gather"),
    "render_pulses": ("render_pulses", "naive_describe.render"),
    "pair_differences": ("measure_covariance", "naive_signal.measure_covariance"),
    "judge_packets": ("judge_packets", "naive_packets.judge_packet"),
    "interpolate_columns": ("interpolate", "np.interp"), "fit_stack": ("_refine", "naive_fit.fit_stack"),
    "describe_echoes": ("describe_whole", "naive_fit.describe_whole"), "keep_echoes": ("keep_echoes", "naive_fit.keep"),
    "match_returns": ("match_returns", "naive.match_returns"),
    "weigh_fits": ("find_unexplained", "test_flags.missed"), "finish_echoes": ("finish_echoes", "test_flags.pairs"),
    "find_pulses": ("find_pulses", "test_group_returns._pulses_by_loop"),
    "find_nearest": ("find_nearest", "test_group_returns._nearest_by_loop"),
    "number_returns": ("number_returns", "naive_geometry.number_returns"),
    "share_offsets": ("share_offsets", "test_group_returns._offset_by_loop"),
    "measure_lobes": ("measure_pulse", "naive_fit.measure"),
    "find_two_lines": ("in_two_lines", "test_hough.on_two_lines"),
    "trim_planes": ("fit_planes", "test_planes.naive_plane"),
    "coloured_variance": ("colour_factors", "naive_signal.colour_factors"),
    "find_levels": ("find_levels", "naive_signal.find_level"),
    "explain_tails": ("explain_tails", "test_maxima.naive_tails"),
    "compare_halves": ("compare_halves", "naive.compare_halves"),
    "fit_factors": ("fit_factors", "naive_signal.fit_factors"),
    "find_around": ("Surroundings", "test_planes._neighbours_by_loop"),
}  # fmt: skip
"""Function of the library, the kernel that calls it, and the twin that a test compares that with."""

HARD = {
    "fit_sensor": "naive_geometry.fit_sensor", "find_rays": "naive_geometry.find_rays",
    "match_returns": "naive.match_returns",
    "cross_voxels": "test_voxel_kernels.walk", "angles_above": "naive_physics.angle_above",
    "estimate_canopy_ratio": "naive_physics.estimate_canopy_ratio", "judge_energies": "naive_physics.judge_energies",
    "measure_recovery": "naive_signal.measure_recovery",
    "deconvolve_gold": "naive.gold", "thin_out": "naive_geometry.thin_out",
}  # fmt: skip


@cache
def _names():
    """All names that each test module uses in its functions, without its imports; and the text of every module."""
    used, texts = {}, {}
    modules = ("math.", "np.")
    pairs = [(kernel, twin if twin.startswith(modules) else twin.rpartition(".")[2])
             for kernel, twin in [*COMPILED.values(), *HARD.items()]]  # fmt: skip
    kinds = {ast.Name: "id", ast.Attribute: "attr", ast.Constant: "value"}
    for path in TESTS.rglob("*.py"):
        if path != Path(__file__):
            texts[path.stem] = path.read_text("utf-8")
            if not any(kernel in texts[path.stem] and twin in texts[path.stem] for kernel, twin in pairs):
                continue  # to parse all takes seconds
            body = [node for node in ast.parse(texts[path.stem]).body if not isinstance(node, ast.ImportFrom)]
            nodes = [one for node in body for one in ast.walk(node) if type(one) in kinds]
            used[path] = {getattr(one, kinds[type(one)]) for one in nodes}
    return used, texts


def test_every_function_of_the_library_has_a_twin():
    """A new one needs a row in COMPILED."""
    assert set(COMPILED) == set(library.FUNCTIONS)


def test_twins_stand_beside_their_kernels_in_a_test():
    used, texts = _names()
    for kernel, twin in [*COMPILED.values(), *HARD.items()]:
        module, _, function = twin.rpartition(".")
        assert module in ("", "math", "np", "np.linalg") or f"\ndef {function}(" in texts[module], twin
        beside = any({kernel, function} <= names for path, names in used.items() if path.name.startswith("test_"))
        assert beside, f"no test compares {kernel} with {twin}"

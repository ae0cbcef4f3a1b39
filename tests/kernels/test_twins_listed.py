"""Every public kernel has a slow twin in a test, or a reason why it needs none.

A twin is a plain loop that some test compares with the kernel. The tables are complete: a new kernel must be added.
"""

import ast
from functools import cache
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
KERNELS = TESTS.parent / "wavebatch" / "kernels"

TWINS = {
    "fit": {
        "crlb": "naive.crlb_joint", "fit_closed_form": "naive.closed_form", "estimate_starts": "naive.log_parabola",
        "start_errors": "naive_fit.start_errors", "cluster_candidates": "test_maxima.naive_clusters",
        "decompose_clusters": "naive_fit.decompose", "promise_echoes": "naive_fit.propose",
        "residual_moments": "naive_fit.moments", "stack_pulse": "naive_fit.stack", "evaluate_pulse": "naive.pulse",
        "tail_reach": "naive_fit.tail_reach", "measure_pulse": "naive_fit.measure", "render_echoes": "naive.model",
        "skewed_pulse": "naive.pulse", "render_skewed": "naive.model", "render_pulses": "naive_describe.render",
        "describe_left": "naive_describe.describe", "measure_changes": "naive_describe.measure_change",
        "gather_pulse": "naive_describe.gather", "refine_gaussians": "naive_fit.fit_stack",
        "describe_whole": "naive_fit.describe_whole", "keep_echoes": "naive_fit.keep",
    },
    "kernels": {"judge_packets": "naive_packets.judge_packet"},
    "geometry": {
        "find_bend": "test_bends.naive_gains", "fit_facet": "naive.fit_slope",
        "find_pulses": "naive_geometry.find_pulses", "find_nearest": "naive_geometry.find_nearest",
        "number_returns": "naive_geometry.number_returns", "find_lines": "naive_geometry.find_lines",
        "match_returns": "naive.match_returns", "thin_out": "naive_geometry.thin_out",
        "compare_halves": "naive.compare_halves", "fit_planes": "test_planes.naive_plane",
        "group_pulses": "naive_geometry.group_pulses", "fit_rays": "naive_geometry.fit_rays",
        "sensor_at": "naive_geometry.sensor_at", "range_error": "naive_geometry.range_error",
        "fit_sensor": "naive_geometry.fit_sensor", "fit_best": "naive_geometry.fit_best",
        "find_sweeps": "naive_geometry.find_sweeps", "cut_tiles": "naive_geometry.near_tiles",
        "sort_into_tiles": "naive_geometry.near_tiles", "is_inside": "naive_geometry.near_tiles",
        "in_two_lines": "naive_geometry.variety", "cross_voxels": "test_voxel_kernels.walk",
        "sum_before": "test_voxel_kernels.slow_sum", "find_rays": "naive_geometry.find_rays",
        "group_times": "naive_geometry.group_times",
    },
    "physics": {
        "angles_of_variance": "naive_physics.angle_of_variance", "angles_above": "naive_physics.angle_above",
        "estimate_canopy_ratio": "naive_physics.estimate_canopy_ratio",
        "spread_of_angle": "naive_physics.spread_of_angle", "angle_of_spread": "naive_physics.angle_of_spread",
        "spread_variance": "naive_physics.spread_variance", "pulse_table": "naive_physics.fitted_width",
        "paper_table": "naive_signal.lobe_edges", "spread_pulse": "naive_physics.spread_pulse",
        "direct_width": "naive_signal.lobe_edges", "judge_energies": "naive_physics.judge_energies",
        "receive_power": "naive_physics.receive_power", "spread_cross_section": "naive_physics.spread_cross_section",
        "transmit": "naive_physics.transmit", "backscatter": "naive_physics.backscatter",
        "compute_cross_section": "naive_physics.compute_cross_section",
        "diffuse_reflectance": "naive_physics.diffuse_reflectance",
        "energy_error": "naive_physics.energy_error", "backscatter_error": "naive_physics.backscatter_error",
        "slope_error": "naive_physics.slope_error", "reflectance_error": "naive_physics.reflectance_error",
    },
    "signal": {
        "decode_packets": "naive_wdz.compress", "convolve_pulse": "naive.pulse_matrix",
        "correlate_pulse": "naive.pulse_matrix", "deconvolve_wiener": "naive_signal.wiener",
        "deconvolve_richardson_lucy": "naive.richardson_lucy", "deconvolve_gold": "naive.gold",
        "find_spikes": "naive_signal.find_spikes", "find_pattern": "naive_signal.find_pattern",
        "find_transient": "naive_signal.find_transient", "fit_slopes": "naive_signal.fit_slope",
        "filter_symmetric": "naive.correlate_symmetric",
        "filter_antisymmetric": "naive.correlate_antisymmetric", "run_moments": "naive.find_runs",
        "refine_peaks": "naive_signal.refine_peak",
        "find_maxima": "naive.find_peaks",
        "measure_covariance": "naive_signal.measure_covariance", "measure_recovery": "naive_signal.measure_recovery",
        "find_levels": "naive_signal.find_level", "keep_longest": "naive_signal.keep_longest",
        "residual_noise": "naive_signal.residual_noise", "whitening_filter": "naive_fit.whiten",
        "colour_factors": "naive_signal.colour_factors",
        "find_reference": "naive_signal.find_reference", "measure_outgoing": "naive_signal.measure_outgoing",
        "fit_height": "naive_signal.fit_height", "keep_signal": "naive_signal.keep_runs",
        "measure_offsets": "naive_signal.measure_offset", "find_runs": "naive.find_runs",
        "lobe_edges": "naive_signal.lobe_edges", "walk_down": "naive.walk_down",
        "find_stretches": "naive_signal.find_stretches", "recorded_lengths": "naive_signal.recorded_length",
        "smooth_121": "naive.smooth_121", "find_peaks": "naive.find_peaks", "widen": "naive.widen",
        "widen_after": "naive_signal.widen_after", "find_quiet": "naive_signal.find_quiet",
        "sum_samples": "naive_signal.add_up", "square_differences": "naive.square_differences",
        "find_minima": "naive.find_minima", "keep_prominent": "naive.keep_prominent",
        "b3_detail": "naive.b3_detail",
    },
}  # fmt: skip
"""By folder: kernel and the twin that a test compares it with."""

LIBRARIES = {
    "exp": "math.exp", "log": "math.log", "log1p": "math.log1p", "solve": "np.linalg.solve",
    "fit_parabola": "np.polyfit", "fit_bounded": "least_squares", "fit_one_gaussian": "least_squares",
    "interpolate": "np.interp", "wiener_taps": "wiener_taps", "coloured_variance": "toeplitz",
}  # fmt: skip
"""Kernels that a test compares with a function of NumPy, SciPy or the standard library."""

BY_LOOP = {
    "choose", "tail_at", "build_table", "find_ends", "quiet_edges", "accumulate", "quiet_mean",
    "filter_autocorrelation", "window_signal", "list_samples", "highest_samples", "slide_taps", "slide_energy",
    "pad_samples", "smooth_b3", "gap_distance", "split_rays", "pack_index", "unpack_index", "fits_keys",
    "differences_along", "fill_spikes",
}  # fmt: skip
"""Kernels whose loop is short and stands in their test."""

NO_TWIN = {
    "find_datum": "tests of pulses with a known place",
    "predict_noise": "tests put it into the equations that it solves",
    "find_seam": "tests on plain counts with a known seam",
    "bound_time": "a formula; crlb, which has a twin, is made of it",
    "fit_gaussians": "its fit is that of refine_gaussians; tests learn known sums again",
    "as_pulse": "a structure; the library's tests refuse wrong ones",
    "count_echoes": "a sum; describe_left, which has a twin, is called with it",
    "fit_skewed": "the same with the skewed pulse",
    "evaluate_unit": "the Gaussian of evaluate_pulse in place",
    "pulse_tail": "evaluate_pulse less its main part",
    "tabulate_pulse": "tests fit tabulated pulses as the pulses that they were made of",
    "misfit_of_angles": "tests at known ridges compare its error with the true angle",
    "is_flat": "one comparison",
    "grow_tree": "SciPy's tree, imported when it is needed",
    "along_ray": "a projection; find_rays, which has a twin, is made of it",
    "on_ray": "a distance; find_rays, which has a twin, is made of it",
    "measure_angles": "tests of known planes, and of the scatter that its error states",
    "find_edges": "tests/surveying/test_signed_physics.py: traced roofs whose ground lies outside of the packets",
    "mean_haze": "an integral of an exponential; numbers in its test",
    "measure_normals": "planes, neighbours and halves have twins; tests of known roofs",
    "attenuation_of_visibility": "published numbers",
    "usual_attenuation": "the power law in its test",
    "known_distance": "one comparison",
    "filter_energy": "a sum of squares",
    "gaussian_taps": "a formula",
    "curvature_taps": "a formula",
    "slope_taps": "tests on straight lines",
    "estimate_noise": "its parts have twins; tests of known noise",
    "quiet_levels": "its test compares it with find_levels, which has a twin",
    "find_fill": "tests of damaged recordings with a known gap",
    "quiet_fill": "tests of damaged recordings with a known gap",
    "transpose_samples": "a copy",
    "floor_share": "normal noise in a table",
    "floor_response": "the same; tests of noise that is cut off at a known level",
    "undo_floor": "tests of noise that is cut off at a known level",
    "b3_gain": "the norm of b3_detail of one sample",
    "b3_level": "tests of known widths",
}


@cache
def _tests():
    """Text of every test module but this one, by its path."""
    return {path: path.read_text("utf-8") for path in TESTS.rglob("*.py") if path != Path(__file__)}


def _public():
    """(folder, name) of all public functions."""
    skipped = {"build_kernels.py", "library.py"}  # no arithmetic
    for path in KERNELS.rglob("*.py"):
        if path.name not in skipped:
            for node in ast.parse(path.read_text("utf-8")).body:
                if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                    yield path.parent.name, node.name


def _names(node):
    """Names, attributes and texts: a test may look functions up by name."""
    kinds = {ast.Name: "id", ast.Attribute: "attr", ast.Constant: "value"}
    return {getattr(one, kinds[type(one)]) for one in ast.walk(node) if type(one) in kinds}


@cache
def _used():
    """All names that each test module uses in its functions, without its imports."""
    found = {}
    for name, text in _tests().items():
        if name.stem.startswith("test_"):
            body = [node for node in ast.parse(text).body if not isinstance(node, ast.Import | ast.ImportFrom)]
            found[name] = set().union(*(_names(node) for node in body))
    return found


def test_every_kernel_has_a_twin_or_a_reason():
    listed = [name for folder in TWINS.values() for name in folder] + [*LIBRARIES, *BY_LOOP, *NO_TWIN]
    public = list(_public())
    assert len(listed) == len(set(listed)), "twice in the tables"
    assert {name for _, name in public} == set(listed)
    assert {(folder, name) for folder, names in TWINS.items() for name in names} <= set(public)


def test_twins_stand_beside_their_kernels_in_a_test():
    for kernel, twin in {name: twin for folder in TWINS.values() for name, twin in folder.items()}.items():
        module, function = twin.split(".")
        assert any(f"\ndef {function}(" in text for path, text in _tests().items() if path.stem == module), twin
        beside = any({kernel, function} <= used for used in _used().values())
        assert beside, f"no test compares {kernel} with {twin}"


def test_the_other_kernels_are_called_by_a_test_too():
    """Through a stage alone, a wrong kernel would be one of many reasons of a failure."""
    for kernel in (*LIBRARIES, *BY_LOOP):
        assert any(kernel in used for used in _used().values()), kernel

"""The layers hold: imports go down only, and only the places that may know click, laspy or executors do."""

import ast
import functools
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent / "wavebatch"
MODULES = sorted(ROOT.rglob("*.py"))

ROOMS = ["core", "kernels", "files", "stages", "surveying", "batch", "tools", "cli", "__main__"]
"""From the bottom up: a room imports only rooms before it."""

RANK = {name: rank for rank, name in enumerate(ROOMS)}

INSIDE = {
    "batch": [
        {"counts", "options", "output_rows", "workers"}, {"job"}, {"unit"},
        {"neighbour_pass", "report_file"}, {"strip_task"}, {"run"},
    ],
    "surveying/measuring": [
        {"noise_and_width"}, {"residuals"},
        {"tails", "learn_pulse", "judge", "return_scatter"}, {"misfit", "joint_pulse"}, {"mirror"},
        {"choose_pulse", "whitening"},
    ],
    "batch/workers": [
        {"futures", "serve", "worker_check"}, {"spawned"}, {"processes"}, {"dask_cluster"},
    ],
    "surveying": [
        {"measuring"}, {"look", "predict_error"}, {"survey", "sensor"}, {"outgoing"},
        {"choose_chain", "calibration"}, {"flat_ground"}, {"inspect_strip"}, {"flight"}, {"prepare"},
    ],
}
"""The same within packages whose modules do one thing after another."""


def _part(path: Path) -> str:
    """The top module or package that a file belongs to."""
    relative = path.relative_to(ROOT)
    return relative.parts[0].removesuffix(".py")


@functools.cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


@functools.cache
def _imports(path: Path) -> set[str]:
    """Full names of all modules that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return names


def _imports_at_once(path: Path) -> list[str]:
    """Our modules that are imported with the file itself: not those that only type checkers import."""
    nodes = _tree(path).body
    froms = [node.module for node in nodes if isinstance(node, ast.ImportFrom)]
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return [name for name in (*froms, *names) if name.split(".")[0] == "wavebatch"]


def _used(path: Path) -> set[str]:
    """Our own parts that a file imports; the bare package (for its version) is none."""
    parts = {name.split(".")[1] for name in _imports(path) if name.startswith("wavebatch.")}
    return {part for part in parts if (ROOT / part).is_dir() or (ROOT / f"{part}.py").exists()}


def _outside(path: Path) -> set[str]:
    return {name.split(".")[0] for name in _imports(path)}


def test_imports_go_down_only():
    for path in MODULES:
        part = _part(path)
        if part == "__init__":
            assert not _imports_at_once(path)
            continue
        assert part in RANK, f"{part} is none of the rooms; add it to ROOMS"
        for used in _used(path) - {part}:
            assert RANK[used] <= RANK[part], f"{path} must not import {used}"


@pytest.mark.parametrize("package", INSIDE)
def test_imports_go_down_inside_packages_too(package):
    """A name in INSIDE is that of a module, or of a folder with all of its modules."""
    rank = {name: rank for rank, names in enumerate(INSIDE[package]) for name in names}
    modules = {path.stem for path in (ROOT / package).glob("*.py")} - {"__init__"}
    assert {name for name in rank if not (ROOT / package / name).is_dir()} == modules
    start = f"wavebatch.{package.replace('/', '.')}."
    for name, own in rank.items():
        folder = ROOT / package / name
        for path in folder.rglob("*.py") if folder.is_dir() else [folder.with_suffix(".py")]:
            used = {one.removeprefix(start).split(".")[0] for one in _imports(path) if one.startswith(start)}
            for other in used & rank.keys():
                assert rank[other] <= own, f"{path} must not import {other}"


def test_no_circle_of_imports():
    graph: dict[str, set[str]] = {}
    for path in MODULES:
        name = ".".join(("wavebatch", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
        graph[name] = _imports(path) if name != "wavebatch" else set()  # the public names are imported lazily
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail, name))
        if name in done:
            return
        for other in sorted(graph[name] & graph.keys() - {name}):
            visit(other, (*trail, name))
        done.add(name)

    for name in graph:
        visit(name, ())


def test_kernels_know_arrays_only():
    allowed = {"numpy", "scipy", "wavebatch", "__future__", "dataclasses", "collections", "math", "functools",
               "itertools", "typing", "enum", "ctypes"}  # fmt: skip
    kernels = [path for path in MODULES if _part(path) == "kernels" and path.name != "build_kernels.py"]
    assert len(kernels) > 20
    for path in kernels:
        ours = {name for name in _imports(path) if name.startswith("wavebatch.core.")}
        known = ("wavebatch.core.units", "wavebatch.core.order", "wavebatch.core.frozen")
        known += ("wavebatch.core.errors",) * (path.name == "library.py")
        assert all(name.startswith(known) for name in ours), (path, ours)
        assert _outside(path) <= allowed, path


def test_only_io_knows_laspy():
    for path in MODULES:
        if _outside(path) & {"laspy", "lazrs"}:
            assert _part(path) == "files", path


def test_only_batch_knows_executors():
    for path in MODULES:
        if _outside(path) & {"concurrent", "multiprocessing"}:
            assert _part(path) == "batch", path


def test_only_the_command_line_knows_click_prints_or_exits():
    for path in MODULES:
        if _part(path) in {"cli", "__main__"}:
            continue
        assert not _outside(path) & {"click", "tqdm"}, path
        for node in ast.walk(_tree(path)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in {"print", "exit", "quit"}, f"{path}:{node.lineno}"
            if isinstance(node, ast.Attribute) and node.attr == "exit" and isinstance(node.value, ast.Name):
                assert node.value.id != "sys", f"{path}:{node.lineno}"


def test_no_other_dependency_at_run_time():
    allowed = {"laspy", "lazrs", "numpy", "scipy", "click", "tqdm", "wavebatch"}
    import sys

    for path in MODULES:
        peers = {"gdecomp"} if path.name == "peers.py" else set()
        peers |= {"matplotlib", "mpl_toolkits"} if _part(path) == "tools" or path.name == "figure_file.py" else set()
        projecting = ("trajectory_file.py", "crs.py", "geojson.py")
        peers |= {"pyproj"} if path.name in projecting else set()
        peers |= {"dask", "distributed"} if path.parent.name == "workers" else set()
        peers |= {"setuptools"} if path.name == "build_kernels.py" else set()
        peers |= {"pandas"} if path.name == "echoes.py" else set()
        peers |= {"rasterio"} if path.name == "geotiff_file.py" else set()
        assert _outside(path) <= allowed | peers | sys.stdlib_module_names, path


def test_no_folder_holds_more_than_a_person_can_look_over():
    for folder in {path.parent for path in MODULES}:
        assert len(list(folder.glob("*.py"))) <= 15, folder


def _is_command(node: ast.AST) -> bool:
    """Whether a function is a command of click, which has the name that users type."""
    decorators = " ".join(map(ast.unparse, getattr(node, "decorator_list", ())))
    return "command(" in decorators or "draws_clouds(" in decorators


def test_no_two_classes_or_functions_have_one_name():
    """A public name of a module says what it is without its folder."""
    places: dict[str, set[Path]] = {}
    for path in MODULES:
        for node in _tree(path).body:
            named = isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_")
            if named and not _is_command(node):
                places.setdefault(node.name, set()).add(path)  # once for all its overloads; F811 finds the others
    assert len(places) > 1000
    assert {name: paths for name, paths in places.items() if len(paths) > 1} == {}


def test_quick_cases_are_cases(request):
    """A test whose quick cases are misspelt would never run among the fast ones."""
    assert [one for one, cases in request.config.quick_cases.items() if not cases] == []

"""`make dist`: libraries and wheels of all platforms come from one machine."""

import importlib.util
import zipfile

import pytest
import wheels
from commands import refuses
from compilers import install_zig
from wheels import TARGETS

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def zig(tmp_path_factory):
    return install_zig(tmp_path_factory.mktemp("zig"))


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.tag)
def test_the_library_of_each_platform_is_whole(target, zig, tmp_path):
    library = wheels.compile_for(target, tmp_path, *zig)
    wheels.check_library(target, library)
    assert [path.name for path in tmp_path.iterdir()] == [library.name]
    others = [other for other in TARGETS if other.machine != target.machine]
    refuses(AssertionError, "is not for", wheels.check_library, others[0], library)
    library.write_bytes(library.read_bytes().replace(b"find_maxima\0", b"find_minima\0"))
    refuses(AssertionError, "lacks find_maxima", wheels.check_library, target, library)


def test_a_newer_glibc_is_seen(tmp_path):
    library = tmp_path / "_kernels.so"
    names = b"".join(name.encode() + b"\0" for name in wheels.FUNCTIONS)
    library.write_bytes(bytes(18) + TARGETS[0].machine + names + b"GLIBC_2.29\0")
    refuses(AssertionError, r"asks for glibc \(2, 29\)", wheels.check_library, TARGETS[0], library)


def test_wheels_and_source_are_written(zig, tmp_path):
    """Of Windows: that of this machine would be installed with all it needs, which `make dist` does."""
    # Not imported: setuptools cannot be, once a test of this process has looked for pip, as `core/errors.py` does.
    if importlib.util.find_spec("setuptools") is None:
        pytest.skip("needs setuptools")
    wheels.build_all(tmp_path, *zig, (TARGETS[-1],))
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.endswith("-py3-none-win_amd64.whl") and len(list(tmp_path.glob("*.tar.gz"))) == 1
    with zipfile.ZipFile(wheel) as archive:
        kernels = [name for name in archive.namelist() if "/_kernels." in name]
    assert kernels == ["wavebatch/kernels/_kernels.dll"]

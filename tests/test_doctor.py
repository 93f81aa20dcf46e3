"""What the doctor says of this machine, and of machines that lack something."""

from __future__ import annotations

import importlib
import sys

import pytest

from finqd import doctor
from finqd.errors import MissingLibraryError


def by_subject(findings):
    return {finding.subject: finding for finding in findings}


@pytest.fixture
def imports_that_fail(monkeypatch):
    """Return a dict, module -> exception to raise when the doctor imports it."""
    failures = {}
    real = importlib.import_module

    def import_module(name):
        if name in failures:
            raise failures[name]
        return real(name)

    monkeypatch.setattr(doctor, "import_module", import_module)
    return failures


def test_every_dependency_of_the_distribution_is_examined():
    from importlib.metadata import requires

    from packaging.requirements import Requirement

    needed = {r.name for r in map(Requirement, requires("finqd")) if not (r.marker and "extra" in str(r.marker))}
    assert needed == set(doctor.LIBRARIES.values())


def test_this_machine_is_fit_and_every_library_has_its_version():
    found = by_subject(doctor.examine())
    for module in doctor.LIBRARIES:
        assert found[module].status == "ok", found[module]
        assert found[module].detail[0].isdigit(), found[module]
    assert doctor.fit([finding for finding in found.values() if finding.subject != "bundled files"])


def test_gmsh_without_its_shared_libraries_gets_the_apt_line(imports_that_fail):
    imports_that_fail["gmsh"] = OSError("libGLU.so.1: cannot open shared object file: No such file or directory")
    with pytest.raises(MissingLibraryError, match=r"libGLU.so.1.*apt-get install libglu1-mesa .* libgomp1$") as caught:
        doctor.require_gmsh()
    assert "\n" not in str(caught.value)
    finding = by_subject(doctor.examine())["gmsh"]
    assert finding.status == "missing" and "apt-get install" in finding.detail


def test_a_missing_library_is_missing_and_says_how_to_get_it(imports_that_fail):
    imports_that_fail["fcl"] = ModuleNotFoundError("No module named 'fcl'")
    imports_that_fail["gmsh"] = ModuleNotFoundError("No module named 'gmsh'")
    findings = doctor.examine()
    assert not doctor.fit(findings)
    assert "pip install python-fcl" in by_subject(findings)["fcl"].detail
    assert by_subject(findings)["gmsh"].detail.endswith("pip install gmsh")


def test_a_missing_optional_solver_does_not_make_the_machine_unfit(imports_that_fail):
    imports_that_fail["qdldl"] = ModuleNotFoundError("No module named 'qdldl'")
    finding = by_subject(doctor.examine())["solver qdldl"]
    assert finding.status == "optional" and "pip install qdldl" in finding.detail
    assert doctor.fit([finding])


@pytest.mark.parametrize(("backends", "status"), [(("qdldl", "superlu"), "optional"), (("pardiso", "qdldl"), "ok")])
def test_mkl_is_looked_for_as_the_solver_does(monkeypatch, backends, status):
    from finqd.mechanics import linear_backends

    monkeypatch.setattr(linear_backends, "available_backends", lambda: backends)
    finding = by_subject(doctor.examine())["solver mkl"]
    assert finding.status == status and doctor.fit([finding])
    assert ("finqd[fast]" in finding.detail) == (status == "optional")


def test_an_old_python_is_told_apart_from_a_new_one():
    assert doctor._python((3, 10, 9)).status == "missing"
    assert doctor._python((3, 11, 0)).status == "ok"


def test_a_cache_folder_that_cannot_be_written_is_missing(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert doctor._kernel_cache().status == "ok"
    blocker = tmp_path / "file"
    blocker.write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocker / "cache"))  # root may write anywhere, but not below a file
    assert doctor._kernel_cache().status == "missing"


def test_require_gmsh_returns_the_module():
    assert doctor.require_gmsh() is sys.modules["gmsh"]

"""The wheel in an environment of its own, used from an empty folder; and what the light parts import."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
import zipfile
from importlib import import_module
from pathlib import Path

import pytest

import finqd
from finqd import data, registry

ROOT = Path(__file__).resolve().parent.parent
#: what costs time or may be missing: nothing of it may load before it is needed
HEAVY = {
    "gmsh", "numpy", "matplotlib", "numba", "trimesh", "scipy", "fcl", "ribs", "meshio", "shapely", "pydantic", "rich",
    "qdldl", "llvmlite",
}


def loaded_after(code: str) -> set[str]:
    """Return the top-level modules that a fresh interpreter has loaded after ``code``."""
    program = f"import sys\n{code}\nprint('\\n'.join({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_finqd_loads_nothing_but_the_standard_library():
    foreign = loaded_after("import finqd") - loaded_after("import importlib") - {"finqd"}
    assert foreign <= set(sys.stdlib_module_names), foreign


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["evaluate", "--help"], ["plugins", "--help"]])
def test_help_loads_nothing_heavy(arguments):
    call = f"from finqd.cli import main\ntry:\n    main({arguments!r})"
    code = f"{call}\nexcept SystemExit as end:\n    assert end.code == 0"
    modules = loaded_after(code)
    assert {"click", "finqd"} <= modules
    assert not modules & HEAVY


#: a block that falls on the floor, by the plugins of a preset, with all that an evaluation imports
TINY = """
import finqd.evaluate
from finqd.data import designs_folder
from finqd.design import Design
from finqd.mesh_shapes import box_mesh
from finqd.presets import apply_preset
from finqd.scene import Scene
from finqd.simulate import simulate

design = apply_preset(Design.from_json(designs_folder() / "benchmark.json"), "draft")
for kind in ("geometry", "mesher", "actuation", "fitness", "features"):
    assert design.plugin(kind)
scene = Scene()
scene.add_soft(box_mesh((0.01, 0.01, 0.01), (1, 1, 1)), design.material, elasticity=design.plugin("elasticity"))
scene.add_plane(point=(0.0, 0.0, -1e-4))
found = simulate(scene, duration=0.01, time_step=0.005, stepper=design.plugin("stepper"),
                 contact=design.plugin("contact"))
assert found.status == "ok" and len(found.times) == 3
"""


def test_an_evaluation_loads_no_effect_and_no_library_that_it_does_not_use():
    program = f"import sys\n{TINY}\nprint('\\n'.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    others = ("ipc", "explicit", "imex", "bdf2", "quasi_static", "neo_hookean", "condensation", "elasticity_linear")
    own = {name.rpartition(".")[2] for name in loaded if name.startswith("finqd.")}
    assert {"contact_penalty", "contact_kernels", "corotated_kernels"} <= own
    assert not [name for name in own if any(word in name for word in others)]
    unused = {"trimesh", "networkx", "gmsh", "ipctk", "matplotlib", "meshio", "ribs", "rich", "shapely"}
    assert not unused & {name.partition(".")[0] for name in loaded}


def test_every_public_name_is_there_once_and_loads():
    assert len(set(finqd.__all__)) == len(finqd.__all__)
    for name in finqd.__all__:
        value = getattr(finqd, name)
        assert name == "__version__" or value.__module__ == finqd._HOMES[name], name
    assert set(finqd.__all__) == set(dir(finqd))
    with pytest.raises(AttributeError, match="has no attribute 'Desing'"):
        finqd.Desing  # noqa: B018


def test_every_entry_point_of_pyproject_is_installed_and_loads():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    expected = {
        (group.removeprefix("finqd."), name, target)
        for group, plugins in declared.items() for name, target in plugins.items()
    }
    found = {(e.kind, e.name, e.target) for e in registry.entries() if e.distribution == "finqd"}
    assert found == expected, "pyproject.toml changed since finqd was installed: install it again"
    for kind, name, target in expected:
        module, _, attribute = target.partition(":")
        assert registry.load(kind, name) is getattr(import_module(module), attribute)


def test_no_module_of_the_core_imports_a_plugin():
    for path in (ROOT / "finqd").rglob("*.py"):
        if path.parent.name != "plugins":
            text = path.read_text()
            assert "from finqd.plugins" not in text and "import finqd.plugins" not in text, path


def test_the_folders_are_found_in_a_checkout():
    assert data.objects_folder() == ROOT / "objects" and data.designs_folder() == ROOT / "designs"
    assert data.studies_folder() == ROOT / "studies"
    assert len(data.bundled_names(data.objects_folder())) == 10
    assert "benchmark" in data.bundled_names(data.designs_folder())


def test_the_wheel_holds_the_package_its_data_and_nothing_else(wheel_environment):
    (wheel,) = (wheel_environment.folder / "wheels").glob("finqd-*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.partition("/")[0] for name in names}
    assert tops == {"finqd", f"finqd-{finqd.__version__}.dist-info"}
    for folder in ("objects", "designs", "studies"):
        carried = {Path(name).name for name in names if name.startswith(f"finqd/bundled/{folder}/")}
        assert {path.name for path in (ROOT / folder).glob("*.json")} <= carried
    pages = {path.name for path in (ROOT / "finqd" / "page").iterdir()}
    assert pages == {Path(name).name for name in names if name.startswith("finqd/page/")} and "page.html" in pages
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.endswith((".nbi", ".nbc", ".pyc"))]


def test_the_installed_wheel_is_what_runs_and_knows_its_objects_and_designs(wheel_environment, tmp_path):
    code = "import finqd, finqd.data as d; print(finqd.__file__, d.objects_folder(), d.designs_folder(), sep='\\n')"
    lines = wheel_environment.run("python", "-c", code, cwd=tmp_path).stdout.split()
    assert all(Path(line).is_relative_to(wheel_environment.site_packages) for line in lines), lines
    assert "benchmark" in wheel_environment.run("finqd", "designs", cwd=tmp_path).stdout
    objects = wheel_environment.run("finqd", "objects", cwd=tmp_path).stdout
    assert all(path.stem in objects for path in (ROOT / "objects").glob("*.json"))
    assert wheel_environment.run("finqd", "--help", cwd=tmp_path).stdout.startswith("Usage: finqd")
    schema = json.loads(wheel_environment.run("finqd", "schema", cwd=tmp_path).stdout)
    assert "spacing_mm" in schema["properties"]
    listed = wheel_environment.run("python", "-m", "finqd", "plugins", cwd=tmp_path).stdout
    assert all(f"{entry.kind} {entry.name}" in listed for entry in registry.entries())
    assert not list(tmp_path.iterdir()), "a command that only shows something wrote a file"

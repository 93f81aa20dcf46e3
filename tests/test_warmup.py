"""What ``finqd warmup`` compiles is what evaluations use, and once only."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from finqd import registry
from finqd.data import designs_folder
from finqd.design import Design
from finqd.errors import InputError
from finqd.mechanics.compiled import njit
from finqd.presets import apply_preset
from finqd.warmup import KINDS, _families, _told, warm_up

BENCHMARK = Design.from_json(designs_folder() / "benchmark.json")

#: warms up, then evaluates, in a process that knows no kernel yet; counts after each
PROGRAM = """
import json
from finqd.data import designs_folder
from finqd.design import Design
from finqd.evaluate import evaluate
from finqd.mechanics.compiled import kernel_counts
from finqd.warmup import warm_up

warm_up("draft")
warmed = kernel_counts()
short = {"mesher.size_mm": 8.0, "protocol.close_s": 0.5, "protocol.lift_s": 0.2, "protocol.hold_s": 0.1}
result = evaluate(Design.from_json(designs_folder() / "benchmark.json"), objects=["cube"], preset="draft",
                  overrides=short)
print(json.dumps([warmed, kernel_counts(), max(result.trajectories["cube"].contact_forces[-1])]))
"""
COMPILES = pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")


def output_of(*arguments: str) -> str:
    """Return what a new Python prints; it must not have anything to complain of."""
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout


@COMPILES
def test_what_has_been_warmed_up_is_loaded_and_nothing_compiled() -> None:
    assert output_of("-m", "finqd", "warmup", "--preset", "draft", "--quiet") == ""
    family, total = output_of("-m", "finqd", "warmup", "--preset", "draft").splitlines()
    counts = re.match(r"corotated, penalty, implicit_euler: 0 compiled, (\d+) loaded, [\d.]+ s$", family)
    assert counts is not None and int(counts[1]) > 30
    assert re.match(rf"0 kernels compiled, {counts[1]} loaded in [\d.]+ s; they are in .*kernels-\w+$", total)


@COMPILES
@pytest.mark.slow
def test_an_evaluation_needs_no_kernel_that_warmup_has_not_seen_to() -> None:
    warmed, evaluated, force = json.loads(output_of("-W", "ignore", "-c", PROGRAM))
    assert evaluated == warmed and sum(warmed) > 30, "something else was compiled or loaded"
    assert force > 0.1, "the grasp has to touch"


def test_all_is_every_other_plugin_that_has_kernels_once() -> None:
    design = apply_preset(BENCHMARK, "standard")
    assert [name for name, _ in _families(design, everything=False)] == ["corotated, penalty, implicit_euler"]
    found = list(_families(design, everything=True))
    others = {f"{kind} {name}" for kind in KINDS for name in registry.names(kind)} - {
        "elasticity corotated", "contact penalty", "stepper implicit_euler"
    }
    assert found[1][0] == "damping" and found[1][1].material.rayleigh_stiffness > 0.0
    assert {name for name, _ in found[2:]} == others and len(found) == 2 + len(others)
    assert all(name == f"{kind} {chosen.spec(kind)['name']}" for name, chosen in found[2:] for kind in name.split()[:1])


@COMPILES
def test_every_kernel_that_is_compiled_is_told_of_when_it_is_done() -> None:
    @njit()
    def inner(x):
        return 2.0 * x

    @njit()
    def outer(x):
        return inner(x) + 1.0

    told: list[str] = []
    with _told(told.append):
        assert outer(1.0) == outer(2.0) - 2.0
    assert [re.sub(r"[\d.]+ s$", "", line) for line in told] == [
        "compiled test_warmup.inner in ", "compiled test_warmup.outer in "
    ]


@COMPILES
def test_where_nothing_can_be_kept_it_says_so_and_does_not_begin(run, tmp_path: Path, monkeypatch) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocker / "below"))
    code, out, err = run("warmup")
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert "below: is not writable, so that every process compiles its kernels for itself" in err


def test_without_a_compiler_there_is_nothing_to_warm_up(monkeypatch) -> None:
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    with pytest.raises(InputError, match="^NUMBA_DISABLE_JIT: is set, so that no kernel is compiled$"):
        warm_up()
    with pytest.raises(InputError, match="no preset 'quick'"):
        warm_up("quick")

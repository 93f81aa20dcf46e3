"""Every registered plugin against its contract, and the kit itself against plugins that break theirs."""

from __future__ import annotations

import pytest

from finqd import checks, registry
from finqd.contracts import KINDS
from finqd.errors import InputError, PluginError


@checks.parametrize_with_checks()
def test_conformance(check, kind, name):
    check(kind, name)


def test_every_registered_plugin_is_checked_and_every_kind_has_checks_of_its_own():
    found = {(kind, name) for _, kind, name in checks.cases()}
    assert found == {(entry.kind, entry.name) for entry in registry.entries()}
    assert {kind for kind, _ in found} == set(KINDS)
    for kind in KINDS:
        assert len(checks.checks_of(kind)) > len(checks.EVERY_KIND)
        for check in checks.checks_of(kind):
            assert check.__doc__ and check.__name__.startswith("check_")


def test_a_distribution_is_checked_alone_and_never_silently_not_at_all(make_distribution):
    make_distribution("Fake.Meshers", {"mesher": {"fake": "fake_meshers:Fake"}})
    found = list(checks.cases(distribution="fake-meshers"))
    assert {(kind, name) for _, kind, name in found} == {("mesher", "fake")}
    with pytest.raises(InputError, match="no plugin to check is registered by not-installed"):
        checks.parametrize_with_checks(distribution="not-installed")
    with pytest.raises(PluginError, match="no plugin kind 'mush'"):
        checks.checks_of("mush")


WRONG = '''
from __future__ import annotations
from dataclasses import dataclass, field
from typing import ClassVar
import numpy as np
from finqd import registry
from finqd.contracts import Parameter
from finqd.mechanics.material import Material
from finqd.solid import SurfaceSolid

@dataclass
class Thawed:
    size_mm: float = 1.0

@dataclass(frozen=True)
class Secretive:
    """Its default is not JSON."""
    limit: float = float("inf")

@dataclass(frozen=True)
class OpenBox:
    """A tetrahedron without one of its sides."""
    finger_parameters: ClassVar = (
        Parameter(name="length", unit="mm", low=1, high=2, allowed_low=1, allowed_high=2, description="edge"),
        Parameter(name="idle", unit="mm", low=1, high=2, allowed_low=1, allowed_high=2, description="does nothing"),
    )
    def check(self, finger):
        return None
    def build(self, finger):
        corners = finger["length"] * np.array([(0, 0, -1), (1, 0, 0), (0, 0, 1), (0, 1, 0)], dtype=float)
        return SurfaceSolid(corners, np.array([(0, 1, 2), (0, 3, 1), (1, 3, 2)]))

class Off:
    def __init__(self, inner, scale): self.inner, self.scale, self.cliques = inner, scale, inner.cliques
    def energy(self, positions): return self.inner.energy(positions)
    def add_gradient(self, positions, gradient):
        own = np.zeros_like(gradient)
        energy = self.inner.add_gradient(positions, own)
        gradient += self.scale * own
        return energy
    def add_hessian(self, positions, slots, blocks, *, projected=False):
        self.inner.add_hessian(positions, slots, blocks, projected=False)

@dataclass(frozen=True)
class OffElasticity:
    """A gradient that is a thousandth too large, and a Hessian that is never projected."""
    def potential(self, mesh, material, *, first_vertex=0):
        inner = registry.create("elasticity", "corotated")
        return Off(inner.potential(mesh, material, first_vertex=first_vertex), 1.001)

@dataclass(frozen=True)
class Jerky:
    """Starts at full speed."""
    def motions(self, placements):
        from finqd.scene import Motion, Turn
        class Straight(Motion):
            def pose(self, progress, time):
                return self.path.pose(progress)
        return [Straight(path=Turn(point=p[:3, 3], axis=p[:3, 2], angle=0.5), duration=1.0) for p in placements]

@dataclass(frozen=True)
class Opening:
    """Moves the wrong way."""
    def motions(self, placements):
        from finqd.scene import Motion, Turn
        return [Motion(path=Turn(point=p[:3, 3], axis=p[:3, 2], angle=-0.5), duration=1.0) for p in placements]

@dataclass(frozen=True)
class Constant:
    """The same for all designs, under another name."""
    names: ClassVar = ("area_mm2",)
    def measure(self, design, solids):
        return {"volume_mm3": 1.0}

@dataclass(frozen=True)
class Heedless:
    """Knows no damping at all."""
    def step(self, system, state, dt):
        system.damping = None
        return registry.create("stepper", "implicit_euler").step(system, state, dt)

@dataclass(frozen=True)
class Inviscid:
    """Knows drag only."""
    def step(self, system, state, dt):
        system.damping.viscous = ()
        return registry.create("stepper", "implicit_euler").step(system, state, dt)

@dataclass(frozen=True)
class Modest:
    """Says that it has no damping by the stiffness, and does not mind."""
    stiffness_damping: ClassVar = False
    def step(self, system, state, dt):
        return registry.create("stepper", "implicit_euler").step(system, state, dt)

@dataclass(frozen=True)
class Sinking:
    """No contact at all."""
    def potential(self, scene):
        from finqd.scene import Scene
        return registry.create("contact", "penalty").potential(
            type("Bare", (), {"__getattr__": lambda self, key: [] if key == "planes" else getattr(scene, key)})()
        )
'''


@pytest.mark.parametrize(
    ("kind", "plugin", "check", "said"),
    [
        ("mesher", "Thawed", "is_a_frozen_dataclass", "not frozen"),
        ("mesher", "Thawed", "says_what_it_is", "no docstring"),
        ("mesher", "Secretive", "options_are_json", "JSON"),
        ("geometry", "OpenBox", "builds_every_design", "not closed"),
        ("geometry", "OpenBox", "every_parameter_matters", "idle_mm changes nothing"),
        ("elasticity", "OffElasticity", "gradient_is_of_the_energy", "the energy's slope"),
        ("elasticity", "OffElasticity", "hessian_is_of_the_gradient", "off by|lowest eigenvalue"),
        ("actuation", "Jerky", "motion_is_rigid_and_smooth", "abruptly"),
        ("actuation", "Opening", "closes_towards_the_axis", "a finger opens"),
        ("features", "Constant", "measures_what_it_names", "it declares"),
        ("features", "Constant", "tells_designs_apart", "three different designs"),
        ("stepper", "Heedless", "obeys_damping", "against drag it falls"),
        ("stepper", "Inviscid", "obeys_damping", "of a strain is left"),
        ("stepper", "Modest", "obeys_damping", "takes a material with it"),
        ("contact", "Sinking", "soft_body_rests_on_a_plane", "sinks"),
    ],
)
def test_a_plugin_that_breaks_its_contract_is_caught(make_distribution, kind, plugin, check, said):
    make_distribution("wrong", {kind: {"wrong": f"wrong_plugins:{plugin}"}}, module="wrong_plugins", source=WRONG)
    (function,) = [one for one in checks.checks_of(kind) if one.__name__ == f"check_{check}"]
    with pytest.raises((AssertionError, ValueError), match=said):
        function(kind, "wrong")

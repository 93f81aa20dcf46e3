"""The judge of the hard cases refuses mechanics that are wrong on purpose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from finqd.plugins.stepper_implicit_euler import ImplicitEuler
from finqd.scene import Scene

from .scenes import block
from .sound import sound


@dataclass(frozen=True, kw_only=True)
class Hasty(ImplicitEuler):
    """Every step ends one per cent faster than it should."""

    def step(self, system, state, dt):
        end, report = super().step(system, state, dt)
        return replace(end, velocities=1.01 * end.velocities), report


@dataclass(frozen=True, kw_only=True)
class Torn(ImplicitEuler):
    """The last vertex is pushed through the body once."""

    def step(self, system, state, dt):
        end, report = super().step(system, state, dt)
        places = end.positions.copy()
        places[-1] -= 0.015
        return replace(end, positions=places), report


def falling() -> Scene:
    scene = Scene()
    scene.add_plane()
    block(scene, height=0.01)
    return scene


def test_a_sound_fall_is_taken():
    sound(falling(), duration=0.02, time_step_ms=2)


def test_energy_out_of_nothing_is_refused():
    with pytest.raises(AssertionError, match="out of nothing"):
        sound(falling(), duration=0.02, time_step_ms=2, stepper=Hasty())


def test_an_inverted_element_is_refused():
    with pytest.raises(AssertionError, match="inverted"):
        sound(falling(), duration=0.002, time_step_ms=2, stepper=Torn())


def test_a_soft_contact_is_refused():
    with pytest.raises(AssertionError, match="sinks"):
        sound(falling(), duration=0.2, time_step_ms=2, contact={"name": "penalty", "stiffness_N_mm3": 1e-4})

"""The rungs of an accuracy ladder: one knob at a time around the preset ``standard``, and the presets themselves.

A rung is a set of values by JSON path over a preset: what ``--preset`` and ``--set`` say on the command line, so every
rung can be pasted there. A rung whose plugin, option or library is not installed is kept apart, with the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from finqd import registry
from finqd.errors import InputError
from finqd.presets import DEFAULT, PRESETS, apply_preset

if TYPE_CHECKING:
    from finqd.design import Design

#: knob -> what it turns
KNOBS = {
    "size": "mesh size of the default element", "element": "element families, each over its mesh sizes",
    "step": "time step", "stepper": "time integration", "adaptive": "time step from an error estimate",
    "newton": "tolerances of Newton's method", "linear": "linear solver", "contact": "contact model",
    "elasticity": "constitutive law", "preset": "the named presets",
}
#: knobs that trade error against seconds, by which a question is answered; the others hardly do
TRADES = ("preset", "size", "element", "step", "adaptive")
#: sections of a design that say how it is computed rather than what it is; the elasticity says both
NUMERICS = ("mesher", "stepper", "contact")
AS_GIVEN = "as given"
STEP = "protocol.time_step_ms"
#: of the protocol, that decide how exact a result is and not what is simulated
NUMERICAL_CONSTANTS = ("time_step_ms", "calm_step_factor", "early_verdict", "wall_clock_limit_s")

_TET4: dict[str, Any] = {"mesher": "tetrahedral", "mesher.order": 1}
_TET10: dict[str, Any] = {"mesher": "tetrahedral", "mesher.order": 2}
#: in full: what a rung leaves open, the preset fills with its own options
_HEX8: dict[str, Any] = {
    "mesher": "swept", "mesher.order": 1, "mesher.layers": None, "mesher.notch_nodes": "middle", "mesher.grading": 1.0,
}
_HEX20: dict[str, Any] = {**_HEX8, "mesher.order": 2}
_QUARTER: dict[str, Any] = {**_HEX20, "mesher.layers": 2, "mesher.notch_nodes": "quarter"}


@dataclass(frozen=True, kw_only=True)
class Rung:
    """One setting to be measured.

    name: unique in a ladder; knob: a key of `KNOBS`; series: the curve it lies on
    settings: JSON path -> value, over ``preset``
    bare: what the design itself says of its numerics is left out first, so that preset and settings say it all
    """

    name: str
    knob: str
    series: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    preset: str = DEFAULT
    bare: bool = False

    def applied(self, design: Design) -> Design:
        """Return the design that this rung computes. Raises ``InputError`` if something of it is not installed."""
        start = without_numerics(design) if self.bare else design
        return apply_preset(start, self.preset, overrides=self.settings, source=f"rung {self.name}:")


@dataclass(frozen=True, kw_only=True)
class Ladder:
    """Rungs that can be run, name -> what each computes, and name -> reason of those that cannot be run."""

    rungs: tuple[Rung, ...]
    designs: Mapping[str, Design]
    missing: Mapping[str, str]


def without_numerics(design: Design) -> Design:
    """Return the design without what it says of mesher, stepper, contact and time step."""
    from finqd.design import Design

    document = {key: value for key, value in design.to_dict().items() if key not in NUMERICS}
    protocol = {k: v for k, v in document.pop("protocol", {}).items() if k not in NUMERICAL_CONSTANTS}
    return Design({**document, **({"protocol": protocol} if protocol else {})}, design.source)


def build_ladder(design: Design, *, knobs: Iterable[str] = (), frictionless: bool = False) -> Ladder:
    """Return every rung of the chosen knobs (default: all) that is installed; ``standard`` is always among them.

    A design that sets numerics of its own has a rung for itself as well.

    frictionless: without the rungs that change friction only

    Raises ``InputError`` for an unknown knob.
    """
    chosen = set(knobs) or set(KNOBS)
    for knob in sorted(chosen - set(KNOBS)):
        raise InputError(f"there is no knob {knob!r}; known: {', '.join(KNOBS)}", "--knob")
    base = Rung(name=DEFAULT, knob="preset", series="preset", bare=True)
    rungs, designs = [base], {base.name: base.applied(design)}
    own = Rung(name=AS_GIVEN, knob="preset", series="preset")
    designs[own.name] = own.applied(design)
    if designs[own.name].digest() == designs[base.name].digest():
        del designs[own.name]
    else:
        rungs.append(own)
    missing: dict[str, str] = {}
    for rung in _all_rungs():
        if rung.knob not in chosen or rung.name == base.name or (frictionless and "friction" in rung.name):
            continue
        try:
            designs[rung.name] = rung.applied(design)
            _require_backend(rung)
        except InputError as error:
            missing[rung.name] = error.message
        else:
            rungs.append(rung)
    return Ladder(rungs=tuple(rungs), designs=designs, missing=missing)


def reference_rungs(case: str, *, full: bool, swept: bool = True) -> tuple[Rung, ...]:
    """Return the reference and what it is checked by: fine rungs of two element families.

    Unknowns are spent on the mesh, which is graded towards the notches between ribs and walls: their stress is
    singular, and on even meshes it converges at first order only. Quadratic bricks hold it by their nodes; linear ones
    come near by extrapolation, from two meshes. A press ends at rest: its force at 40 and at 10 ms differs by 2e-7.
    What a grasp ends with depends on the step a little (its force by 0.6 % between 20 and 10 ms): 5 ms, or 2.5.

    swept: False for shapes that cannot be; then all there is are two meshes of quadratic tetrahedra
    """
    if not swept:
        size, step = (2.0 if full else 3.0), 20.0 if case == "press" else 5.0
        meshes = [(f"tet10 {one:g} mm", {**_TET10, "mesher.size_mm": one}) for one in (size, 2.0 * size)]
    else:
        if case == "press":
            step, quadratic, linear = 20.0, (2.0, 3, 2, 2.0), (2.0, 4, 4, 2.0)
            if full:
                quadratic, linear = (1.0, 4, 4, 2.0), (1.0, 8, 8, 2.0)
        else:
            step, quadratic, linear = 5.0, (1.5, 3, 1, 1.5), (2.0, 4, 4, 2.0)
            if full:
                step, quadratic, linear = 2.5, (1.5, 4, 2, 2.0), (1.5, 6, 6, 2.0)
        size, layers, least, grading = linear
        meshes = [_graded("hex20", 2, *quadratic), _graded("hex8", 1, *linear),
                  _graded("hex8", 1, 2.0 * size, layers, least // 2, grading)]
    return tuple(
        _rung("reference", "reference", f"{name}, {step:g} ms", {**settings, STEP: step}, bare=True)
        for name, settings in meshes
    )


def _graded(
    element: str, order: int, size: float, layers: int, least: int, grading: float
) -> tuple[str, dict[str, Any]]:
    """Return name and settings of a mesh that is graded towards the notches."""
    settings = {
        "mesher": "swept", "mesher.order": order, "mesher.size_mm": size, "mesher.layers": layers,
        "mesher.least_edges": least, "mesher.grading": grading,
        "mesher.notch_nodes": "quarter" if order == 2 else "middle",
    }
    return f"{element} {size:g} mm graded, {least} through a wall", settings


def as_options(rung: Rung) -> str:
    """Return the rung as one pastes it behind ``finqd evaluate DESIGN``.

    >>> as_options(Rung(name="x", knob="size", series="size", settings={"mesher.size_mm": 2.0}))
    '--preset standard --set mesher.size_mm=2'
    """
    return options_text(rung.preset, rung.settings)


def options_text(preset: str, settings: Mapping[str, Any]) -> str:
    """Return a preset and values by path as command line options."""
    return " ".join([f"--preset {preset}", *(f"--set {path}={_plain(value)}" for path, value in settings.items())])


def _rung(knob: str, series: str, name: str, settings: Mapping[str, Any], *, bare: bool = False) -> Rung:
    return Rung(name=name, knob=knob, series=series, settings=settings, bare=bare)


def _all_rungs() -> list[Rung]:
    presets = [Rung(name=name, knob="preset", series="preset", preset=name, bare=True) for name in PRESETS]
    return [
        *presets, *_sizes(), *_steps(), *_steppers(), *_newton(), *_linear(), *_contacts(),
        *_others("elasticity", "elasticity", known=("corotated",)),
    ]


def _sizes() -> list[Rung]:
    graded = {**_QUARTER, "mesher.grading": 1.5}
    families: tuple[tuple[str, str, dict[str, Any], Sequence[float]], ...] = (
        ("size", "hex20, quarter nodes, graded", graded, (6, 4, 3, 2.5, 2, 1.5)),
        ("element", "hex20, quarter nodes", _QUARTER, (6, 4, 3, 2.5, 2, 1.5)),
        ("element", "hex20", _HEX20, (8, 6, 4, 3, 2)), ("element", "hex8", _HEX8, (8, 6, 4, 3, 2, 1.5, 1)),
        ("element", "tet10", _TET10, (8, 6, 4, 3, 2, 1.5)), ("element", "tet4", _TET4, (6, 4, 3, 2, 1.5, 1)),
        ("element", "hex8, two through a wall", {**_HEX8, "mesher.least_edges": 2}, (6, 4, 3, 2)),
    )
    rungs = [
        _rung(knob, f"size of {family}", f"{family} {size:g} mm", {**settings, "mesher.size_mm": size})
        for knob, family, settings, sizes in families for size in sizes
    ]
    layers = [
        _rung("element", f"layers of {size:g} mm", f"hex20, quarter nodes, graded {size:g} mm, {n} layers",
              {**graded, "mesher.size_mm": size, "mesher.layers": n})
        for size in (2.5, 4.0) for n in (1, 2, 3, 4) if (size, n) not in ((2.5, 2), (4.0, 2))
    ]
    known = {"swept", "tetrahedral"}
    return rungs + layers + [
        _rung("element", f"mesher {name}", f"mesher {name}", {"mesher": name})
        for name in registry.names("mesher") if name not in known
    ]


def _steps() -> list[Rung]:
    return [_rung("step", "time step", f"step {dt:g} ms", {STEP: dt}) for dt in (40, 20, 10, 5, 2.5, 1.25)] + [
        _rung("adaptive", "adaptive step", f"adaptive {tolerance:g} mm",
              {"stepper.error_tolerance_mm": tolerance, STEP: 50})
        for tolerance in (1, 0.3, 0.1, 0.03, 0.01)
    ]


def _steppers() -> list[Rung]:
    steps: dict[str, tuple[float, ...]] = {
        "bdf2": (40, 20, 10, 5, 2.5), "quasi_static": (50, 20, 10, 5), "imex": (10, 5, 2, 1, 0.5), "explicit": (10,),
    }
    known = [
        _rung("stepper", f"step of {name}", f"{name} {dt:g} ms", {"stepper": name, STEP: dt})
        for name, values in steps.items() for dt in values
    ]
    return known + _others("stepper", "stepper", known=(*steps, "implicit_euler"))


def _newton() -> list[Rung]:
    return [
        _rung("newton", "Newton tolerance", f"tolerance {force:g} N",
              {"stepper.tolerance_N": force, "stepper.tolerance_share": 0.0})
        for force in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
    ] + [
        _rung("newton", "friction tolerance", f"friction tolerance {share:g}", {"stepper.friction_tolerance": share})
        for share in (0.1, 0.02, 0.005)
    ] + [_rung("newton", "quasi-Newton steps", "a new matrix each iteration", {"stepper.quasi_newton": False})]


def _linear() -> list[Rung]:
    rungs = [
        _rung("linear", "linear solver", f"cg behind a factorisation, {backend}", {"stepper.backend": backend})
        for backend in ("pardiso", "qdldl", "cholmod", "superlu")
    ]
    rungs.append(_rung("linear", "linear solver", "direct", {"stepper.linear_solver": "direct"}))
    for kind in ("block_jacobi", "jacobi"):
        values = {"stepper.preconditioner": kind, "stepper.linear_iterations": 20000}
        rungs.append(_rung("linear", "linear solver", f"cg, {kind}", values))
    return rungs + [
        _rung("linear", "linear tolerance", f"linear tolerance {tolerance:g}", {"stepper.linear_tolerance": tolerance})
        for tolerance in (1e-1, 1e-2, 1e-3, 1e-6)
    ]


def _contacts() -> list[Rung]:
    options = {
        "stiffness_N_mm3": (10, 30, 100, 300, 1000, 3000), "sample_spacing_mm": (1.2, 0.6, 0.3, 0.15),
        "edge_radius_mm": (0.125, 0.25, 0.5, 1),
        "smoothing_mm": (0.1, 0.03, 0.01, 0.003), "friction_stiffness_ratio": (0.1, 0.5, 2),
    }
    return [
        _rung("contact", f"contact {key}", f"contact {key} {value:g}", {f"contact.{key}": value})
        for key, values in options.items() for value in values
    ] + _others("contact", "contact", known=("penalty",))


def _others(kind: str, knob: str, *, known: Sequence[str]) -> list[Rung]:
    """Return a rung for each registered plugin of a kind that the ladder does not name itself."""
    return [_rung(knob, knob, f"{kind} {name}", {kind: name}) for name in registry.names(kind) if name not in known]


def _require_backend(rung: Rung) -> None:
    from finqd.mechanics.linear_backends import available_backends

    backend = rung.settings.get("stepper.backend")
    if backend is not None and backend not in available_backends():
        raise InputError(f"the library {backend} is not installed", rung.name)


def _plain(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)

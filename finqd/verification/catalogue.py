"""All verification cases by name, at full size or as fast twins on coarser meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product

import numpy as np

from finqd import registry
from finqd.errors import InputError
from finqd.units import MM, MS
from finqd.verification import contact, dynamics, elastic, friction, grasps, press, statics
from finqd.verification.cases import Case, observed_order

Compute = Callable[[], float | tuple[float, str]]


def cases(names: Sequence[str] = (), *, fast: bool = False, with_grasps: bool = False) -> list[Case]:
    """Return the cases of these names (default: all; grasps only ``with_grasps`` or by name), in a fixed order.

    Raises InputError, listing the known names.
    """
    unknown = [name for name in names if name not in CATALOGUE]
    if unknown:
        raise InputError(f"there is no case {unknown[0]!r}; known: {', '.join(CATALOGUE)}", "verify")
    wanted = names or [name for name in CATALOGUE if with_grasps or name not in SLOW]
    return [case for name in CATALOGUE if name in wanted for case in CATALOGUE[name](fast)]


def _case(name: str, quantity: str, reference: float, source: str, band: float, compute: Compute, *, unit: str = "-",
          absolute: bool = False) -> Case:
    return Case(name=name, quantity=quantity, unit=unit, reference=reference, source=source, band=band,
                absolute=absolute, compute=compute)


_zero = partial(_case, reference=0.0, absolute=True)


def _turning() -> list[str]:
    """Return the elasticities that are good for large rotations."""
    return [name for name in registry.names("elasticity") if not elastic.small_rotation(name)]


# -- elements ----------------------------------------------------------------------------------------------------------


def _patch(fast: bool) -> Iterator[Case]:
    for name, element in product(registry.names("elasticity"), elastic.ELEMENTS):
        if elastic.supported(name, element):
            yield _zero("patch", f"{name}, {element}: displacement off", source="linear field is exact", band=1e-10,
                        compute=partial(elastic.patch_error, element, name))


def _rotation(fast: bool) -> Iterator[Case]:
    for name, element in product(_turning(), elastic.ELEMENTS):
        if elastic.supported(name, element):
            yield _zero("rotation", f"{name}, {element}: energy / (E V)", source="rigid motion costs nothing",
                        band=1e-12, compute=partial(elastic.rotation_energy, element, name))


#: element -> bricks a side
COOK_MESHES = {"hex8": 64, "hex20": 48, "tet10": 64, "wedge6": 48, "tet4": 48}
COOK_FAST = {"hex8": 16, "hex20": 8, "tet10": 8, "wedge6": 16, "tet4": 16}
LOCKED = (0.5 * (8.7 + 11.8) * MM, 0.5 * (11.8 - 8.7) * MM)


def _cook(fast: bool) -> Iterator[Case]:
    for (element, n), nu in product((COOK_FAST if fast else COOK_MESHES).items(), (1 / 3, 0.4999)):
        if element not in ("wedge6", "tet4"):
            value, band, source = (32.0 if nu < 0.4 else 28.0) * MM, 0.1 if fast else 0.015, "published"
        elif nu < 0.4:
            value, band, source = 32.0 * MM, 0.15 if fast else 0.04, "published; linear simplices converge slowly"
        elif fast:
            value, band, source = 7.6 * MM, 0.03, "this mesh: volumetric locking, far from 28"
        else:
            value, band, source = LOCKED[0], LOCKED[1] / LOCKED[0], "published range 8.7 to 11.8: locks"
        yield _case("cook", f"{element}, {n} x {n}, nu {nu:.4g}: u_y", value, source, band, unit="m",
                    compute=partial(_cook_series, element, n, nu))


def _cook_series(element: str, n: int, nu: float) -> tuple[float, str]:
    sizes = (n // 4, n // 2, n)
    found = [elastic.cook(element, size, nu) for size in sizes]
    steps = np.abs(np.diff(found))
    listed = ", ".join(f"{value / MM:.2f}" for value in found)
    return found[-1], f"{listed} mm for n = {', '.join(map(str, sizes))}; order {np.log2(steps[0] / steps[1]):.2f}"


def _mesh_order(fast: bool) -> Iterator[Case]:
    for name, element in product(["corotated"] if fast else registry.names("elasticity"), elastic.ELEMENTS):
        if elastic.supported(name, element):
            order = 3.0 if element in elastic.QUADRATIC else 2.0
            sizes = (3, 6) if element in elastic.QUADRATIC else (4, 8) if fast else (6, 12)
            yield _case("mesh-order", f"{name}, {element}: order of the L2 error", order, "degree + 1", 0.15,
                        absolute=True, compute=partial(_mesh_rate, element, sizes, name))


def _mesh_rate(element: str, sizes: tuple[int, int], elasticity: str) -> tuple[float, str]:
    errors = [elastic.field_error(element, n, elasticity) for n in sizes]
    return observed_order(errors), f"errors {errors[0]:.2g}, {errors[1]:.2g} for n = {sizes[0]}, {sizes[1]}"


# -- at rest -----------------------------------------------------------------------------------------------------------


def _elastica(fast: bool) -> Iterator[Case]:
    elements = {"hex8": (50, 1, 1)} if fast else {"hex8": (50, 1, 1), "hex20": (25, 1, 1), "tet10": (50, 1, 1)}
    for (element, divisions), load in product(elements.items(), (4.0,) if fast else statics.ELASTICA):
        for i, what in enumerate(("deflection", "shortening")):
            yield _case("elastica", f"{element}, P L^2/EI = {load:g}: {what} / L", statics.ELASTICA[load][i],
                        "elastica", 0.01, partial(_elastica_part, load, divisions, element, "corotated", i))
    for name in [] if fast else registry.names("elasticity"):
        if name == "corotated":
            continue
        straight = elastic.small_rotation(name)
        reference = 4.0 / 3.0 if straight else statics.ELASTICA[4.0][0]
        source = "P L^3/3EI: linear, twice the elastica's" if straight else "elastica"
        yield _case("elastica", f"{name}, hex8, P L^2/EI = 4: deflection / L", reference, source, 0.01,
                    partial(_elastica_part, 4.0, (50, 1, 1), "hex8", name, 0))


def _elastica_part(load: float, divisions: tuple[int, int, int], element: str, elasticity: str, i: int) -> float:
    return statics.elastica(load, divisions, element, elasticity)[i]


def _roll_up(fast: bool) -> Iterator[Case]:
    for name in ["corotated"] if fast else _turning():
        divisions, ramp = ((30, 1, 1), 30) if fast else ((60, 1, 1), 60)
        yield _zero("roll-up", f"{name}, hex8: tip from root / L, moment 2 pi EI/L", source="closes to a circle",
                    band=0.01, compute=partial(statics.roll_up, divisions, "hex8", name, ramp=ramp))


def _silicone(fast: bool) -> Iterator[Case]:
    divisions, band = ((20, 6, 6), 0.06) if fast else ((30, 9, 9), 0.03)
    for force, measured, code in ((0.0, 6.71, 6.77), (0.51, 17.24, 17.33)):
        yield _case("silicone", f"hex8 {divisions[0]} long, {force:g} N: sag of the tip's top edge", measured * MM,
                    f"measured (a commercial code: {code})", band, unit="m",
                    compute=partial(statics.silicone_sag, divisions, force))


# -- contact -----------------------------------------------------------------------------------------------------------


def _hertz(fast: bool) -> Iterator[Case]:
    n = 8 if fast else 12
    tatara = f"finite ball {contact.finite_approach() / MM:.4f} mm (Tatara)"
    yield _case("hertz", f"hex8, n {n}: radius of the contact", contact.HERTZ_RADIUS, "Hertz", 0.05, unit="m",
                compute=lambda: contact.hertz(n).radius)
    yield _case("hertz", f"hex8, n {n}: approach", contact.HERTZ_APPROACH, "Hertz", 0.05, unit="m",
                compute=lambda: (contact.hertz(n).approach, tatara))


def _slope(fast: bool) -> Iterator[Case]:
    settings = {"divisions": (2, 2, 1), "time_step": 0.01} if fast else {"divisions": (6, 6, 2), "time_step": 0.005}
    yield _zero("slope", "tan = 0.99 mu: distance in 1 s", source="Coulomb: sticks", band=1e-5, unit="m",
                compute=lambda: friction.block_on_slope(0.99, **settings)[1])
    for share in (1.01, 1.3):
        yield _case("slope", f"tan = {share:g} mu: acceleration", friction.sliding_acceleration(share),
                    "g (sin - mu cos)", 0.01, unit="m/s^2",
                    compute=lambda share=share: friction.block_on_slope(share, **settings)[0])


def _rolling(fast: bool) -> Iterator[Case]:
    for dt in (0.01,) if fast else (0.01, 0.002):
        yield _case("rolling", f"dt {dt / MS:g} ms: acceleration / (5/7 g sin)", 1.0, "closed form", 0.01,
                    partial(friction.rolling_ball, 15.0, time_step=dt))


def _pads(fast: bool) -> Iterator[Case]:
    settings = {} if fast else {"divisions": (5, 8, 8), "time_step": 0.005}
    for share, lag in ((0.98, 0.0), (1.02, 3 * MM)):
        yield _case("pads", f"weight {share:g} x 2 mu N: lag behind a 3 mm lift", lag, "Coulomb", 0.1 * MM, unit="m",
                    absolute=True, compute=lambda share=share: friction.squeezed_lag(share, **settings)[1])


# -- motion ------------------------------------------------------------------------------------------------------------


def _free(fast: bool) -> Iterator[Case]:
    yield _zero("free-fall", "off g t (t + dt)/2", source="exact for implicit Euler", band=1e-11, unit="m",
                compute=partial(dynamics.free_fall, 0.01))


def _spinning(fast: bool) -> Iterator[Case]:
    for dt in (0.002,) if fast else (0.002, 0.001):
        bar = partial(dynamics.spinning_bar, dt)
        yield _zero("spinning-bar", f"dt {dt / MS:g} ms: linear momentum, change", source="conserved", band=1e-8,
                    compute=lambda bar=bar: bar().linear_drift)
        yield _zero("spinning-bar", f"dt {dt / MS:g} ms: angular momentum, loss", source="first order in dt",
                    band=20 * dt, compute=lambda bar=bar: bar().angular_loss)
        yield _zero("spinning-bar", f"dt {dt / MS:g} ms: energy, largest gain", source="never gains", band=0.0,
                    unit="J", compute=lambda bar=bar: bar().energy_gain)


def _brick(fast: bool) -> Iterator[Case]:
    yield _zero("tumbling-brick", "angular momentum, change", source="conserved", band=1e-12,
                compute=partial(dynamics.brick_drift, 0.01))


def _landing(fast: bool) -> Iterator[Case]:
    dt, divisions = (0.004, (3, 3, 3)) if fast else (0.002, (6, 6, 6))
    yield _zero("landing", "soft cube: energy, largest gain in a step", source="never gains", band=1e-8, unit="J",
                compute=lambda: max(float(np.diff(dynamics.landing(dt, divisions)[0]).max()), 0.0))
    yield _case("landing", "soft cube: force of the floor at rest", 0.027 * dynamics.GRAVITY, "weight", 1e-3, unit="N",
                compute=lambda: float(dynamics.landing(dt, divisions)[1].contact_forces[-1, 0]))
    for stepper, step in product(("implicit_euler", "bdf2"), (20 * MS, 5 * MS)):
        yield _zero("landing", f"rigid block, {stepper}, dt {step / MS:g} ms: rebound / drop",
                    source="no restitution", band=0.001, compute=partial(dynamics.rebound, stepper, step))


def _impact(fast: bool) -> Iterator[Case]:
    coarse, fine = (40, 80), (100, 200)
    bands = {"bdf2": 0.05, "implicit_euler": 0.15 if fast else 0.10}
    if not fast:
        bands.update(explicit=0.05, imex=0.05)
    for stepper, band in bands.items():
        size, steps = fine if stepper != "explicit" and not fast else coarse
        for i, (what, limit) in enumerate((("force / rho c v A", 0.02), ("impulse / 2 m v", band))):
            yield _case("impact", f"{stepper}: {what}", 1.0, "waves in a rod (Saint-Venant)", limit,
                        partial(_impact_part, size, steps, stepper, i))


def _impact_part(size: int, steps: int, stepper: str, i: int) -> float:
    return dynamics.rod_impact(size, steps=steps, stepper=stepper)[i]


def _time_order(fast: bool) -> Iterator[Case]:
    steps = (40, 80) if fast else (80, 160)
    for stepper in registry.names("stepper"):
        if stepper in dynamics.ORDERS:
            yield _case("time-order", f"{stepper}: order of the error at 0.3 periods", float(dynamics.ORDERS[stepper]),
                        "theory", 0.15, absolute=True, compute=partial(_time_rate, stepper, steps))


def _time_rate(stepper: str, steps: tuple[int, int]) -> tuple[float, str]:
    errors = [dynamics.mode_error(stepper, n) for n in steps]
    return observed_order(errors), f"errors {errors[0]:.2g}, {errors[1]:.2g}"


def _silicone_release(fast: bool) -> Iterator[Case]:
    coarse = (10, 3, 3)
    yield _case("silicone-release", "bdf2, dt 2 ms, hex8 10 long: first peak over that of its modes", 1.0,
                "modal superposition, small displacements", 0.02, partial(_peak_over_modes, coarse, "bdf2", 2 * MS))
    settings = (coarse, 5 * MS) if fast else ((20, 6, 6), 2.5 * MS)
    for weight, (frequency, ratio) in dynamics.RING_DOWN.items():
        what = f"hex8 {settings[0][0]} long, {weight:g} N: ring-down"
        yield _case("silicone-release", f"{what}, frequency", frequency, "measured", 0.10, unit="Hz",
                    compute=partial(_ring_down, *settings, weight, 0))
        if weight == 0.0:
            yield _case("silicone-release", f"{what}, damping ratio", ratio, "measured; the damping is fitted to it",
                        0.10, partial(_ring_down, *settings, weight, 1))
        elif not fast:
            yield _case("silicone-release", f"{what}, damping ratio", ratio,
                        "measured: as without a weight; a viscous law's falls with the frequency", 0.10,
                        partial(_ring_down, *settings, weight, 1))
    for weight, (peak, late) in {} if fast else dynamics.FIRST_PEAK.items():
        yield _case("silicone-release", f"bdf2, dt 2.5 ms, {weight:g} N: first peak", peak,
                    f"measured, at {late / MS:.0f} ms; but not let go at once, so no vibration of this size", 0.10,
                    unit="m", compute=partial(_first_peak, *settings, weight))


def _ring_down(divisions: tuple[int, int, int], dt: float, weight: float, i: int) -> tuple[float, str]:
    found = dynamics.silicone_ring_down(divisions, weight, time_step=dt)[i]
    return found, f"bdf2, dt {dt / MS:g} ms, damping by the stiffness {dynamics.SILICONE_DAMPING / MS:g} ms"


def _peak_over_modes(divisions: tuple[int, int, int], stepper: str, dt: float) -> tuple[float, str]:
    peak, time = dynamics.silicone_peak(divisions, 0.0, stepper=stepper, time_step=dt)
    exact, then = dynamics.silicone_modal_peak(divisions)
    return peak / exact, f"{peak / MM:.2f} mm at {time / MS:.0f} ms; modes {exact / MM:.2f} mm at {then / MS:.1f} ms"


def _first_peak(divisions: tuple[int, int, int], dt: float, weight: float) -> tuple[float, str]:
    (peak, time), (undamped, _) = (
        dynamics.silicone_peak(divisions, weight, stepper="bdf2", time_step=dt, damping=damping, duration=duration)
        for damping, duration in ((dynamics.SILICONE_DAMPING, dynamics.RING_TIME), (0.0, 0.2))
    )
    return peak, f"at {time / MS:.0f} ms; {undamped / MM:.1f} mm without damping"


# -- fingers -----------------------------------------------------------------------------------------------------------


def _press(fast: bool) -> Iterator[Case]:
    yield from press.cases(fast)


def _hold(fast: bool) -> Iterator[Case]:
    yield _zero("grasp-hold", "sphere held 10 s: creep in the last 8 s", source="true stick", band=0.01 * MM, unit="m",
                compute=grasps.creep)


def _cross_check(fast: bool) -> Iterator[Case]:
    yield _case("grasp-cross-check", "height of the sphere", 84.5 * MM, "84.1 to 84.6 mm by three others", 1 * MM,
                unit="m", absolute=True, compute=grasps.cross_check_height)


SLOW = ("grasp-hold", "grasp-cross-check")
CATALOGUE: dict[str, Callable[[bool], Iterator[Case]]] = {
    "patch": _patch, "rotation": _rotation, "mesh-order": _mesh_order, "cook": _cook, "elastica": _elastica,
    "roll-up": _roll_up, "silicone": _silicone, "silicone-release": _silicone_release, "time-order": _time_order,
    "free-fall": _free, "spinning-bar": _spinning, "tumbling-brick": _brick, "landing": _landing, "impact": _impact,
    "hertz": _hertz, "slope": _slope, "rolling": _rolling, "pads": _pads, "press": _press, "grasp-hold": _hold,
    "grasp-cross-check": _cross_check,
}

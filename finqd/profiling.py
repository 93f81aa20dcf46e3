"""Where the time of a simulation goes: a clock that is put round the methods of one system's objects, when asked for.

    with profiled() as profile:
        simulate(scene, duration=1.0, time_step=0.01, profile=profile)
    total([profile.timings()])

Categories are disjoint: what a method spends in another one's category counts there alone, so that all of them add up
to the whole time. Nothing here is imported, and no method is wrapped, where no profile is wanted. Third parties'
elasticities, contacts and steppers are timed by the methods of their contracts (`finqd.contracts`): a contact's search
then counts where it is called. Damping counts as elasticity, and the Schur complement of rigid bodies as a solve.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from numba.core import event

if TYPE_CHECKING:
    from finqd.mechanics.linear import LinearSolver
    from finqd.mechanics.state import StepReport

#: category -> what counts there
CATEGORIES = {
    "set_up": "scene, distance fields, surfaces, sparsity",
    "mesh": "of the fingers, in a process of its own",
    "compile": "kernels compiled, or loaded from the cache",
    "elastic_gradient": "energy and forces of elements",
    "elastic_hessian": "matrices of elements",
    "contact_search": "what touches, and how near it is",
    "contact_gradient": "energy and forces of contact and friction",
    "contact_hessian": "their matrices, and room for these",
    "contact_step_limit": "how far a step may go without tunnelling",
    "contact_update": "friction renewed, steps begun and accepted",
    "assembly": "sums, held dofs, values for the library",
    "factorisation": "of the library",
    "solves": "substitutions, products and vectors of CG",
    "recording": "frames and checkpoints",
    "early_verdict": "whether a grasp is decided",
    "rest": "Python, inertia, predictors, step control",
}
#: of the time of steps, what is kernels or a library; ``rest`` is what is not
KERNELS = (
    "elastic_gradient", "elastic_hessian", "contact_search", "contact_gradient", "contact_hessian",
    "contact_step_limit", "contact_update", "assembly", "factorisation", "solves",
)
#: what is timed as a whole: whatever it calls counts as its own, but for compiling
WHOLE = ("set_up", "recording", "early_verdict")
#: what is in `KERNELS` as well and could be spared: rejected steps, and trials of line searches after the first one
AVOIDABLE = ("rejected_steps", "line_search_trials")
#: what is in `KERNELS` as well, whatever its category: contact of soft bodies with each other and themselves
SOFT = "soft_contact"
SOFT_METHODS = (
    "find", "energy", "add_gradient", "add_hessian", "couplings", "bind", "step_limit", "lag", "bounds", "mapped_slips",
)
UNAVOIDABLE = (
    "what iterations of accepted steps spend in kernels and libraries, with one trial each; avoidable are rejected "
    "steps, further trials of line searches, counted at the mean cost of a gradient, and rest"
)

SYSTEM = dict.fromkeys(
    ("energy", "add_gradient", "add_hessian", "find_couplings", "_couple", "hold_fixed", "hold_rigid", "clear_held"),
    "assembly",
)
DERIVATIVES = dict.fromkeys(("clear_gradient", "clear_hessian"), "assembly")
ELASTICITY = {
    "energy": "elastic_gradient", "add_gradient": "elastic_gradient", "add_hessian": "elastic_hessian",
    "add_viscosity": "elastic_hessian",
}
CONTACT = {
    "energy": "contact_gradient", "add_gradient": "contact_gradient", "add_hessian": "contact_hessian",
    "couplings": "contact_hessian", "step_limit": "contact_step_limit", "begin_step": "contact_update",
    "relag": "contact_update", "commit": "contact_update", "bind": "assembly",
}
#: how finqd's own contacts look for what touches
SEARCH = ("_fill", "_situation", "soft.find")


class Clock:
    """Seconds and calls by category; time counts for the category that was entered last and not left yet."""

    def __init__(self) -> None:
        self.seconds, self.calls = dict.fromkeys(CATEGORIES, 0.0), dict.fromkeys(CATEGORIES, 0)
        self._open, self._since = ["set_up"], time.perf_counter()
        self.calls["set_up"] = 1

    def tick(self) -> None:
        """Count the time until now."""
        now = time.perf_counter()
        self.seconds[self._open[-1]] += now - self._since
        self._since = now

    def enter(self, category: str) -> None:
        """Let time count for ``category`` until `leave`."""
        self.tick()
        outer = self._open[-1]
        if outer in WHOLE and category != "compile":
            category = outer
        self.calls[category] += category != outer
        self._open.append(category)

    def leave(self) -> None:
        """Let time count as it did before the last `enter`."""
        self.tick()
        self._open.pop()

    def begin_steps(self) -> None:
        """End the set-up: what is in no other category is ``rest`` from now on."""
        self.tick()
        self._open[0] = "rest"

    def timed(self, function: Callable[..., Any], category: str) -> Callable[..., Any]:
        """Return ``function``, whose time counts for ``category``."""

        def inside(*args: Any, **kwargs: Any) -> Any:
            self.enter(category)
            try:
                return function(*args, **kwargs)
            finally:
                self.leave()

        return inside

    def kernels(self) -> float:
        """Return the seconds in `KERNELS` so far."""
        self.tick()
        return sum(self.seconds[category] for category in KERNELS)


class Timed:
    """An object some of whose methods are timed; all else is its own. Nothing is written to it, who may forbid it."""

    def __init__(self, target: Any, clock: Clock, methods: Mapping[str, str]) -> None:
        self._target = target
        for name, category in methods.items():
            if hasattr(target, name):
                setattr(self, name, clock.timed(getattr(target, name), category))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._target, name)


class _TimedDamping(Timed):
    """The damping of a scene; what it does over a step is timed too."""

    def __init__(self, target: Any, clock: Clock) -> None:
        super().__init__(target, clock, ELASTICITY)
        self._clock = clock

    def over(self, *args: Any) -> Timed:
        return Timed(self._target.over(*args), self._clock, ELASTICITY)


class _TimedSolver(Timed):
    """A linear solver with its factorisation, which it may exchange, and its lagged inverse, one object an inverse."""

    def __init__(self, target: LinearSolver, profile: Profile) -> None:
        super().__init__(target, profile.clock, {"solve": "solves"})
        self._profile, self._inverse = profile, Timed(None, profile.clock, {})
        self._take_factorisation()
        for name in ("_renewed_cg", "_direct"):
            profile.replace(target, name, self._prepared(getattr(target, name)))

    def _prepared(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def inside(*args: Any) -> Any:
            self._take_factorisation()
            return function(*args)

        return inside

    def _take_factorisation(self) -> None:
        found, profile = self._target._factorisation, self._profile
        if found is None or isinstance(found, Timed):
            return
        profile.replace(found._rows, "fill", profile.clock.timed(found._rows.fill, "assembly"))
        methods = {"factorise": "factorisation", "solve": "solves"}
        self._target._factorisation = Timed(found, profile.clock, methods)

    def release(self) -> None:
        """Give the solver back the factorisation that it has now."""
        if isinstance(self._target._factorisation, Timed):
            self._target._factorisation = self._target._factorisation._target

    @property
    def lagged(self) -> Any:
        inverse = self._target.lagged
        if inverse is None:
            return None
        if inverse is not self._inverse._target:  # who compares inverses must find the same one again
            self._inverse = Timed(inverse, self._profile.clock, {"apply": "solves"})
        return self._inverse


class Profile:
    """The clock of one simulation, and what of its kernels' time could have been spared: seconds and counts."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.avoidable = {name: [0.0, 0] for name in AVOIDABLE}
        self._soft, self._within = [0.0, 0], False
        self._gradient_seconds, self._gradients, self._before = 0.0, 0, 0.0
        self._replaced: list[tuple[Any, str, Any]] = []
        self._solvers: dict[int, _TimedSolver] = {}

    def replace(self, owner: Any, name: str, value: Any) -> None:
        """Set an attribute of ``owner`` until `release`."""
        self._replaced.append((owner, name, vars(owner).get(name, self)))
        setattr(owner, name, value)

    def release(self) -> None:
        """Let everything be as it was."""
        self.clock.tick()
        while self._replaced:
            owner, name, before = self._replaced.pop()
            if before is self:
                delattr(owner, name)
            else:
                setattr(owner, name, before)
        for solver in self._solvers.values():
            solver.release()
        self._solvers.clear()

    def watch(self, run: Any, keeper: Any = None) -> None:
        """Time the steps of a simulation that is set up: its system's objects, its frames, its early verdict."""
        system, clock = run.system, self.clock
        owned = ((system, SYSTEM), (system.derivatives, DERIVATIVES), (run.recorder, {"frame": "recording"}))
        for owner, methods in (*owned, *(() if keeper is None else ((keeper, {"save": "recording"}),))):
            for name, category in methods.items():
                self.replace(owner, name, clock.timed(getattr(owner, name), category))
        self._watch_search(system.contact)
        self._watch_soft(getattr(system.contact, "soft", None))
        self.replace(system, "contact", Timed(system.contact, clock, CONTACT))
        self.replace(system, "potentials", [Timed(one, clock, ELASTICITY) for one in system.potentials])
        if system.damping is not None:
            self.replace(system, "damping", _TimedDamping(system.damping, clock))
        if run.decided is not None:
            self.replace(run, "decided", clock.timed(run.decided, "early_verdict"))
        self.replace(system, "solver", self._solver_of(system.solver))
        self.replace(system, "add_gradient", self._counted(system.add_gradient))
        self.replace(run.recorder, "count", self._attempted(run.recorder.count))
        clock.begin_steps()

    def _watch_search(self, contact: Any) -> None:
        for path in SEARCH:
            first, _, second = path.partition(".")
            owner, name = (getattr(contact, first, None), second) if second else (contact, first)
            if hasattr(owner, name) and hasattr(owner, "__dict__"):
                self.replace(owner, name, self.clock.timed(getattr(owner, name), "contact_search"))

    def _watch_soft(self, soft: Any) -> None:
        for name in SOFT_METHODS:
            if hasattr(soft, name) and hasattr(soft, "__dict__"):
                self.replace(soft, name, self._inside_soft(getattr(soft, name)))

    def _inside_soft(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def inside(*args: Any, **kwargs: Any) -> Any:
            if self._within:
                return function(*args, **kwargs)
            self._within, begun = True, self._uncompiled()
            try:
                return function(*args, **kwargs)
            finally:
                self._within = False
                self._soft = [self._soft[0] + self._uncompiled() - begun, self._soft[1] + 1]

        return inside

    def _uncompiled(self) -> float:
        """Return the time [s], without what went into compiling so far: that is a category of its own."""
        self.clock.tick()
        return time.perf_counter() - self.clock.seconds["compile"]

    def _solver_of(self, solver: Callable[..., LinearSolver]) -> Callable[..., Any]:
        def inside(settings: tuple, make: Callable[[], LinearSolver]) -> Any:
            found = solver(settings, self.clock.timed(make, "assembly"))
            return self.timed_solver(found)

        return inside

    def timed_solver(self, solver: LinearSolver) -> _TimedSolver:
        """Return ``solver``, timed; each is wrapped once."""
        if id(solver) not in self._solvers:
            self._solvers[id(solver)] = _TimedSolver(solver, self)  # which keeps it, so that its id stays its own
        return self._solvers[id(solver)]

    def _counted(self, add_gradient: Callable[..., float]) -> Callable[..., float]:
        def inside(state: Any) -> float:
            before = self.clock.kernels()
            energy = add_gradient(state)
            self._gradient_seconds += self.clock.kernels() - before
            self._gradients += 1
            return energy

        return inside

    def _attempted(self, count: Callable[[StepReport], None]) -> Callable[[StepReport], None]:
        def inside(report: StepReport) -> None:
            now = self.clock.kernels()
            if report.converged:
                self.avoidable["line_search_trials"][1] += report.line_searches
            else:
                self.avoidable["rejected_steps"][0] += now - self._before
                self.avoidable["rejected_steps"][1] += 1
            self._before = now
            count(report)

        return inside

    def timings(self) -> dict[str, float]:
        """Return seconds and calls by category as a trajectory's timings hold them."""
        clock, trials = self.clock, self.avoidable["line_search_trials"]
        clock.tick()
        trials[0] = trials[1] * self._gradient_seconds / max(self._gradients, 1)
        rows = {name: (clock.seconds[name], clock.calls[name]) for name in CATEGORIES}
        rows |= {name: tuple(row) for name, row in {**self.avoidable, SOFT: self._soft}.items()}
        return {f"profile/{name}/{what}": value for name, row in rows.items()
                for what, value in zip(("seconds", "calls"), row, strict=True)}


class _CompileListener(event.Listener):
    """Lets time count as compiling while Numba does so in the thread that made this."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._thread = clock, threading.get_ident()

    def on_start(self, event: Any) -> None:
        if threading.get_ident() == self._thread:
            self._clock.enter("compile")

    def on_end(self, event: Any) -> None:
        if threading.get_ident() == self._thread:
            self._clock.leave()


@contextmanager
def profiled() -> Iterator[Profile]:
    """Yield a profile whose clock runs; in the end everything that it watched is as it was."""
    profile = Profile()
    try:
        with event.install_listener("numba:compiler_lock", _CompileListener(profile.clock)):
            yield profile
    finally:
        profile.release()


def effect_seconds(timings: Mapping[str, float]) -> dict[tuple[str, ...], float]:
    """Return what effects cost in a simulation that left these ``timings`` [s], kernels and the Python round them.

    Effects that the same kernels look after have one figure together. Empty if no profile was asked for.
    """
    if "profile/rest/seconds" not in timings:
        return {}

    def seconds(start: str) -> float:
        return sum(timings[f"profile/{name}/seconds"] for name in CATEGORIES if name.startswith(start))

    soft = timings[f"profile/{SOFT}/seconds"]
    return {
        ("object_contact", "friction", "floor"): max(seconds("contact_") - soft, 0.0),
        ("self_contact", "finger_to_finger_contact"): soft,
        ("large_rotation", "material_nonlinearity"): seconds("elastic_"),
    }


def total(timings: Iterable[Mapping[str, float]], *, set_up: float = 0.0, mesh: float = 0.0) -> dict[str, Any]:
    """Return as JSON holds it where the time went in simulations that have left these ``timings``.

    set_up, mesh: seconds that were spent before all of them
    """
    all_of_them = [one for one in timings if "profile/rest/seconds" in one]

    def sums(name: str) -> tuple[float, int]:
        seconds, calls = (sum(one[f"profile/{name}/{what}"] for one in all_of_them) for what in ("seconds", "calls"))
        before = {"set_up": set_up, "mesh": mesh}.get(name, 0.0)
        return seconds + before, int(calls) + (before > 0.0)

    rows = {name: sums(name) for name in CATEGORIES}
    whole = sum(seconds for seconds, _ in rows.values())
    categories = {
        name: {"seconds": seconds, "share": _ratio(seconds, whole), "calls": calls,
               "ms_per_call": _ratio(1e3 * seconds, calls), "what": CATEGORIES[name]}
        for name, (seconds, calls) in rows.items()
    }
    kernels = sum(rows[name][0] for name in KERNELS)
    stepping = kernels + rows["rest"][0]
    spared = {name: dict(zip(("seconds", "calls"), sums(name), strict=True)) for name in AVOIDABLE}
    needed = kernels - sum(row["seconds"] for row in spared.values())
    return {
        "simulations": len(all_of_them), "seconds": whole, "categories": categories,
        "steps": {
            "seconds": stepping, "kernels_share": _ratio(kernels, stepping), "kernels": list(KERNELS),
            "unavoidable_share": _ratio(needed, stepping), "unavoidable": UNAVOIDABLE, "avoidable": spared,
        },
    }


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None

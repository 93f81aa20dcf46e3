"""Conformance of actuation, fitness and features: how fingers are driven and how grasps and designs are rated."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from finqd import registry

if TYPE_CHECKING:
    from finqd.design import Design
    from finqd.trajectory import Trajectory

FINGERS = 3
SPACING = 0.04  # of the finger bases from the axis, while actuation is checked [m]
HEIGHT = 0.12  # of the finger bases [m]
TIP = np.array([0.0, 0.1, 0.0, 1.0])  # a point of the contact side, in the finger frame [m]


# -- actuation ---------------------------------------------------------------------------------------------------------


def check_drives_each_finger_once(kind: str, name: str) -> None:
    """One motion a finger, whatever their number, and each starts where the finger stands."""
    for count in (1, 2, FINGERS, 5):
        motions = _motions(name, count)
        assert len(motions) == count, f"{len(motions)} motions for {count} fingers"
        for motion in motions:
            start = motion.pose(0.0, 0.0)
            assert start.shape == (4, 4) and np.allclose(start, np.eye(4), atol=1e-12), f"a jump at the start: {start}"


def check_motion_is_rigid_and_smooth(kind: str, name: str) -> None:
    """Rotations stay rotations; motion is continuous and starts and ends at rest, so no finger is struck."""
    for pose, motion in zip(_placements(FINGERS), _motions(name, FINGERS), strict=True):
        shares = np.linspace(0.0, 1.0, 401)
        poses = np.array([motion.pose(share, share * motion.duration) for share in shares])
        turned = poses[:, :3, :3]
        assert np.allclose(turned @ turned.transpose(0, 2, 1), np.eye(3), atol=1e-9), "a pose is not a rigid motion"
        assert np.all(np.linalg.det(turned) > 0.0), "a pose mirrors the finger"
        path = (poses @ (pose @ TIP))[:, :3]
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        assert steps.sum() > 1e-4, f"the finger moves {steps.sum():.3g} m in all"
        assert steps.max() < 10.0 * steps.sum() / len(steps), f"a jump of {steps.max():.3g} m within 1/400 of the time"
        assert max(steps[0], steps[-1]) < 0.1 * steps.max(), "it starts or stops abruptly"


def check_closes_towards_the_axis(kind: str, name: str) -> None:
    """With its own defaults the tip ends nearer to the gripper's axis, and all fingers move alike."""
    moved = []
    for pose, motion in zip(_placements(FINGERS), _motions(name, FINGERS), strict=True):
        tip, end = pose @ TIP, motion.pose(1.0, motion.duration) @ pose @ TIP
        moved.append((np.hypot(*tip[:2]) - np.hypot(*end[:2]), end[2] - tip[2]))
    assert min(inwards for inwards, _ in moved) > 0.0, f"a finger opens: it moves inwards by {moved}"
    assert np.allclose(moved, moved[0], atol=1e-9), f"the fingers move differently: {moved}"


ACTUATION = (check_drives_each_finger_once, check_motion_is_rigid_and_smooth, check_closes_towards_the_axis)


# -- fitness -----------------------------------------------------------------------------------------------------------


def check_scores_between_none_and_all(kind: str, name: str) -> None:
    """Fitness in [0, 1], margins in [-1, 1]; nothing held scores least, everything held most, the half between."""
    fitness = registry.create(kind, name)
    scores = []
    for held in (0, 2, 4):
        result = fitness.score({f"object {i}": _grasp(drop=0.0 if i < held else 1.0) for i in range(4)})
        assert 0.0 <= result.fitness <= 1.0, f"fitness is {result.fitness}"
        assert -1.0 <= result.margin <= 1.0, f"margin is {result.margin}"
        assert list(result.verdicts) == [f"object {i}" for i in range(4)], f"verdicts on {list(result.verdicts)}"
        assert sum(verdict.held for verdict in result.verdicts.values()) == held, f"{held} of 4 are held"
        scores.append(result.fitness)
    assert scores[0] < scores[1] < scores[2], f"holding more does not score more: {scores}"


def check_failure_is_not_held(kind: str, name: str) -> None:
    """A simulation that failed counts as not held, whatever its last frame looks like, and is never not-a-number."""
    fitness = registry.create(kind, name)
    for status in ("diverged", "timeout"):
        for drop in (0.0, float("nan")):
            result = fitness.score({"object": _grasp(drop=drop, status=status)})
            verdict = result.verdicts["object"]
            assert not verdict.held, f"an object counts as held although its simulation {status}"
            assert np.isfinite([result.fitness, result.margin, verdict.margin]).all(), f"not finite: {result}"


def check_margin_falls_with_the_drop(kind: str, name: str) -> None:
    """The margin breaks ties, so it never rises with the drop, has no jump, and is 1 for no drop at all."""
    fitness = registry.create(kind, name)
    drops = np.linspace(0.0, 0.05, 101)
    margins = [fitness.score({"object": _grasp(drop=float(drop))}).verdicts["object"].margin for drop in drops]
    assert margins[0] == 1.0 and margins[-1] < margins[0], f"margins run from {margins[0]} to {margins[-1]}"
    falls = -np.diff(margins)
    assert np.all(falls >= 0.0), "the margin rises with the drop"
    assert falls.max() < 0.25, f"the margin jumps by {falls.max():.3g} within half a millimetre"


FITNESS = (check_scores_between_none_and_all, check_failure_is_not_held, check_margin_falls_with_the_drop)


# -- features ----------------------------------------------------------------------------------------------------------


def check_measures_what_it_names(kind: str, name: str) -> None:
    """The names that the plugin declares are what it returns, all finite, for every design that comes with finqd."""
    features = registry.create(kind, name)
    for design in _bundled_designs():
        values = features.measure(design, _solids(design))
        assert tuple(values) == tuple(features.names), f"it declares {features.names} and returns {tuple(values)}"
        assert all(isinstance(value, float) for value in values.values()), f"not plain floats: {values}"
        assert np.isfinite(list(values.values())).all(), f"not finite: {values}"
        again = features.measure(design, _solids(design))
        assert again == values, f"the same design gives {values} and {again}"


def check_tells_designs_apart(kind: str, name: str) -> None:
    """A descriptor that is the same for all designs makes no map."""
    features = registry.create(kind, name)
    found = set()
    for share in (0.25, 0.5, 0.75):
        design = _design_at(share)
        found.add(tuple(features.measure(design, _solids(design)).values()))
    assert len(found) == 3, f"three different designs have the features {found}"


FEATURES = (check_measures_what_it_names, check_tells_designs_apart)


# -- how it is done ----------------------------------------------------------------------------------------------------


def _placements(count: int) -> list[np.ndarray]:
    from finqd.placement import placement

    return [placement(i, count, SPACING, HEIGHT) for i in range(count)]


def _motions(name: str, count: int) -> list[Any]:
    return list(registry.create("actuation", name).motions(_placements(count)))


def _grasp(*, drop: float, status: str = "ok") -> Trajectory:
    """Return the record of a grasp in which the object ends ``drop`` [m] lower, relative to the gripper, than held."""
    from finqd.protocol import GraspProtocol
    from finqd.trajectory import Trajectory

    protocol = GraspProtocol()
    times = np.linspace(0.0, protocol.close_s + protocol.lift_s + protocol.hold_s, 101)
    share = times / times[-1]
    heights = 0.02 + (protocol.si("lift_mm") - np.nan_to_num(drop)) * share
    return Trajectory(
        status=status, reason="" if status == "ok" else "made up", object_name="object", object_drop=drop, times=times,
        rigid_positions=np.stack([0.0 * times, 0.0 * times, heights], axis=1)[:, None],
        rigid_rotations=np.tile(np.eye(3), (len(times), 1, 1, 1)), contact_forces=np.tile(share[:, None], (1, FINGERS)),
        penetrations=0.0 * times, stroke=np.tile(share[:, None], (1, FINGERS)), protocol=protocol,
    )


def _bundled_designs() -> list[Design]:
    from finqd.data import bundled_names, designs_folder
    from finqd.design import Design

    return [Design.from_json(designs_folder() / f"{name}.json") for name in bundled_names(designs_folder())]


def _design_at(share: float) -> Design:
    from finqd.design import Design, design_parameters

    return Design.from_unit_vector([share] * len(design_parameters()))


def _solids(design: Design) -> list[Any]:
    geometry = design.plugin("geometry")
    return [geometry.build(design.finger_si(index)) for index in range(len(design.fingers))]

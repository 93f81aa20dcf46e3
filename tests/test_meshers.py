"""Both meshers on fin rays and other solids: volume, quality, regions; and the process that they run in."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from dataclasses import replace

import misbehaving_meshers as bad
import numpy as np
import pytest
from scipy.stats import qmc
from test_geometry_fin_ray import BENCHMARK, sobol_fingers

from finqd import registry
from finqd.errors import InputError, MeshError, PluginError
from finqd.mechanics.mass import lumped_masses
from finqd.mesh import Mesh
from finqd.mesh_notches import jacobian_ratios, notch_vertices
from finqd.mesh_reference import MID_EDGES
from finqd.mesh_shapes import box_mesh
from finqd.meshing import close_mesher, mesh_solid
from finqd.plugins.geometry_fin_ray import FinRay
from finqd.plugins.mesher_swept import Swept
from finqd.plugins.mesher_tetrahedral import Tetrahedral
from finqd.plugins.swept_patches import PlaneMesh, edge_counts, graded, mesh_patches
from finqd.plugins.swept_paving import cut_into_quads
from finqd.solid import Prism, Solid, SurfaceSolid
from finqd.units import DEG, MM

TRAPEZOID = Prism(
    np.array([(0, 0), (30, 0), (20, 80), (5, 80)]) * MM, (), 20 * MM, np.array([(0, 0), (5, 80)]) * MM
)
MESHERS = (Swept(), Tetrahedral(size_mm=4.0, order=1))


def face_area(mesh: Mesh, name: str) -> float:
    """Return the area [m^2] of a face set, from the corners of its faces."""
    total = 0.0
    for kind, indices in mesh.face_sets[name].items():
        corners = mesh.vertices[mesh.faces[kind][indices][:, : 4 if kind.startswith("quad") else 3]]
        cross = sum(np.cross(corners[:, i], corners[:, i - corners.shape[1] + 1]) for i in range(corners.shape[1]))
        total += 0.5 * float(np.linalg.norm(cross, axis=1).sum())
    return total


def assert_good_mesh(mesh: Mesh, solid: Solid, *, worst: float) -> None:
    quality = mesh.quality()
    assert quality.inverted == 0 and quality.scaled_jacobian_min > worst
    assert mesh.volume == pytest.approx(solid.volume, rel=1e-9)
    used = np.unique(np.concatenate([nodes.ravel() for nodes in mesh.blocks.values()]))
    assert np.array_equal(used, np.arange(mesh.n_vertices))


@pytest.mark.parametrize("mesher", MESHERS, ids=["swept", "tetrahedral"])
def test_sobol_fingers_are_meshed_without_inverted_elements(mesher: Swept | Tetrahedral) -> None:
    for finger in sobol_fingers(8, seed=5)[:: 1 if isinstance(mesher, Swept) else 3]:
        solid = FinRay().build(finger)
        mesh = mesher.mesh(solid)
        assert_good_mesh(mesh, solid, worst=0.2 if isinstance(mesher, Swept) else 0.0)
        assert set(mesh.blocks) == ({"hex8"} if isinstance(mesher, Swept) else {"tet4"})
        face = np.linalg.norm(solid.contact_line[1] - solid.contact_line[0]) * finger["thickness"]
        assert face_area(mesh, "contact") == pytest.approx(face, rel=1e-9)
        assert face_area(mesh, "base") == pytest.approx(finger["width"] * finger["thickness"], rel=1e-9)
        assert np.abs(mesh.vertices[mesh.node_sets["base"], 1]).max() == 0.0


@pytest.mark.parametrize("profile", ["isosceles", "right"])
@pytest.mark.parametrize(("size", "dofs"), [(4.0, (2650, 2950)), (2.0, (8800, 10100))])
def test_benchmark_finger_has_about_the_planned_size(profile: str, size: float, dofs: tuple[int, int]) -> None:
    solid = FinRay(profile=profile).build(BENCHMARK)
    mesh = Swept(size_mm=size).mesh(solid)
    assert_good_mesh(mesh, solid, worst=0.35)
    assert dofs[0] <= 3 * mesh.n_vertices <= dofs[1]
    assert mesh.quality().scaled_jacobian_median > 0.999
    assert mesh.quality().wedge_share == 0.0


def test_swept_options_set_layers_and_elements_through_a_wall() -> None:
    solid = FinRay().build(BENCHMARK)
    for layers, expected in ((None, 4), (1, 1), (7, 7)):
        levels = np.unique(np.round(Swept(layers=layers).mesh(solid).vertices[:, 2], 9))
        assert len(levels) == expected + 1 and levels[0] == -levels[-1] == pytest.approx(-0.5 * 21.3 * MM)
    single, double = Swept(layers=1).mesh(solid), Swept(layers=1, least_edges=2).mesh(solid)
    assert_good_mesh(double, solid, worst=0.2)
    inside = [np.any((np.abs(m.vertices[:, 1] - MM) < 1e-9) & (m.vertices[:, 0] > 5 * MM)) for m in (single, double)]
    assert inside == [False, True]  # a row of nodes in the middle of the base plate


def test_a_symmetric_finger_gets_a_mesh_symmetric_about_its_middle_plane() -> None:
    mesh = Swept().mesh(FinRay().build(BENCHMARK))
    mirrored = mesh.vertices * [1, 1, -1]
    assert {tuple(v) for v in np.round(mesh.vertices, 10) + 0.0} == {tuple(v) for v in np.round(mirrored, 10) + 0.0}


@pytest.mark.parametrize("mesher", MESHERS, ids=["swept", "tetrahedral"])
def test_meshing_twice_gives_the_same_mesh(mesher: Swept | Tetrahedral) -> None:
    finger = sobol_fingers(2, seed=9)[4]
    first, second = (mesher.mesh(FinRay().build(finger)) for _ in range(2))
    assert np.array_equal(first.vertices, second.vertices)
    assert all(np.array_equal(first.blocks[kind], second.blocks[kind]) for kind in first.blocks)


def test_allowed_ranges_are_meshed() -> None:
    """Far outside the search space too: many thin ribs, thick walls, steep tilt."""
    factor, meshed = {"mm": MM, "deg": DEG, "": 1}, 0
    for unit in qmc.Sobol(9, seed=4).random(128):
        finger = {}
        for p, u in zip(FinRay.finger_parameters, unit):
            number = p.allowed_low + u * (p.allowed_high - p.allowed_low)
            finger[p.name] = (round(number) if p.integer else number) * factor[p.unit]
        if FinRay().check(finger) is None:
            solid = FinRay().build(finger)
            assert_good_mesh(Swept().mesh(solid), solid, worst=0.0)
            meshed += 1
    assert meshed > 30


@pytest.mark.parametrize("finger", [BENCHMARK, *sobol_fingers(2, seed=2)[:3]])
def test_a_profile_without_patches_is_paved(finger: dict[str, float]) -> None:
    solid = replace(FinRay().build(finger), patches=None)
    mesh = Swept().mesh(solid)
    assert_good_mesh(mesh, solid, worst=0.02)
    assert 0.0 < mesh.quality().wedge_share < 0.35
    assert set(mesh.blocks) == {"hex8", "wedge6"}


@pytest.mark.parametrize("mesher", [*MESHERS, Tetrahedral(size_mm=5.0, order=2)], ids=["swept", "tet4", "tet10"])
def test_another_finger_type_is_meshed(mesher: Swept | Tetrahedral) -> None:
    mesh = mesher.mesh(TRAPEZOID)
    assert_good_mesh(mesh, TRAPEZOID, worst=0.05)
    assert "wedge6" not in mesh.blocks
    assert face_area(mesh, "contact") == pytest.approx(np.hypot(5, 80) * 20 * MM * MM, rel=1e-9)


def test_second_order_tetrahedra_have_straight_edges_and_vtk_order() -> None:
    mesh = Tetrahedral(size_mm=6.0, order=2).mesh(TRAPEZOID)
    nodes = mesh.vertices[mesh.blocks["tet10"]]
    for middle, (a, b) in enumerate([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)], start=4):
        assert np.array_equal(nodes[:, middle], 0.5 * (nodes[:, a] + nodes[:, b]))


def test_second_order_hexahedra_have_straight_edges_and_the_same_regions() -> None:
    solid = FinRay().build(BENCHMARK)
    linear, mesh = Swept(size_mm=6.0).mesh(solid), Swept(size_mm=6.0, order=2).mesh(solid)
    assert_good_mesh(mesh, solid, worst=0.2)
    assert set(mesh.blocks) == {"hex20"} and set(mesh.faces) == {"quad8"}
    assert np.array_equal(mesh.blocks["hex20"][:, :8], linear.blocks["hex8"])
    nodes = mesh.vertices[mesh.blocks["hex20"]]
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
    for middle, (a, b) in enumerate(edges, start=8):
        assert np.array_equal(nodes[:, middle], 0.5 * (nodes[:, a] + nodes[:, b]))
    for name in ("base", "contact"):
        assert face_area(mesh, name) == pytest.approx(face_area(linear, name), rel=1e-12)
        assert set(linear.node_sets[name]) < set(mesh.node_sets[name])
    assert np.abs(mesh.vertices[mesh.node_sets["base"], 1]).max() == 0.0
    assert lumped_masses(mesh, 1150.0).min() > 0.0


@pytest.mark.parametrize("quarter", ["middle", "quarter"])
def test_a_profile_whose_mesh_leaves_triangles_gets_quadratic_hexahedra_too(quarter: str) -> None:
    paved = replace(FinRay().build(BENCHMARK), patches=None)
    assert "wedge6" in Swept().mesh(paved).blocks
    mesh = Swept(order=2, notch_nodes=quarter).mesh(paved)
    assert set(mesh.blocks) == {"hex20"}
    assert_good_mesh(mesh, paved, worst=0.08)


def test_cutting_into_quadrilaterals_keeps_the_area_and_joins_neighbours() -> None:
    points = np.array([[0, 0], [2, 0], [2, 1], [0, 1], [3, 0.5]], dtype=float)
    plane = cut_into_quads(PlaneMesh(points, np.array([[0, 1, 2, 3]]), np.array([[1, 4, 2]])))
    assert len(plane.quads) == 7 and len(plane.triangles) == 0
    assert plane.area() == pytest.approx(2.5, rel=1e-14) and plane.worst() > 0.4
    assert len(plane.points) == 5 + 6 + 2  # corners, middles of edges (one of them shared), centres


def test_grading_shrinks_the_edges_at_notches_and_leaves_the_rest_as_it_was() -> None:
    solid = FinRay().build(BENCHMARK)
    even, fine = Swept(size_mm=3.0, order=2, layers=2).mesh(solid), Swept(size_mm=3.0, order=2, layers=2, grading=4.0)
    mesh = fine.mesh(solid)
    assert_good_mesh(mesh, solid, worst=0.02)
    assert mesh.n_vertices == even.n_vertices
    notches = np.concatenate(solid.holes)

    def nearest(of: Mesh) -> float:
        level = of.vertices[of.vertices[:, 2] == of.vertices[:, 2].min()][:, :2]
        distances = np.linalg.norm(notches[:, None] - level[None], axis=2)
        return float(np.median(np.sort(distances, axis=1)[:, 1]))  # the notch itself is a vertex

    assert nearest(mesh) < 0.4 * nearest(even)
    assert np.array_equal(graded(5, 1.0), np.linspace(0.0, 1.0, 6))
    shares = graded(5, 3.0)
    assert np.allclose(shares + shares[::-1], 1.0) and np.all(np.diff(shares) > 0.0)


def test_a_profile_that_grading_skews_is_graded_less_rather_than_paved(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = {"length": 109.9, "width": 28.4, "thickness": 35.0, "tip_length": 29.9, "contact_wall": 2.0,
               "back_wall": 2.7, "rib_thickness": 1.5}
    finger = {**{name: one * MM for name, one in lengths.items()}, "rib_count": 8, "rib_angle": 0.0}
    solid = FinRay().build(finger)
    worst = {g: mesh_patches(solid.patches, 2.5 * MM, 1, g).worst() for g in (1.5, 1.25)}
    assert worst[1.5] < 0.1 < worst[1.25]
    monkeypatch.setattr("finqd.plugins.swept_paving.pave_with_quads", lambda *_: pytest.fail("paved"))
    mesher = Swept(size_mm=2.5, layers=2, grading=1.5, order=2)
    assert mesher._plane(solid).worst() == pytest.approx(worst[1.25])


def test_quarter_nodes_stand_at_the_notches_and_nowhere_else() -> None:
    solid = FinRay().build(BENCHMARK)
    options = {"size_mm": 4.0, "order": 2, "layers": 2}
    middle, quarter = Swept(**options).mesh(solid), Swept(**options, notch_nodes="quarter").mesh(solid)
    notch = notch_vertices(middle)
    moved = np.flatnonzero(np.linalg.norm(quarter.vertices - middle.vertices, axis=1) > 1e-12)
    sides, nodes = np.array(MID_EDGES["hex20"]), quarter.blocks["hex20"]
    ends = {int(n[8 + k]): (int(n[a]), int(n[b])) for n in nodes for k, (a, b) in enumerate(sides)}
    assert set(moved) == {mid for mid, (a, b) in ends.items() if notch[a] != notch[b]} and len(moved) > 100
    for mid in moved:
        tip, far = sorted(ends[mid], key=lambda vertex: not notch[vertex])
        expected = 0.75 * quarter.vertices[tip] + 0.25 * quarter.vertices[far]
        np.testing.assert_allclose(quarter.vertices[mid], expected, atol=1e-15)
    assert quarter.volume == pytest.approx(middle.volume, rel=1e-13) and quarter.quality().inverted == 0
    assert {name: len(ids) for name, ids in quarter.node_sets.items()} == {
        name: len(ids) for name, ids in middle.node_sets.items()
    }


def test_elements_too_skew_for_quarter_nodes_keep_them_in_the_middle() -> None:
    """Ten thin ribs that lean by 40 degrees: with all nodes moved, an element is turned inside out."""
    solid = FinRay().build({**BENCHMARK, "rib_count": 10, "rib_thickness": 1e-3, "rib_angle": np.radians(40.0)})
    options = {"size_mm": 4.0, "order": 2, "layers": 1}
    middle, quarter = Swept(**options).mesh(solid), Swept(**options, notch_nodes="quarter").mesh(solid)
    points = quarter.vertices[quarter.blocks["hex20"]]
    assert jacobian_ratios("hex20", points).min() >= 0.02
    moved = np.linalg.norm(quarter.vertices - middle.vertices, axis=1) > 1e-12
    assert 100 < moved.sum()
    sides, notch = np.array(MID_EDGES["hex20"]), notch_vertices(middle)
    ends = middle.blocks["hex20"][:, sides]
    kept = middle.blocks["hex20"][:, 8:][(notch[ends[..., 0]] != notch[ends[..., 1]])]
    assert 0 < np.sum(~moved[np.unique(kept)]) < 30
    with pytest.raises(PluginError, match="notch_nodes"):
        registry.create("mesher", {"name": "swept", "notch_nodes": "third"})


def test_notches_are_the_re_entrant_edges_of_the_boundary() -> None:
    assert not notch_vertices(box_mesh((1.0, 1.0, 1.0), (2, 2, 2))).any()
    brick = box_mesh((2.0, 2.0, 1.0), (2, 2, 2))
    centres = brick.vertices[brick.blocks["hex8"]].mean(axis=1)
    ell = Mesh(brick.vertices, {"hex8": brick.blocks["hex8"][(centres[:, 0] < 1.0) | (centres[:, 1] < 1.0)]})
    found = ell.vertices[notch_vertices(ell)]
    assert sorted(map(tuple, found)) == [(1.0, 1.0, 0.0), (1.0, 1.0, 0.5), (1.0, 1.0, 1.0)]
    assert not notch_vertices(ell, angle=np.radians(271.0)).any() and notch_vertices(ell, angle=np.radians(269.0)).any()


@pytest.mark.parametrize("order", [1, 2])
def test_bricks_cut_into_tetrahedra_still_fit_together(order: int) -> None:
    for finger in (BENCHMARK, *sobol_fingers(1, seed=3)):
        solid = FinRay().build(finger)
        whole, mesh = Swept(size_mm=6.0).mesh(solid), Swept(size_mm=6.0, order=order, tetrahedra=True).mesh(solid)
        assert_good_mesh(mesh, solid, worst=0.0)
        (count,) = {kind: len(nodes) for kind, nodes in mesh.blocks.items()}.values()
        assert count == 6 * len(whole.blocks["hex8"]) + 3 * len(whole.blocks.get("wedge6", ()))
        # a face without its match inside would count as boundary
        triangles = mesh.vertices[mesh.surface_triangles()]
        sides = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        rings = (solid.outer, *solid.holes)
        outline = sum(np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum() for ring in rings)
        area = 2.0 * solid.area + outline * finger["thickness"]
        assert 0.5 * np.linalg.norm(sides, axis=1).sum() == pytest.approx(area, rel=1e-9)
        assert face_area(mesh, "contact") == pytest.approx(face_area(whole, "contact"), rel=1e-12)
    paved = replace(FinRay().build(BENCHMARK), patches=None)
    assert_good_mesh(Swept(tetrahedra=True).mesh(paved), paved, worst=0.0)


def test_second_order_fingers_keep_their_patches() -> None:
    mesher = Swept(size_mm=3.0, order=2, layers=2, grading=4.0)
    for finger in sobol_fingers(4, seed=11):
        mesh = mesher.mesh(FinRay().build(finger))
        assert set(mesh.blocks) == {"hex20"} and mesh.quality().inverted == 0


@pytest.mark.parametrize("contact_line", [None, TRAPEZOID.contact_line])
def test_a_bare_surface_is_filled_with_tetrahedra(contact_line: np.ndarray | None) -> None:
    solid = SurfaceSolid(*TRAPEZOID.surface(), contact_line=contact_line)
    mesh = Tetrahedral(size_mm=5.0, order=1).mesh(solid)
    assert_good_mesh(mesh, solid, worst=0.0)
    assert face_area(mesh, "contact") == pytest.approx(np.hypot(5, 80) * 20 * MM * MM, rel=1e-6)
    assert face_area(mesh, "base") == pytest.approx(600 * MM * MM, rel=1e-6)


def test_what_cannot_be_meshed_is_said_in_one_sentence() -> None:
    with pytest.raises(MeshError, match="takes prisms only; use the mesher 'tetrahedral'"):
        Swept().mesh(SurfaceSolid(*TRAPEZOID.surface()))
    floating = replace(TRAPEZOID, outer=TRAPEZOID.outer + [0, MM])
    for mesher in MESHERS:
        with pytest.raises(MeshError, match="no face in the plane y = 0"):
            mesher.mesh(floating)
    with pytest.raises(MeshError, match="contact line"):
        Swept().mesh(replace(TRAPEZOID, contact_line=np.array([(1, 0), (1, 50)]) * MM))


def test_edge_counts_balance_and_stay_near_what_is_wanted() -> None:
    grid = [[0], [1], [2], [3]]  # one four-sided patch
    assert edge_counts([grid], np.array([3.2, 1.0, 4.1, 1.0]), 1).tolist() in ([3, 1, 3, 1], [4, 1, 4, 1])
    triangle = edge_counts([[[0], [1], [2]]], np.array([1.0, 1.0, 1.0]), 1)
    assert triangle.tolist() == [2, 2, 2]
    assert edge_counts([[[0], [1], [2]]], np.array([2.0, 5.0, 5.0]), 1).sum() % 2 == 0
    with pytest.raises(MeshError, match="no numbers of edges fit"):
        edge_counts([[[0, 0], [1], [0], [2]]], np.ones(3), 1)


@pytest.mark.parametrize("fault", ["turned over", "half of the profile", "a point twice"])
def test_patches_that_do_not_fit_are_replaced_by_paving(fault: str) -> None:
    closed = np.concatenate([TRAPEZOID.outer, TRAPEZOID.outer[:1]])
    sides = [closed[i : i + 2] for i in range(4)]
    if fault == "turned over":
        patch = tuple(side[::-1] for side in sides[::-1])
    elif fault == "half of the profile":
        patch = (*sides[:2], closed[[2, 0]])
    else:
        patch = (np.array([closed[0], closed[0], closed[1]]), *sides[1:])
    solid = replace(TRAPEZOID, patches=(patch,))
    mesh = Swept().mesh(solid)
    assert_good_mesh(mesh, solid, worst=0.1)


# -- the meshing process --------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True, scope="module")
def _no_child_left():
    yield
    close_mesher()


def made_by(mesh: Mesh) -> int:
    return int(mesh.node_sets["made_by"][0])


def test_meshing_happens_in_one_other_process_that_is_reused() -> None:
    first, second = (made_by(mesh_solid(bad.Box(size), TRAPEZOID)) for size in (1.0, 2.0))
    assert first == second != os.getpid()
    assert made_by(mesh_solid(bad.Box(1.0), TRAPEZOID, in_process=True)) == os.getpid()


def test_identical_fingers_are_meshed_once_even_after_use_of_the_solid() -> None:
    solid = FinRay().build(BENCHMARK)
    mesh = mesh_solid(Swept(), solid)
    assert solid.polygon.is_valid  # caches the polygon in the solid
    assert mesh_solid(Swept(), solid) is mesh
    assert mesh_solid(Swept(), FinRay().build(dict(BENCHMARK))) is mesh
    assert mesh_solid(Swept(size_mm=5.0), solid) is not mesh
    direct = Swept().mesh(solid)
    assert np.array_equal(direct.vertices, mesh.vertices) and "faces" in mesh.__dict__


def test_a_mesher_that_never_ends_is_killed_and_the_next_one_works() -> None:
    before = made_by(mesh_solid(bad.Box(1.5), TRAPEZOID))
    with pytest.raises(MeshError, match="Hanging did not finish within 0.3 s and was stopped"):
        mesh_solid(bad.Hanging(), TRAPEZOID, time_limit_s=0.3)
    with pytest.raises(ProcessLookupError):
        os.kill(before, 0)
    assert made_by(mesh_solid(bad.Box(1.6), TRAPEZOID)) != before


def test_crashes_and_odd_exceptions_become_mesh_errors() -> None:
    with pytest.raises(MeshError, match=r"Crashing crashed \(exit code 7\)"):
        mesh_solid(bad.Crashing(), TRAPEZOID)
    with pytest.raises(MeshError, match=r"the mesher failed \(ZeroDivisionError: of no use to anyone\)"):
        mesh_solid(bad.Confused(), TRAPEZOID)
    with pytest.raises(MeshError, match="takes prisms only"):
        mesh_solid(Swept(), SurfaceSolid(*TRAPEZOID.surface()))


def test_a_child_killed_between_two_calls_is_replaced() -> None:
    pid = made_by(mesh_solid(bad.Box(2.5), TRAPEZOID))
    os.kill(pid, 9)
    time.sleep(0.2)
    assert made_by(mesh_solid(bad.Box(2.6), TRAPEZOID)) != pid


def test_threads_share_the_child() -> None:
    found: list[Mesh] = []
    threads = [
        threading.Thread(target=lambda i=i: found.append(mesh_solid(bad.Box(3.0 + i), TRAPEZOID))) for i in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({made_by(mesh) for mesh in found}) == 1
    assert sorted(mesh.vertices.max() for mesh in found) == [3.0, 4.0, 5.0, 6.0]


def _mesh_in_worker(queue: multiprocessing.Queue) -> None:
    queue.put((os.getpid(), made_by(mesh_solid(bad.Box(9.0), TRAPEZOID))))
    close_mesher()


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_a_daemonic_worker_can_mesh(method: str) -> None:
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    worker = context.Process(target=_mesh_in_worker, args=(queue,), daemon=True)
    worker.start()
    pid, child = queue.get(timeout=120)
    worker.join()
    assert pid != child != os.getpid()


def test_an_input_error_passes_through() -> None:
    with pytest.raises(InputError, match="cavity"):
        FinRay().build(BENCHMARK | {"contact_wall": 10 * MM, "back_wall": 10 * MM, "width": 20 * MM})

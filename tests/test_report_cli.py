"""`finqd report RUN` and `finqd export RUN --cell ...`: what they write, and one sentence for what cannot be."""

from __future__ import annotations

import json

import pytest
from synthetic_run import synthetic_run

from finqd.runlog import RunLog

PICTURES = ["heatmap", "coverage", "coverage_seconds", "qd_score", "qd_score_seconds", "pareto"]


@pytest.fixture(scope="module")
def searched():
    return synthetic_run(24, cells=4, rechecked=0)


@pytest.fixture
def folder(searched, tmp_path):
    """A run with its log."""
    path = tmp_path / "first search"
    log = RunLog.start(
        path, settings=dict(searched.settings), base={}, parameters=searched.parameters, ranges=searched.ranges
    )
    with log:
        for record in searched.records():
            log.append(record)
        log.note_told(len(searched.records()))
    return path


def data_of(page):
    return json.loads(page.read_text().split('id="data">')[1].split("</script>")[0])


def test_the_page_goes_into_the_run_or_where_it_is_told(run, folder, searched, tmp_path):
    assert run("report", folder) == (0, f"{folder / 'report.html'}\n", "")
    data = data_of(folder / "report.html")
    assert data["summary"]["evaluations"] == 24 and data["summary"]["elites"] == len(searched.elites()) > 3
    assert data["summary"]["qd_score"] == pytest.approx(searched.archive().stats.qd_score)
    assert data["name"] == "first search" and data["run_argument"] == f"'{folder}'"  # as a shell takes it
    target = tmp_path / "other.html"
    assert run("report", folder, "--out", target, "--shapes", "0")[0] == 0
    assert '"shapes":{}' in target.read_text()


def test_pictures_for_papers(run, folder, tmp_path):
    code, said, _ = run("report", folder, "--png", tmp_path / "png")
    assert code == 0 and said.split("\n")[:-1] == [str(tmp_path / "png" / f"{name}.png") for name in PICTURES]
    assert all((tmp_path / "png" / f"{name}.png").read_bytes()[:4] == b"\x89PNG" for name in PICTURES)
    assert not (folder / "report.html").exists()
    assert run("report", folder, "--png", tmp_path / "png", "--out", tmp_path / "page.html")[0] == 0
    assert (tmp_path / "page.html").exists()


def test_a_benchmark_result_beside_the_log_is_taken_up(run, folder, tmp_path):
    (folder / "benchmark.json").write_text("[]")
    code, _, said = run("report", folder)
    assert code == 2 and said.endswith("json: is no result of finqd evaluate (one made with --out FILE.json)\n")
    code, _, said = run("report", folder, "--benchmark", tmp_path / "none.json")
    assert (code, said) == (2, f"finqd: {tmp_path / 'none.json'}: cannot be read: No such file or directory\n")


def test_what_cannot_be_written_is_one_sentence(run, folder, tmp_path):
    code, _, said = run("report", folder, "--out", tmp_path / "no" / "page.html")
    assert code == 2 and said.startswith("finqd: --out: cannot write to") and said.count("\n") == 1
    (tmp_path / "file").write_text("")
    code, _, said = run("report", folder, "--png", tmp_path / "file")
    assert code == 2 and said.startswith("finqd: --png: cannot write to the folder") and said.count("\n") == 1
    assert run("report", tmp_path)[2] == f"finqd: {tmp_path}: holds no run: there is no run.sqlite in it\n"
    (folder / "run.sqlite").write_bytes(b"no log" * 1000)
    code, _, said = run("report", folder)
    assert code == 2 and said.startswith(f"finqd: {folder / 'run.sqlite'}: ") and said.count("\n") == 1


def test_the_shape_of_an_elite(run, folder, searched, tmp_path):
    pytest.importorskip("gmsh", exc_type=ImportError)
    import trimesh

    cell, record = searched.elites()[0]
    code, said, _ = run("export", folder, "--cell", ",".join(map(str, cell)), "--out", tmp_path / "gripper.stl")
    assert (code, said) == (0, f"{tmp_path / 'gripper.stl'}\n")
    part = trimesh.load(tmp_path / "gripper.stl")
    assert part.is_watertight and part.body_count == 1
    assert part.volume >= record["features"]["finger_volume_mm3"]


def test_a_cell_that_is_not_there_names_its_neighbours(run, folder, searched, tmp_path):
    records = dict(searched.elites())
    empty = next((i, j) for i in range(4) for j in range(4) if (i, j) not in records)
    code, _, said = run("export", folder, "--cell", f"{empty[0]}, {empty[1]}", "--out", tmp_path / "x.stl")
    assert code == 2 and said.startswith(f"finqd: --cell: cell {empty[0]},{empty[1]} is empty; filled cells nearby: ")
    nearest = min(records, key=lambda c: (sum((a - b) ** 2 for a, b in zip(c, empty)), c))
    first = f"nearby: {nearest[0]},{nearest[1]} (fitness {records[nearest]['fitness']:.3g})"
    assert first in said and said.count("\n") == 1 and not (tmp_path / "x.stl").exists()
    for wrong in ("9,0", "1", "a,b", "1,2,3", "-1,0", ""):
        code, _, said = run("export", folder, f"--cell={wrong}", "--out", tmp_path / "x.stl")
        wanted = f"finqd: --cell: must be 2 whole numbers from 0,0 to 3,3, as in 2,2, not {wrong!r}\n"
        assert (code, said) == (2, wanted)
    code, _, said = run("export", folder, "--out", tmp_path / "x.stl")
    assert code == 2 and said.startswith("finqd: --cell: name the cell of its map; the best are ")
    code, _, said = run("export", "benchmark", "--cell", "1,1", "--out", tmp_path / "x.stl")
    assert (code, said) == (2, "finqd: --cell: goes with the folder of a search (one with run.sqlite), and 'benchmark' "
                               "is none\n")  # fmt: skip

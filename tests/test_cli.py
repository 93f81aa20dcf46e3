"""The command line with a stand-in for the simulation: what is passed on, printed, written and refused."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from finqd import cli
from finqd.cli_progress import shown_progress
from finqd.doctor import Finding

ROOT = Path(__file__).resolve().parent.parent
BENCHMARK = str(ROOT / "designs" / "benchmark.json")
ROWS = {
    "sphere": {
        "status": "ok", "reason": "", "held": True, "drop_mm": 0.1234, "margin": 0.98766, "max_contact_force_N": 4.321,
        "max_penetration_mm": 0.04321, "steps": 321, "newton_iterations": 987, "seconds": 6.54,
    },
    "cube": {
        "status": "ok", "reason": "", "held": False, "drop_mm": 30.0, "margin": -1.0, "max_contact_force_N": 2.0,
        "max_penetration_mm": 0.01, "steps": 300, "newton_iterations": 900, "seconds": 5.0,
    },
    "pasta": {
        "status": "diverged", "reason": "at t = 0.41 s the [residual] did not fall", "held": False, "drop_mm": None,
        "margin": -1.0, "max_contact_force_N": None, "max_penetration_mm": None, "steps": 41, "newton_iterations": 99,
        "seconds": 1.0,
    },
}
RESULT = {
    "fitness": 1 / 3, "margin": -0.3374, "features": {"workspace_mm2": 2078.46}, "objects": ROWS,
    "assumptions": ["mu is 0.6"], "effects": {"friction": "on"}, "timings": {"total": 12.5},
    "mesh": {"elements": {"hex8": 900}}, "versions": {},
    "accuracy": {"preset": "standard", "applies": False, "sentence": "not measured yet"},
}


class FakeEvaluate:
    """Stands in for `finqd.evaluate.evaluate`: keeps what it is called with, returns RESULT or raises."""

    def __init__(self):
        self.calls, self.error, self.result = [], None, RESULT

    def __call__(self, design, *, objects, preset, jobs, record, progress, estimate_error, checkpoints, profile):
        call = {"design": design, "objects": objects, "preset": preset, "jobs": jobs, "record": record}
        self.calls.append({**call, "estimate_error": estimate_error, "checkpoints": checkpoints, "profile": profile})
        progress("sphere", 0.5)
        if self.error is not None:
            raise self.error
        progress("sphere", 1.0)
        return self

    def to_dict(self):
        return self.result


@pytest.fixture
def evaluated(monkeypatch):
    fake = FakeEvaluate()
    monkeypatch.setattr("finqd.evaluate.evaluate", fake)
    return fake


def test_help_names_every_command(run):
    code, out, _ = run("--help")
    assert code == 0
    for command in ("evaluate", "optimise", "export", "schema", "plugins", "doctor", "presets", "objects", "designs"):
        assert f"\n  {command} " in out
        assert run(command, "--help")[0] == 0


def test_evaluate_prints_a_row_an_object_with_its_numbers_and_the_reason_of_a_failure(run, evaluated):
    code, out, err = run("evaluate", BENCHMARK)
    assert code == 0
    lines = {line.split()[0]: line.split() for line in out.splitlines() if line.strip()}
    assert lines["sphere"] == ["sphere", "yes", "0.12", "0.988", "4.32", "0.0432", "321", "987", "6.5"]
    assert lines["cube"][:3] == ["cube", "no", "30.00"]
    assert "diverged" in out and "pasta: at t = 0.41 s the [residual] did not fall" in out
    assert "fitness 0.333 (1 of 3 held), margin -0.337" in out
    assert "\naccuracy of the preset standard: not measured yet\n" in out
    assert "uncertain" not in out and "+-" not in out and not evaluated.calls[0]["estimate_error"]
    assert "profile" not in out and not evaluated.calls[0]["profile"]
    for text in ("workspace_mm2 = 2078.46", "mu is 0.6", "friction = on", "elements.hex8 = 900"):
        assert text in out
    assert "sphere: done" in err and "15 lies outside the search range 20 to 30" in err


def test_an_error_estimate_is_asked_for_and_shown(run, evaluated):
    sure = {"drop_mm": [0.1234, 0.05], "force_N": [7.25, 0.4], "uncertain": False, "reason": ""}
    why = "lost, but held with the [coarser] mesh"
    flips = {"drop_mm": [-30.0, 12.34], "force_N": [3.0, None], "uncertain": True, "reason": why}
    why = "the simulation itself: diverged"
    failed = {"drop_mm": [None, None], "force_N": [None, None], "uncertain": True, "reason": why}
    rows = {name: {**ROWS[name], "estimate": one} for name, one in zip(ROWS, (sure, flips, failed))}
    whole = {"uncertain": 2, "objects": 3, "seconds": {"base": 12.54, "coarser_mesh": 4.0, "longer_step": 7.0}}
    evaluated.result = {**RESULT, "objects": rows, "estimate": whole}
    code, out, _ = run("evaluate", "benchmark", "--estimate-error")
    assert code == 0 and evaluated.calls[0]["estimate_error"]
    lines = {line.split()[0]: line.split() for line in out.splitlines() if line.strip()}
    assert lines["sphere"][1:5] == ["yes", "0.12", "+-", "0.05"]
    assert "final forces, summed over the fingers [N]: sphere 7.25 +- 0.40, cube 3.00 +- -, pasta - +- -\n" in out
    assert next(line for line in out.splitlines() if line.startswith("cube ")).split()[1:6] == [
        "no", "?", "30.00", "+-", "12.34"]
    assert "\ncube: uncertain: lost, but held with the [coarser] mesh\n" in out
    assert "\npasta: at t = 0.41 s the [residual] did not fall\n" in out
    seconds = "simulated for: base 12.5 s, coarser mesh 4.0 s, longer step 7.0 s"
    assert f"\nerror estimate: 2 of 3 verdicts are uncertain (?); {seconds}\n" in out


def test_set_means_the_plugin_that_the_preset_chooses(run, evaluated):
    assert run("evaluate", "benchmark", "--preset", "paper", "--set", "mesher.size_mm=3")[0] == 0
    assert evaluated.calls[0]["design"].spec("mesher") == {"name": "tetrahedral", "size_mm": 3.0, "order": 1}


def test_presets_lists_what_each_sets_and_how_far_off_it_is(run, monkeypatch):
    code, out, _ = run("presets")
    assert code == 0
    for name in cli.PRESETS:
        assert f"{name}: " in out
    assert "mesher: tetrahedral (size_mm = 2, order = 1), or swept (size_mm = 2)" in out
    from finqd import accuracy_bands, presets

    study = {"title": "a press", "date": "2026-01-31", "repeat": "finqd accuracy press"}
    row = {"settings": presets.PRESETS["draft"], "press_force_error_percent": 12.5}
    document = {"presets": {"draft": row}, "studies": {"press": study, "grasp": {**study, "date": None}}}
    monkeypatch.setattr(accuracy_bands, "bands", lambda: document)
    code, out, _ = run("presets")
    assert code == 0 and "draft: force of a press 12 % off\n" in out and "fine: not measured yet\n" in out
    assert out.endswith("press (2026-01-31): a press; to repeat it: finqd accuracy press\n")


def test_quiet_prints_no_table_and_no_progress(run, evaluated):
    code, out, err = run("evaluate", BENCHMARK, "--quiet", "--set", "finger.tip_length_mm=25")
    assert (code, out, err) == (0, "", "")


def test_evaluate_passes_on_what_was_typed(run, evaluated, tmp_path):
    code, _, _ = run(
        "evaluate", "benchmark", "--objects", "sphere, cube", "--objects", "disk", "--jobs", "2", "--preset", "draft",
        "--set", "protocol.hold_s=2.5", "--set", "mesher=tetrahedral", "--record", tmp_path / "a" / "b", "--profile",
    )
    (call,) = evaluated.calls
    assert call["profile"]
    assert code == 0 and call["objects"] == ["sphere", "cube", "disk"]
    assert (call["jobs"], call["preset"], call["record"]) == (2, "draft", tmp_path / "a" / "b")
    assert call["design"].protocol.hold_s == 2.5 and call["design"].spec("mesher")["name"] == "tetrahedral"
    assert (tmp_path / "a" / "b").is_dir()


def test_without_objects_all_are_asked_for(run, evaluated):
    run("evaluate", "benchmark")
    assert evaluated.calls[0]["objects"] is None


def test_a_surface_of_ones_own_becomes_an_object_with_its_mass(run, evaluated, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((30, 30, 30)).export(tmp_path / "part.stl")
    code, _, err = run("evaluate", "benchmark", "--object", tmp_path / "part.stl", "--mass-g", 40)
    assert code == 0, err
    (part,) = evaluated.calls[0]["objects"]
    assert part.name == "part" and part.mass == pytest.approx(0.04)


def test_out_holds_the_whole_result_and_nothing_else_is_left(run, evaluated, tmp_path):
    assert run("evaluate", "benchmark", "--out", tmp_path / "result.json")[0] == 0
    assert json.loads((tmp_path / "result.json").read_text()) == json.loads(json.dumps(RESULT))
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError(), OSError(28, "No space left on device")])
def test_an_older_result_survives_whatever_happens(run, evaluated, tmp_path, error):
    target = tmp_path / "result.json"
    target.write_text("old")
    evaluated.error = error
    try:
        run("evaluate", "benchmark", "--out", target)
    except MemoryError:
        pass
    assert target.read_text() == "old" and [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_ctrl_c_is_one_line_and_130(run, evaluated):
    evaluated.error = KeyboardInterrupt()
    code, out, err = run("evaluate", "benchmark", "--set", "finger.tip_length_mm=25")
    assert (code, out, err.strip()) == (130, "", "finqd: interrupted")


def test_a_full_disk_is_a_sentence(run, evaluated):
    evaluated.error = OSError(28, "No space left on device", "/some/file")
    code, _, err = run("evaluate", "benchmark", "--quiet")
    assert code == 2 and err.splitlines()[-1] == "finqd: /some/file: No space left on device"


def living(mark):
    """Return the processes that still run and inherited ``mark`` in their environment, whatever group they are in."""
    found = []
    for environ in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark.encode() in environ.read_bytes():
                found.append(environ.parent.name)
        except OSError:
            continue
    return found


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize("at_work_s", [0.0, 5.0])  # while workers start, and amid simulations
def test_ctrl_c_in_a_real_run_leaves_one_line_no_file_and_no_process(tmp_path, at_work_s):
    program = [sys.executable, "-m", "finqd", "evaluate", "benchmark", "--jobs", "2", "--out", "result.json"]
    mark = f"FINQD_TEST_MARK={tmp_path}"
    environment = {**os.environ, "FINQD_TEST_MARK": str(tmp_path)}
    with subprocess.Popen(
        program, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    ) as process:
        deadline = time.monotonic() + 60.0
        while (started := len(living(mark))) < 5 and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.1)  # until there are two workers, a mesher and Python's own helper to be left behind
        assert started >= 5, "nothing was at work yet"
        time.sleep(at_work_s)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    said = [line for line in err.splitlines() if line and "warning" not in line and "done" not in line]
    assert (out, said) == ("", ["finqd: interrupted"])
    assert process.returncode in (130, -signal.SIGINT), "a shell shows either as 130"
    assert not list(tmp_path.iterdir())
    deadline = time.monotonic() + 10.0
    while living(mark) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not living(mark)


@pytest.fixture
def places(tmp_path):
    """Return names for places that the bad command lines below speak of."""
    (tmp_path / "file").write_text("{}")
    (tmp_path / "empty.json").write_text("")
    (tmp_path / "list.json").write_text("[1, 2]")
    (tmp_path / "nan.json").write_text('{"spacing_mm": NaN}')
    (tmp_path / "noise.stl").write_bytes(bytes(range(256)))
    (tmp_path / "bad.json").write_text('{"finger": {')
    return {"DIR": str(tmp_path), "FILE": str(tmp_path / "file")}


@pytest.mark.parametrize(
    "line",
    [
        "",
        "evaluat",
        "evaluate",
        "evaluate benchmark other",
        "evaluate benchmark --nonsense",
        "evaluate no_such_design",
        "evaluate DIR/no_such.json",
        "evaluate DIR",
        "evaluate DIR/empty.json",
        "evaluate DIR/list.json",
        "evaluate DIR/nan.json",
        "evaluate DIR/bad.json",
        "evaluate benchmark --jobs 0",
        "evaluate benchmark --jobs two",
        "evaluate benchmark --preset best",
        "evaluate benchmark --estimate-error=yes",
        "evaluate benchmark --preset paper --set mesher.layers=2",
        "evaluate benchmark --set",
        "evaluate benchmark --set hold",
        "evaluate benchmark --set =3",
        "evaluate benchmark --set protocol.hold_s=-1",
        "evaluate benchmark --set protocol.hold_s=NaN",
        "evaluate benchmark --set no.such.key=1",
        "evaluate benchmark --set mesher=sweptt",
        "evaluate benchmark --set mesher.sise_mm=2",
        "evaluate benchmark --set fingers[7].length_mm=90",
        "evaluate benchmark --set geometry=3",
        "evaluate benchmark --objects ,",
        "evaluate benchmark --mass-g 40",
        "evaluate benchmark --object DIR/none.stl --mass-g 40",
        "evaluate benchmark --object DIR/noise.stl --mass-g 40",
        "evaluate benchmark --object FILE --mass-g 40",
        "evaluate benchmark --object DIR/noise.stl --mass-g heavy",
        "evaluate benchmark --object DIR/noise.stl --mass-g -4",
        "evaluate benchmark --object DIR/noise.stl --mass-g nan",
        "evaluate benchmark --out DIR",
        "evaluate benchmark --out DIR/no/such/folder.json",
        "evaluate benchmark --out FILE/result.json",
        "evaluate benchmark --record FILE",
        "evaluate benchmark --record FILE/deeper",
        "optimise",
        "optimise --out FILE",
        "optimise --out DIR/new --iterations 0",
        "optimise --out DIR/new --batch x",
        "optimise --out DIR/new --seed -1",
        "optimise --out DIR/new --design nothing",
        "optimise DIR/nothing.toml",
        "optimise FILE",
        "optimise --out DIR/new --algorithm best",
        "optimise --out DIR/new --time-limit-s 0",
        "optimise --out DIR/new --recheck -1",
        "optimise --out DIR/new --screen standard",
        "optimise --out DIR/new --finger nothing",
        "optimise --out DIR/new --workers inline --scheduler tcp://127.0.0.1:1",
        "optimise --out DIR/new --cells 0",
        "log export DIR --to DIR/all.csv",
        "log export nowhere",
        "recheck DIR",
        "recheck DIR -k 0",
        "report DIR",
        "export benchmark",
        "export nothing --out DIR/a.stl",
        "export benchmark --out DIR/a.xyz",
        "export benchmark --out FILE/a.stl",
        "schema --geometry no_such",
        "plugins --kind geometri",
        "objects extra",
        "presets extra",
        "doctor --fix",
    ],
)
def test_bad_input_is_one_sentence_and_exit_2_before_any_work(run, evaluated, places, line):
    for name, path in places.items():
        line = line.replace(name, path)
    before = sorted(Path(places["DIR"]).rglob("*"))
    code, out, err = run(*line.split())
    if not line:  # click shows the help to somebody who typed nothing at all
        assert "Usage: finqd" in out + err
        return
    sentences = [said for said in err.splitlines() if said and "warning" not in said]
    assert code == 2 and out == "" and len(sentences) == 1 and sentences[0].startswith("finqd: "), err
    assert "Traceback" not in err and not evaluated.calls
    assert sorted(Path(places["DIR"]).rglob("*")) == before, "something was left behind"


@pytest.mark.parametrize("objects", ["sfere", "cube,cube"])
def test_bad_objects_are_refused_by_the_real_evaluation(run, objects):
    code, _, err = run("evaluate", "benchmark", "--objects", objects)
    assert code == 2 and objects.split(",")[0] in err.splitlines()[-1]


def test_schema_is_json_and_takes_the_bundled_designs(run):
    jsonschema = pytest.importorskip("jsonschema")
    code, out, _ = run("schema")
    schema = json.loads(out)
    assert code == 0
    for path in (ROOT / "designs").glob("*.json"):
        jsonschema.validate(json.loads(path.read_text()), schema)


def test_plugins_lists_kind_name_distribution_options_and_one_line(run):
    code, out, _ = run("plugins", "--kind", "mesher")
    assert code == 0
    assert "mesher swept (finqd 0.1.0): " in out and "size_mm = " in out and "geometry" not in out


def test_a_broken_plugin_is_listed_with_its_reason(run, make_distribution):
    make_distribution("broken", {"mesher": {"bad": "no_such_module_here:Bad"}})
    code, out, _ = run("plugins")
    assert code == 0
    assert "mesher bad (broken 1.5): the mesher plugin 'bad' of the distribution 'broken' does not import" in out
    assert "features workspace" in out


def test_objects_and_designs_list_what_is_bundled(run):
    listed = {line.split()[0] for line in run("objects")[1].splitlines()[1:]}
    assert listed == {path.stem for path in (ROOT / "objects").glob("*.json")}
    assert "benchmark: " in run("designs")[1]


def test_doctor_exits_with_1_if_something_is_missing(run, monkeypatch):
    monkeypatch.setattr("finqd.doctor.examine", lambda: [Finding("gmsh", "missing", "apt-get install it")])
    code, out, _ = run("doctor")
    assert code == 1 and "missing" in out and "apt-get install it" in out
    monkeypatch.setattr("finqd.doctor.examine", lambda: [Finding("gmsh", "ok", "4"), Finding("x", "optional", "y")])
    assert run("doctor")[0] == 0


def test_a_reader_that_goes_away_is_no_traceback():
    program = [sys.executable, "-m", "finqd", "schema"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert "Traceback" not in process.stderr.read()


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_on_a_terminal_there_is_a_bar_an_object(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    with shown_progress() as progress:
        progress("sphere", 0.25)
        progress("cube", 7.0)
        progress("sphere", 0.5)
    assert "sphere" in screen.getvalue() and "cube" in screen.getvalue() and "100%" in screen.getvalue()


def test_elsewhere_each_object_is_told_of_once(capsys):
    with shown_progress() as progress:
        for fraction in (0.2, 1.0, 1.0):
            progress("sphere", fraction)
        progress("cube", 0.9)
    assert capsys.readouterr().err == "sphere: done\n"
    with shown_progress(quiet=True) as progress:
        progress("sphere", 1.0)
    assert capsys.readouterr().err == ""


def test_the_presets_on_offer_are_those_there_are():
    from finqd import cli, presets

    assert cli.PRESETS == tuple(presets.PRESETS)  # written twice only so that --help stays light
    assert presets.DEFAULT in cli.PRESETS

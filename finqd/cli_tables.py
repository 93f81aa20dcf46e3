"""What the commands print: tables on stdout."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

if TYPE_CHECKING:
    from finqd.doctor import Finding
    from finqd.registry import Option
    from finqd.search import SearchResult

#: a table is never squeezed below this: when stdout is a file there is no terminal whose width would matter
MINIMUM_WIDTH = 110


def print_evaluation(result: Mapping[str, Any]) -> None:
    """Print a result (`finqd.evaluate.Evaluation.to_dict`): a row an object, reasons of failures, totals."""
    console = _console()
    objects: Mapping[str, Mapping[str, Any]] = result["objects"]
    table = _table(
        "object", "held", "drop [mm]>", "margin>", "force [N]>", "penetration [mm]>", "steps>", "Newton iterations>",
        "seconds>",
    )
    for name, row in objects.items():
        estimate = row.get("estimate", {})
        verdict = "[green]yes[/green]" if row["held"] else "no"
        if row["status"] != "ok":
            verdict = f"[red]{escape(str(row['status']))}[/red]"
        if estimate.get("uncertain"):
            verdict += " [yellow]?[/yellow]"
        drop = _number(row.get("drop_mm"), 2)
        if estimate:
            drop += f" +- {_number(estimate['drop_mm'][1], 2)}"
        table.add_row(
            escape(name), verdict, drop, _number(row.get("margin"), 3),
            _number(row.get("max_contact_force_N"), 2), _number(row.get("max_penetration_mm"), 4),
            _number(row.get("steps"), 0), _number(row.get("newton_iterations"), 0), _number(row.get("seconds"), 1),
        )
    console.print(table)
    for name, row in objects.items():
        if row.get("reason"):
            console.print(f"{escape(name)}: {escape(str(row['reason']))}", soft_wrap=True)
        elif row.get("estimate", {}).get("reason"):
            console.print(f"{escape(name)}: uncertain: {escape(row['estimate']['reason'])}", soft_wrap=True)
    held = sum(bool(row["held"]) for row in objects.values())
    fitness, margin = _number(result["fitness"], 3), _number(result["margin"], 3)
    console.print(f"fitness {fitness} ({held} of {len(objects)} held), margin {margin}")
    if "accuracy" in result:
        console.print(escape(_accuracy_line(result["accuracy"])), soft_wrap=True)
    if "estimate" in result:
        console.print(escape(_forces_line(objects)), soft_wrap=True)
        console.print(_estimate_line(result["estimate"]), soft_wrap=True)
    for part in ("features", "mesh", "effects", "timings", "assumptions"):
        _print_part(console, part, result.get(part))
    if "profile" in result:
        print_profile(result["profile"])
    _print_part(console, "protocol", result.get("design", {}).get("protocol"))


def print_profile(profile: Mapping[str, Any]) -> None:
    """Print where the time went (`finqd.profiling.total`): a row a category, then what the shares of steps are."""
    console, steps = _console(), profile["steps"]
    count = profile["simulations"]
    console.print(f"[bold]profile[/bold] of {count} simulation{'' if count == 1 else 's'}, added up")
    table = _table("", "seconds>", "share>", "calls>", "ms a call>", "what")
    for name, row in profile["categories"].items():
        table.add_row(
            name.replace("_", " "), _number(row["seconds"], 3), _percent(row["share"]), str(row["calls"] or "-"),
            _number(row["ms_per_call"], 3), escape(row["what"]),
        )
    table.add_row("all", _number(profile["seconds"], 3))
    console.print(Padding(table, (0, 0, 0, 4), expand=False))
    spared = ", ".join(
        f"{row['calls']} {name.replace('_', ' ')} {row['seconds']:.3f} s" for name, row in steps["avoidable"].items()
    )
    for line in (
        f"steps: {steps['seconds']:.3f} s, of which elasticity, contact, assembly, factorisation and solves are "
        f"{_percent(steps['kernels_share'])} ({spared})",
        f"work that no method of this kind can avoid: {_percent(steps['unavoidable_share'])} ({steps['unavoidable']})",
    ):
        console.print(Padding(escape(line), (0, 0, 0, 4), expand=False))


def _accuracy_line(accuracy: Mapping[str, Any]) -> str:
    """Return what is known of a preset's errors, and from which studies."""
    studies = accuracy.get("studies", {})
    named = ", ".join(f"{name} of {study['date']}" for name, study in studies.items() if study["date"])
    source = f" (studies: {named}; `finqd presets` says how to repeat them)" if accuracy["applies"] and named else ""
    return f"accuracy of the preset {accuracy['preset']}: {accuracy['sentence']}{source}"


def _forces_line(objects: Mapping[str, Mapping[str, Any]]) -> str:
    forces = {name: row["estimate"]["force_N"] for name, row in objects.items()}
    told = ", ".join(f"{name} {_number(f, 2)} +- {_number(spread, 2)}" for name, (f, spread) in forces.items())
    return f"final forces, summed over the fingers [N]: {told}"


def _estimate_line(estimate: Mapping[str, Any]) -> str:
    seconds = ", ".join(f"{name.replace('_', ' ')} {value:.1f} s" for name, value in estimate["seconds"].items())
    uncertain = f"{estimate['uncertain']} of {estimate['objects']} verdicts are uncertain (?)"
    return f"error estimate: {uncertain}; simulated for: {seconds}"


#: what the column of seconds means
COSTS = (
    "cost: seconds in kernels and the Python round them; one figure together for object_contact, friction and floor, "
    "for self_contact and finger_to_finger_contact, and for the elements; what has no kernels of its own has none"
)


def print_explanation(name: str, row: Mapping[str, Any]) -> None:
    """Print the effects of one grasp (`finqd.explain.Explanation.to_dict`), a row each, and what came of it.

    Either why each is on or off, or what its being the other way round changes.
    """
    console = _console()
    console.print(f"[bold]{escape(name)}[/bold]: {escape(_outcome(row))}", soft_wrap=True)
    if row["reason"]:
        console.print(escape(row["reason"]), soft_wrap=True)
    asked = any("what_if" in line for line in row["effects"].values())
    more = ("what if", "held", "force [%]>", "drop [mm]>", "seconds>") if asked else ("why",)
    table = _table("effect", "", "since [s]>", "cost [s]>", *more)
    for effect, line in row["effects"].items():
        other = line.get("what_if", {})
        cells = _changes(row, other) if asked else [escape(line["why"])]
        table.add_row(effect, line["state"], _number(line["since_s"], 2), _number(line["seconds"], 2), *cells)
    console.print(table)
    console.print(escape(COSTS), soft_wrap=True)
    for effect, line in row["effects"].items():
        if line.get("what_if", {}).get("reason"):
            console.print(escape(f"{effect} {line['what_if']['reason']}"), soft_wrap=True)


def _outcome(row: Mapping[str, Any]) -> str:
    verdict = ("held" if row["held"] else "lost") if row["status"] == "ok" else row["status"]
    drop, force = _number(row["drop_mm"], 2), _number(row["force_N"], 2)
    return f"{verdict}, drop {drop} mm, force {force} N, {row['seconds']:.1f} s"


def _changes(row: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return what another grasp changes: state, verdict, force as a share, drop, and seconds as a factor."""
    if not other.get("state"):
        return [""] * 5
    verdict = ("yes" if other["held"] else "no") if other["status"] == "ok" else other["status"]
    changes = [other["state"], verdict if other["held"] == row["held"] else f"[red]{verdict}[/red]"]
    both = row["force_N"] and other["force_N"] is not None
    changes.append(f"{100 * (other['force_N'] / row['force_N'] - 1):+.1f}" if both else "-")
    dropped = row["drop_mm"] is not None and other["drop_mm"] is not None
    changes.append(f"{other['drop_mm'] - row['drop_mm']:+.2f}" if dropped else "-")
    return [*changes, f"x {other['seconds'] / row['seconds']:.2f}" if row["seconds"] > 0.0 else "-"]


def print_presets() -> None:
    """Print what each preset sets, and its measured errors."""
    from finqd.accuracy_bands import bands, preset_sentence
    from finqd.presets import PRESETS

    console = _console()
    for name, sections in PRESETS.items():
        console.print(f"[bold]{name}[/bold]: {escape(preset_sentence(name))}")
        for section, values in sections.items():
            console.print(f"    {section}: {escape(_preset_section(values))}", soft_wrap=True)
    for name, study in bands()["studies"].items():
        if study["date"]:
            line = f"{name} ({study['date']}): {study['title']}; to repeat it: {study['repeat']}"
            console.print(escape(line), soft_wrap=True)


def _preset_section(values: Mapping[str, Any]) -> str:
    """Return options in a row, those of each plugin behind its name."""
    parts = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            options = ", ".join(f"{option} = {_value(one)}" for option, one in value.items())
            parts.append(f"{key} ({options})" if options else key)
        else:
            parts.append(f"{key} = {_value(value)}")
    return ", or ".join(parts)


def print_search(result: SearchResult) -> None:
    """Print the elites of a search, best first, and where the rest is."""
    console = _console()
    axes = list(result.ranges)
    table = _table("cell", "fitness>", "margin>", *(f"{axis}>" for axis in axes))
    elites = sorted(result.elites, key=lambda elite: (-elite[1]["fitness"], -elite[1]["margin"]))
    for cell, record in elites:
        features = [_number(record["features"][axis], 1) for axis in axes]
        table.add_row(str(cell), _number(record["fitness"], 3), _number(record["margin"], 3), *features)
    console.print(table)
    failed = sum(record.get("status") != "ok" for record in result.records)
    counts = f"{len(result.records)} designs evaluated, {failed} failed, {len(elites)} elites"
    console.print(f"{counts}; everything is in {escape(str(result.out))}", soft_wrap=True)
    if result.agreement is not None:
        console.print(escape(result.agreement.sentence()), soft_wrap=True)


def print_plugins(kind: str | None) -> None:
    """Print every registered plugin: who brought it, its one line, its options. One that does not load says why."""
    from finqd import registry
    from finqd.errors import FinqdError

    console = _console()
    for entry in registry.entries(kind):
        title = f"[bold]{entry.kind} {escape(entry.name)}[/bold] ({escape(entry.distribution)} {escape(entry.version)})"
        try:
            summary = (registry.load(entry.kind, entry.name).__doc__ or "").strip().partition("\n")[0]
            lines = [_option_line(option) for option in registry.options(entry.kind, entry.name)]
        except FinqdError as error:
            summary, lines = f"[red]{escape(str(error))}[/red]", []
        else:
            summary = escape(summary)
        console.print(f"{title}: {summary}", soft_wrap=True)
        for line in lines:
            console.print(f"    {escape(line)}", soft_wrap=True)


def print_objects() -> None:
    """Print the objects that come with finqd: name, mass, size."""
    from finqd.data import bundled_names, objects_folder
    from finqd.objects import load_object

    table = _table("object", "mass [g]>", "size [mm]>")
    for name in bundled_names(objects_folder()):
        grasped = load_object(name)
        size = 1e3 * (grasped.vertices.max(axis=0) - grasped.vertices.min(axis=0))
        table.add_row(escape(name), f"{1e3 * grasped.mass:.1f}", " x ".join(f"{length:.1f}" for length in size))
    _console().print(table)


def print_designs() -> None:
    """Print the designs that come with finqd, and where they are."""
    from finqd.data import bundled_names, designs_folder
    from finqd.json_input import read_json_object

    console, folder = _console(), designs_folder()
    for name in bundled_names(folder):
        document, _ = read_json_object(folder / f"{name}.json", kind="design")
        console.print(f"[bold]{escape(name)}[/bold]: {escape(str(document.get('description', '')))}", soft_wrap=True)
    console.print(f"in {escape(str(folder))}", soft_wrap=True)


def print_findings(findings: list[Finding]) -> None:
    """Print what `finqd.doctor.examine` found, and the verdict."""
    from finqd.doctor import fit

    console = _console()
    colours = {"ok": "green", "optional": "yellow", "missing": "red"}
    for finding in findings:
        colour = colours[finding.status]
        mark = f"[{colour}]{finding.status:<8}[/{colour}]"
        console.print(f"{mark} {escape(finding.subject):<16} {escape(finding.detail)}", soft_wrap=True)
    console.print("finqd can run here" if fit(findings) else "finqd cannot run here: something is missing")


def _option_line(option: Option) -> str:
    import json

    return f"{option.name} = {json.dumps(option.default)}: {option.allowed}"


def _print_part(console: Console, title: str, part: Any) -> None:
    """Print a part of the result: numbers in a row, sentences one a line."""
    if not part:
        return
    if isinstance(part, Mapping):
        entries = [f"{key} = {_value(value)}" for key, value in _flat(part).items()]
    else:
        entries = [str(entry) for entry in part]
    prose = any(" " in entry.partition(" = ")[2] or " = " not in entry for entry in entries)
    console.print(f"[bold]{title}[/bold]")
    for line in entries if prose else [", ".join(entries)]:
        console.print(Padding(escape(line), (0, 0, 0, 4), expand=False))


def _flat(part: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested mappings as one, with dotted keys."""
    found: dict[str, Any] = {}
    for key, value in part.items():
        found.update(_flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value})
    return found


def _value(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _table(*titles: str) -> Table:
    """Return a table without lines between rows; a title that ends in ``>`` is of a column of numbers."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for title in titles:
        side: Literal["left", "right"] = "right" if title.endswith(">") else "left"
        table.add_column(escape(title.removesuffix(">")), justify=side, no_wrap=True)
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def _console() -> Console:
    console = Console(highlight=False)
    return console if console.width >= MINIMUM_WIDTH else Console(highlight=False, width=MINIMUM_WIDTH)

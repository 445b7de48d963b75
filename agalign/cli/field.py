"""The command `agalign mosaic`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from agalign.cli.command import Command
from agalign.cli.results import Out, chosen_indices, print_left_out
from agalign.cli.terminal import MAX_LISTED, RAW_NUMBERS, ExitCode, Terminal, examples
from agalign.values.text import counted

if TYPE_CHECKING:
    from agalign.products.mosaic.compose import MosaicReport

IndexNames = Annotated[str | None, typer.Option("--index", "-i", help="Names of indices separated by commas.")]


def _mosaic(
    terminal: Terminal,
    out: Out,
    target: Annotated[Path | None, typer.Option("-o", "--out", help="By default OUT/mosaic.tif.")] = None,
    index: IndexNames = None,
    gsd: Annotated[float | None, typer.Option(min=1e-4, help="Pixel size, m; by default that of the captures.")] = None,
    untied: Annotated[bool, typer.Option("--untied", help="Also place captures without tie points.")] = False,
) -> int:
    """Join the aligned captures of a flight into a quick mosaic for viewing.

    Tie points between overlapping captures refine the georeference from GPS and attitude; captures without any to the
    others are left out. The ground is assumed to be a horizontal plane: the mosaic shows a field and its zones, and
    replaces neither an orthomosaic (OpenDroneMap) nor ground control.
    """
    from agalign.products.mosaic.compose import mosaic as make_mosaic

    chosen = [] if index is None else [one.name for one in chosen_indices(index, [])]
    path = target or out / "mosaic.tif"
    report = make_mosaic(out, path, indices=chosen, gsd_m=gsd, untied=untied)
    left_out = [*report.left_out, *((path.name, r.problem) for r in report.indices if r.problem)]
    print_left_out(left_out, terminal)
    _print_doubts(report, terminal)
    terminal.event("mosaic", **{k: v for k, v in vars(report).items() if k not in ("left_out", "indices")})
    if report.pairs:
        ties = f"{report.pairs} overlaps, {report.tie_points} tie points that were not used"
        misfits = {ties: report.misfit_m, "by the georeference": report.georeference_misfit_m}
        for source, (median_m, p95_m) in misfits.items():
            terminal.result(f"Misfit between captures, {source}: median {median_m:.2f} m, p95 {p95_m:.2f} m")
    place = f"{report.accuracy_m:.1f} m, as the georeference of a capture; no ground control"
    terminal.result(f"Position on the map: accurate to {place}")
    files = [path, *(r.path for r in report.indices if r.path is not None)]
    terminal.result(f"Mosaic of {report.captures} captures: {', '.join(map(str, files))}")
    return ExitCode.PARTIAL if left_out else ExitCode.OK


def _print_doubts(report: "MosaicReport", terminal: Terminal) -> None:
    """Print what makes the place, the scale or the indices of a mosaic uncertain."""
    if report.untied:
        names = ", ".join(report.untied[:MAX_LISTED]) + (" …" if report.untied[MAX_LISTED:] else "")
        place = f"placed by the georeference, accurate to {report.accuracy_m:.0f} m"
        terminal.problem(f"{counted(len(report.untied), 'capture')} without tie points to the others: {place}: {names}")
    if report.height_is_assumed:
        terminal.problem("the height above ground is assumed, so the scale is uncertain; align with --ground-elevation")
    if any(r.raw_numbers for r in report.indices):
        terminal.problem(RAW_NUMBERS)


mosaic = Command(
    _mosaic,
    {"Output": "target index gsd untied", "Running": "quiet log_json"},
    epilog=examples(("agalign mosaic aligned/ -o field.tif --index ndvi", "field.tif, all bands, and field_ndvi.tif")),
)

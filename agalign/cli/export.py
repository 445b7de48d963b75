"""The command `agalign export`: aligned captures in the formats of other programs."""

from pathlib import Path
from typing import Annotated

import typer

from agalign.cli.terminal import (
    EXIT_OK,
    EXIT_PARTIAL,
    LogJson,
    Quiet,
    Terminal,
    examples,
    exits,
    of_output,
    shown,
)
from agalign.values.choices import ExportProgram

_EXAMPLES = examples(
    ("agalign export aligned/ --for odm", "band files in one folder, and the options for OpenDroneMap"),
    ("agalign export aligned/ --for micasense", "warp matrices for MicaSense's notebooks"),
    ("agalign export aligned/ --for opencv -o matrices/", "homographies and sampled mappings for scripts"),
)
_MAX_LISTED = 10


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command("export", epilog=_EXAMPLES)(export)


def export(
    out: Annotated[Path, typer.Argument(help="Output folder of a run.", show_default=False)],
    program: Annotated[
        ExportProgram,
        of_output(
            "--for", show_default=False,
            help="Band files with tags for odm, metashape or pix4d; warp matrices for micasense or opencv.",
        ),
    ],
    target: Annotated[
        Path | None, of_output("-o", "--out", help="Output folder; by default OUT with the program's name added.")
    ] = None,
    copy: Annotated[bool, of_output("--copy", help="Copy the band files instead of creating hard links.")] = False,
    source: Annotated[
        Path | None, of_output(help="Folder with the original images, if they were moved; for micasense only.")
    ] = None,
    quiet: Quiet = False,
    log_json: LogJson = False,
) -> None:  # fmt: skip
    """Export aligned captures for photogrammetry programs, MicaSense's notebooks or OpenCV."""
    terminal = Terminal(quiet=quiet, verbose=False, log_json=log_json)
    with exits(terminal):
        from agalign.products.export import export as run_export

        run_folder = out.resolve()
        folder = target or run_folder.parent / f"{run_folder.name}-{program}"
        report = run_export(out, folder, program, copy=copy, source=source)
        for label, reason in report.left_out[:_MAX_LISTED]:
            terminal.problem(f"{label}: left out: {reason}", capture=label)
        if len(report.left_out) > _MAX_LISTED:
            terminal.problem(f"{len(report.left_out) - _MAX_LISTED} more captures are left out")
        for line in report.notes:
            terminal.result(shown(line))
        text = f"{report.captures} captures, {len(report.files)} files in {folder}"
        terminal.event("export", captures=report.captures, files=len(report.files), folder=str(folder))
        terminal.result(shown(text))
        raise typer.Exit(EXIT_PARTIAL if report.left_out else EXIT_OK)

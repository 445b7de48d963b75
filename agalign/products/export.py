"""Exports of a run for other programs: band files in one folder, or matrices."""

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from agalign.errors import ConfigurationError, InputError, OutputError
from agalign.products.export_matrices import AlignedCapture, write_micasense, write_opencv
from agalign.products.sidecar import Sidecar
from agalign.products.sidecar_file import read_sidecar, run_sidecars
from agalign.values.choices import ExportProgram
from agalign.values.files import write_text

NOTE_FILE = "README.txt"
_IMAGES = "images"


@dataclass
class ExportReport:
    """Result of an export."""

    target: Path
    captures: int = 0
    files: list[Path] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)
    """(label of a capture, reason why it is left out)."""
    notes: list[str] = field(default_factory=list)
    """Instructions for the other program, one per line."""


def export(
    out: Path, target: Path, program: ExportProgram, *, copy: bool = False, source: Path | None = None
) -> ExportReport:
    """Export the captures with status `ok` of the output folder of a run into a new folder.

    Band files are hard links if the file system allows that, and copies otherwise or with `copy`. `source` is the
    folder with the original images, by default the input of the run; only the MicaSense matrices need it.
    Raises InputError if there is no run or nothing to export, ConfigurationError if the run wrote no band files,
    OutputError if `target` is not empty or cannot be written.
    """
    captures = [AlignedCapture(read_sidecar(path), path, path.parent.relative_to(out)) for path in run_sidecars(out)]
    _check_empty(target)
    report = ExportReport(target)
    good = [c for c in captures if c.sidecar.status == "ok"]
    # A misaligned band harms a reconstruction more than a missing capture.
    report.left_out += [(c.label, f"its status is {c.sidecar.status}") for c in captures if c not in good]
    if not good:
        raise InputError(f"{out}: no capture with status ok; 'agalign report {out}' shows what failed")
    if program == "micasense":
        report.files, report.notes = write_micasense(good, out, target, source)
    elif program == "opencv":
        report.files, report.notes = write_opencv(good, target)
    else:
        report.files = _band_files(good, out, target / _IMAGES, copy=copy)
        report.notes = _NOTES[program](good[0].sidecar)
    report.captures = len(good)
    write_text(target / NOTE_FILE, "\n".join(report.notes) + "\n")
    return report


def _check_empty(target: Path) -> None:
    """Raise OutputError if the target folder is not empty."""
    try:
        if target.exists() and any(target.iterdir()):
            raise OutputError(f"{target}: is not empty; choose another folder with -o, or delete it")
    except OSError as error:
        raise OutputError(f"{target}: cannot be used ({error.strerror or error})") from None


def _band_files(captures: Sequence[AlignedCapture], out: Path, images: Path, *, copy: bool) -> list[Path]:
    """Link or copy the band files. Raises ConfigurationError and OutputError."""
    written = []
    for capture in captures:
        output = capture.sidecar.output
        if output is None or not output.band_files:
            raise ConfigurationError(
                f"{out}: has stacks only; run 'agalign' with --layout bands or both into it, and export again"
            )
        for part in output.band_files:
            name = "_".join((*capture.folder.parts, *Path(part.file).parts))
            written.append(_placed(capture.path.parent / part.file, images / name, copy=copy))
    return written


def _placed(source: Path, target: Path, *, copy: bool) -> Path:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if not copy:
            try:
                os.link(source, target)
                return target
            except OSError:  # another disk, or a file system without hard links
                pass
        shutil.copyfile(source, target)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error})") from None
    return target


# ---- instructions for the other program


def _for_odm(sidecar: Sidecar) -> list[str]:
    reference, output = sidecar.reference.band, sidecar.output
    radiometry = None if output is None else output.radiometry
    calibration = "none" if radiometry is not None else "camera+sun"
    return [
        "OpenDroneMap, WebODM: the bands of each capture are aligned, and have the tags of one camera.",
        f"  --skip-band-alignment --primary-band '{reference}' --radiometric-calibration {calibration}"
        " --texturing-skip-global-seam-leveling",
        f"{reference} is the reference band, which is not resampled.",
        "The files contain raw numbers: camera+sun needs the light sensor's tags; without them use camera."
        if radiometry is None else f"The files contain {radiometry}: OpenDroneMap must not calibrate them again.",
    ]  # fmt: skip


def _for_metashape(sidecar: Sidecar) -> list[str]:
    return [
        "Agisoft Metashape: Workflow, Add Folder, 'Multi-camera system'.",
        "Tools, Camera Calibration: leave the slave offsets at zero (no 'Adjust location', no 'Adjust rotation').",
        f"Tools, Set Primary Channel: {sidecar.reference.band}.",
    ]


def _for_pix4d(sidecar: Sidecar) -> list[str]:  # noqa: ARG001
    return [
        "Pix4Dmapper, Pix4Dfields: add all images; template 'Ag Multispectral'.",
        "Leave the rig's relative parameters as 'Known': they are zero, the bands are aligned.",
        "Radiometric processing needs raw numbers and the captures of the panel from the flight's own folder.",
    ]


_NOTES: dict[ExportProgram, Callable[[Sidecar], list[str]]] = {
    "odm": _for_odm, "metashape": _for_metashape, "pix4d": _for_pix4d,
}  # fmt: skip
